"""The rectify command on rendered and real pairs, the matcher that measures its rows, and the rectified source."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from stereo_sfm.calib import load_rig
from stereo_sfm.calib.matches import match_pair
from stereo_sfm.calib.rectification import rectify
from stereo_sfm.cli import main
from stereo_sfm.drivers.rectified import RectifiedSource, rectified
from stereo_sfm.drivers.source import open_source
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from tests.drivers.dataset_folders import make_images

SIM = "sim:aisle?frames=2"


def test_rendered_fisheye_rows_agree_below_a_tenth_of_a_pixel() -> None:
    with open_source(SIM) as source:
        image = next(iter(source))
        assert image.right is not None
        for projection, hfov in (("epipolar", None), ("pinhole", 100.0)):
            rectification = rectify(source.rig, projection, hfov)
            matches = match_pair(rectification, *rectification.apply(image.left, image.right))
            assert len(matches) > 150
            assert abs(np.median(matches.row_error)) < 0.02
            assert np.median(np.abs(matches.row_error)) < 0.1
            assert np.mean(np.abs(matches.row_error) < 0.5) > 0.9


def test_the_matcher_sees_a_turned_camera() -> None:
    from dataclasses import replace

    with open_source(SIM) as source:
        image = next(iter(source))
        rig = source.rig
        assert image.right is not None
        turn = se3.exp(np.array([0, 0, 0, np.deg2rad(0.2), 0, 0]))
        rectification = rectify(replace(rig, left_T_right=rig.left_T_right @ turn), "epipolar")
        matches = match_pair(rectification, *rectification.apply(image.left, image.right))
    expected = np.deg2rad(0.2) * rectification.rig.left.fy
    assert abs(np.median(matches.row_error)) == pytest.approx(expected, abs=0.15)


def test_command_writes_images_rig_and_row_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "rect"
    assert main(["rectify", SIM, "-o", str(out), "--frames", "2"]) == 0
    text = capsys.readouterr().out
    assert "2 pairs" in text and "row error of" in text
    pictures = sorted(out.glob("pair_*.png"))
    assert len(pictures) == 2
    rig = load_rig(out / "rig.yaml")
    picture = cv2.imread(str(pictures[0]))
    assert picture is not None and picture.shape == (rig.left.height, 2 * rig.left.width + 4, 3)
    assert rig.left.model == "epipolar" and rig.left_T_right[0, 3] == pytest.approx(rig.baseline)
    assert main(["rectify", SIM, "-o", str(out)]) == 2
    assert "not empty" in capsys.readouterr().err
    assert main(["rectify", SIM, "-o", str(tmp_path / "p"), "--size", "640by480"]) == 2
    assert main(["rectify", SIM, "-o", str(tmp_path / "q"), "--rig", "/nonexistent.yaml"]) == 2


def test_a_folder_without_a_calibration_of_its_own(tmp_path: Path) -> None:
    make_images(tmp_path / "data")
    (tmp_path / "data" / "rig.yaml").rename(tmp_path / "rig.yaml")
    command = ["rectify", str(tmp_path / "data"), "--rig", str(tmp_path / "rig.yaml"), "-o", str(tmp_path / "out")]
    assert main(command) == 0
    assert load_rig(tmp_path / "out" / "rig.yaml").left.model == "epipolar"


@pytest.mark.parametrize(
    ("folder", "projection", "median"),
    [("kitti/sequences/00", "pinhole", 0.5), ("euroc_mh01", "pinhole", 0.3), ("tum_vi_room1", "epipolar", 0.6)],
)
def test_real_pairs(data_root: Path, folder: str, projection: str, median: float) -> None:
    with open_source(data_root / folder) as source:
        image = next(iter(source))
        assert image.right is not None
        rectification = rectify(source.rig, projection)
        matches = match_pair(rectification, *rectification.apply(image.left, image.right))
    assert len(matches) > 60
    assert np.median(np.abs(matches.row_error)) < median


def test_rectified_source_turns_rig_images_and_truth_together() -> None:
    with open_source(SIM) as source, RectifiedSource(source, "pinhole", 90.0, (400, 300)) as turned:
        image = next(iter(turned))
        assert image.left.shape == (300, 400) and image.right is not None and image.right.shape == (300, 400)
        assert turned.ground_truth is not None and source.ground_truth is not None
        relative = se3.inverse(source.ground_truth.poses) @ turned.ground_truth.poses
        np.testing.assert_allclose(relative, np.broadcast_to(relative[0], relative.shape), atol=1e-9)
        np.testing.assert_allclose(relative[0], turned.rectification.cam_T_rect, atol=1e-9)
        assert rectified(source, "none") is source
        with pytest.raises(StereoSfmError, match="unknown projection"):
            rectified(source, "round")
