"""`convert` of real data sets: every frame is read back as from the folder's driver."""

from __future__ import annotations

from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from stereo_sfm.cli import main
from stereo_sfm.drivers import open_source
from tests.log.recordings import assert_same_image


@pytest.mark.parametrize("folder", ["kitti", "euroc_mh01", "tum_vi_room1", "t265_office", "rgbd_dataset_freiburg1_xyz"])
def test_a_converted_data_set_is_the_data_set(data_root: Path, tmp_path: Path, folder: str) -> None:
    path = tmp_path / "a.mcap"
    arguments = ["convert", str(data_root / folder), "-o", str(path), "--frames", "3", "-q"]
    assert main(arguments) == 0
    assert main(arguments) == 2  # it exists
    with open_source(data_root / folder) as original, open_source(path) as converted:
        frames = list(converted)
        assert len(frames) == 3
        for one, other in zip(islice(original, 3), frames, strict=True):
            assert_same_image(one, other)
        assert (original.ground_truth is None) == (converted.ground_truth is None)
        if original.ground_truth is not None and converted.ground_truth is not None:
            np.testing.assert_array_equal(original.ground_truth.poses, converted.ground_truth.poses)
            np.testing.assert_array_equal(original.ground_truth.stamp_ns, converted.ground_truth.stamp_ns)
        assert original.rig.left_T_right.tobytes() == converted.rig.left_T_right.tobytes()
        assert original.rig.body_T_left.tobytes() == converted.rig.body_T_left.tobytes()
        assert original.rig.left.params.tobytes() == converted.rig.left.params.tobytes()
