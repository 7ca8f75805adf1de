"""convert-calib: through every format and back, and our file read by depthai."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stereo_sfm.calib import Rig, formats, load_rig, save_rig
from stereo_sfm.calib.formats import FORMATS, recognise
from stereo_sfm.calib.imu import Imu
from stereo_sfm.calib.rectification import rectify
from stereo_sfm.cli import main
from stereo_sfm.commands.convert_calib import NAMES, SETTINGS
from stereo_sfm.geometry import se3
from tests.synthetic import fisheye_rig


def test_the_command_supports_every_format() -> None:
    assert tuple(FORMATS) == NAMES
    assert tuple(formats.SETTINGS) == SETTINGS


@pytest.mark.parametrize("name", [n for n in FORMATS if n != "kitti"])
def test_there_and_back(tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    rig = fisheye_rig()
    save_rig(rig, tmp_path / "rig.yaml")
    middle = tmp_path / (
        f"other.{'yml' if name == 'opencv' else 'json'}" if name not in ("rig", "kalibr") else "o.yaml"
    )
    assert main(["convert-calib", str(tmp_path / "rig.yaml"), str(middle), "--to", name]) == 0
    assert "kannala_brandt pair, baseline 64.0" in capsys.readouterr().out
    assert main(["convert-calib", str(middle), str(tmp_path / "back.yaml"), "--from", name]) == 0
    back = load_rig(tmp_path / "back.yaml")
    assert back.right is not None and rig.right is not None
    np.testing.assert_allclose(back.left_T_right, rig.left_T_right, atol=1e-12)
    np.testing.assert_allclose(back.left.params, rig.left.params, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(back.right.params, rig.right.params, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("name", [n for n, (*_, folder) in FORMATS.items() if not folder])
def test_a_file_is_recognised_by_its_content(tmp_path: Path, name: str) -> None:
    rig = rectify(fisheye_rig(), "pinhole").rig if name == "kitti" else fisheye_rig()
    save_rig(rig, tmp_path / "calibration", name)
    assert recognise(tmp_path / "calibration") == name


def test_depthai_reads_our_file_in_centimetres(tmp_path: Path) -> None:
    dai = pytest.importorskip("depthai")
    rig = fisheye_rig()
    save_rig(rig, tmp_path / "oak.json", "depthai")
    handler = dai.CalibrationHandler(str(tmp_path / "oak.json"))
    left, right = dai.CameraBoardSocket.CAM_B, dai.CameraBoardSocket.CAM_C
    theirs = np.array(handler.getCameraExtrinsics(left, right))
    expected = se3.inverse(rig.left_T_right)
    np.testing.assert_allclose(theirs[:3, :3], expected[:3, :3], atol=1e-6)
    np.testing.assert_allclose(theirs[:3, 3], 100 * expected[:3, 3], atol=1e-4)
    assert theirs[0, 3] < -6  # left to right: the right camera lies on the right
    back = load_rig(tmp_path / "oak.json")
    np.testing.assert_allclose(back.left_T_right, rig.left_T_right, atol=1e-12)
    assert back.imu is None


def test_depthai_reads_the_imu_of_our_file(tmp_path: Path) -> None:
    dai = pytest.importorskip("depthai")
    imu = Imu(se3.exp(np.array([0.038, -0.011, -0.009, 1.2, 0.4, -2.0])))
    save_rig(replace(fisheye_rig(), imu=imu), tmp_path / "oak.json", "depthai")
    handler = dai.CalibrationHandler(str(tmp_path / "oak.json"))
    for k, socket in enumerate((dai.CameraBoardSocket.CAM_B, dai.CameraBoardSocket.CAM_C)):
        theirs = np.array(handler.getImuToCameraExtrinsics(socket, False, dai.LengthUnit.METER))
        expected = imu.left_T_imu if k == 0 else se3.inverse(fisheye_rig().left_T_right) @ imu.left_T_imu
        np.testing.assert_allclose(theirs, expected, atol=1e-5)
    back = load_rig(tmp_path / "oak.json")
    assert back.imu is not None
    np.testing.assert_allclose(back.imu.left_T_imu, imu.left_T_imu, atol=1e-12)


def test_the_imu_of_a_board_is_where_the_driver_finds_it() -> None:
    dai = pytest.importorskip("depthai")
    path = Path(__file__).parents[1] / "drivers" / "fixtures" / "oak_d.json"
    handler = dai.CalibrationHandler(str(path))
    rig = load_rig(path)
    assert rig.imu is not None
    theirs = np.array(handler.getImuToCameraExtrinsics(dai.CameraBoardSocket.CAM_B, False, dai.LengthUnit.METER))
    np.testing.assert_allclose(rig.imu.left_T_imu, theirs, atol=1e-5)


def test_kitti_needs_a_rectified_pair_and_files_are_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save_rig(fisheye_rig(), tmp_path / "rig.yaml")
    assert main(["convert-calib", str(tmp_path / "rig.yaml"), str(tmp_path / "calib.txt"), "--to", "kitti"]) == 2
    assert "rectify first" in capsys.readouterr().err
    assert main(["convert-calib", str(tmp_path / "rig.yaml"), str(tmp_path / "rig.yaml")]) == 2
    assert "exists" in capsys.readouterr().err
    assert main(["convert-calib", str(tmp_path / "none.yaml"), str(tmp_path / "o.yaml")]) == 2
    assert main(["convert-calib", str(tmp_path / "rig.yaml"), str(tmp_path / "o.yaml"), "--size", "3x3"]) == 2
    capsys.readouterr()


def test_size_option_for_opencv_files_without_one(tmp_path: Path, data_root: Path) -> None:
    source = data_root / "calib_chessboard_pinhole" / "intrinsics.yml"
    assert main(["convert-calib", str(source), str(tmp_path / "rig.yaml"), "--size", "640x480"]) == 2  # no R and T
    save_rig(Rig(fisheye_rig().left), tmp_path / "one.yml", "opencv")
    assert main(["convert-calib", str(tmp_path / "one.yml"), str(tmp_path / "one.yaml")]) == 0
    assert load_rig(tmp_path / "one.yaml").right is None
