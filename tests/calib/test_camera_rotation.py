from __future__ import annotations

from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from stereo_sfm.calib.camera_rotation import align_cameras
from stereo_sfm.drivers.source import open_source
from stereo_sfm.geometry import se3
from stereo_sfm.types import StereoImage

TURN_DEG = np.array([0.4, 0.3, -0.2])


@pytest.mark.parametrize("folder", ["euroc_mh01", "tum_vi_room1"])
def test_a_turn_put_into_a_real_calibration_is_found(folder: str, data_root: Path) -> None:
    with open_source(data_root / folder) as source:
        images = list(islice(source, 0, 40, 13 if folder == "euroc_mh01" else 1))
    wrong = source.rig.left_T_right.copy()
    wrong[:3, :3] = wrong[:3, :3] @ se3.so3_exp(np.radians(TURN_DEG))
    found = align_cameras(replace(source.rig, left_T_right=wrong), images)
    assert found is not None and found.rig.right is not None
    assert found.before_px > 1.5 and found.after_px < 0.7
    left_over = np.degrees(se3.so3_log(source.rig.left_T_right[:3, :3].T @ found.rig.left_T_right[:3, :3]))
    assert np.abs(left_over).max() < 0.12
    assert found.rig.baseline == pytest.approx(source.rig.baseline)
    again = align_cameras(replace(source.rig, left_T_right=wrong), images)
    assert again is not None and np.array_equal(again.rig.left_T_right, found.rig.left_T_right)


def test_images_without_points_give_no_result(data_root: Path) -> None:
    with open_source(data_root / "euroc_mh01") as source:
        blank = np.full((480, 752), 99, np.uint8)
        assert align_cameras(source.rig, [StereoImage(0, 0, blank, blank.copy())]) is None
        assert align_cameras(source.rig, []) is None
