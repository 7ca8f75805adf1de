"""Calibration of wheel odometry: kinematics, files, errors."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stereo_sfm.calib import load_rig, save_rig
from stereo_sfm.calib.formats.native import rig_from_text, rig_to_text
from stereo_sfm.calib.formats.wheel_files import read_t265_odometry
from stereo_sfm.calib.rectification import rectify
from stereo_sfm.calib.rig import Rig
from stereo_sfm.calib.wheel import Wheel
from stereo_sfm.cli import main
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Pinhole
from stereo_sfm.recording.describe import rig_lines
from stereo_sfm.types import WheelSamples

LEFT_T_WHEEL = se3.exp(np.array([0.1, 0.8, -0.3, 1.2, -1.2, 1.2]))
WHEELS = {
    "differential": Wheel(LEFT_T_WHEEL, "differential", (0.081, 0.079), 0.42),
    "skid_steer": Wheel(LEFT_T_WHEEL, "skid_steer", (0.1, 0.1, 0.1, 0.1), 0.7),
    "mecanum": Wheel(LEFT_T_WHEEL, "mecanum", (0.08,) * 4, 0.4, 0.3),
}


def rig(wheel: Wheel | None) -> Rig:
    camera = Pinhole(64, 48, 50.0, 50.0, 32.0, 24.0)
    body_T_left = se3.exp(np.array([0.2, 0.1, 0.5, -1.2, 1.2, -1.2]))
    return Rig(
        camera, camera, se3.from_rotation_translation(np.eye(3), np.array([0.1, 0, 0])), body_T_left, wheel=wheel
    )


@pytest.mark.parametrize("model", WHEELS)
def test_speeds_of_wheels_and_velocities_are_each_others_inverse(model: str) -> None:
    wheel, rng = WHEELS[model], np.random.default_rng(0)
    linear, angular = np.zeros((9, 3)), np.zeros((9, 3))
    linear[:, 0], angular[:, 2] = rng.normal(0, 1, (2, 9))
    linear[:, 1] = rng.normal(0, 1, 9) if model == "mecanum" else 0.0
    samples = WheelSamples.of_wheels(np.arange(9), wheel.speeds(linear, angular))
    np.testing.assert_allclose(wheel.velocities(samples), (linear, angular), atol=1e-12)
    turning = WheelSamples.of_wheels(np.arange(1), np.array([[-1.0, 1.0, -1.0, 1.0][: len(wheel.radii_m)]]))
    ahead, turn = wheel.velocities(turning)
    assert abs(ahead[0, 1]) < 1e-12 and turn[0, 2] > 0, "right wheels ahead turn to the left"
    other = WheelSamples.of_wheels(np.arange(1), np.ones((1, 3)))
    assert np.isnan(wheel.velocities(other)[0]).all()


def test_velocities_are_corrected() -> None:
    wheel = Wheel(linear_matrix=np.diag([1.02, 1.0, 1.0]), angular_scale=0.9)
    samples = WheelSamples(np.arange(1), np.array([[2.0, 0, 0]]), np.array([[0, 0, 1.0]]))
    np.testing.assert_allclose(wheel.velocities(samples), ([[2.04, 0, 0]], [[0, 0, 0.9]]))


@pytest.mark.parametrize("wheel", [*WHEELS.values(), Wheel(LEFT_T_WHEEL, linear_matrix=2 * np.eye(3), offset_s=0.02)])
def test_wheels_are_part_of_a_rig_file(tmp_path: Path, wheel: Wheel) -> None:
    save_rig(rig(wheel), tmp_path / "rig.yaml")
    found = load_rig(tmp_path / "rig.yaml").wheel
    assert found is not None
    for name in Wheel.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(found, name), getattr(wheel, name))
    save_rig(rig(None), tmp_path / "without.yaml")
    assert "wheel" not in (tmp_path / "without.yaml").read_text()
    assert any(line.startswith(f"wheels {wheel.model}") for line in rig_lines(rig(wheel)))


def test_the_pose_may_be_given_in_the_body() -> None:
    text = rig_to_text(rig(None)) + "wheel:\n  model: differential\n  radii_m: [0.1, 0.1]\n  track_m: 0.5\n"
    text += "  body_T_wheel: [1, 0, 0, 0.3, 0, 1, 0, 0, 0, 0, 1, -0.2]\n"
    found = rig_from_text(text, "text")
    assert found.wheel is not None
    np.testing.assert_allclose((found.body_T_left @ found.wheel.left_T_wheel)[:3, 3], [0.3, 0, -0.2], atol=1e-12)
    with pytest.raises(StereoSfmError, match="unknown wheel key: radius"):
        rig_from_text(text + "  radius: 3\n", "text")


def test_wheels_stay_where_they_are_when_a_rig_is_rectified() -> None:
    found = rectify(rig(WHEELS["differential"]), "pinhole")
    assert found.rig.wheel is not None
    np.testing.assert_allclose(found.cam_T_rect @ found.rig.wheel.left_T_wheel, LEFT_T_WHEEL, atol=1e-12)


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"model": "tank"}, "model 'tank'"),
        ({"radii_m": (0.1,)}, "have 2 radii, not 1"),
        ({"radii_m": (0.1, -0.1)}, "not positive"),
        ({"track_m": float("nan")}, "not positive"),
        ({"offset_s": 5.0}, "offset of 5 s"),
        ({"left_T_wheel": 2 * np.eye(4)}, "not rigid"),
    ],
)
def test_impossible_wheels_are_refused(wrong: dict[str, object], says: str) -> None:
    with pytest.raises(StereoSfmError, match=says):
        replace(WHEELS["differential"], **wrong)


def test_the_t265_odometry_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A camera that looks ahead, half a metre before and above the axle: in the tracker's axes (right, up, back)."""
    turn = se3.so3_log(np.array([[0, -1.0, 0], [0, 0, 1.0], [-1.0, 0, 0]]))  # of x ahead, y left, z up
    meter = {
        "scale_and_alignment": [1.01, 0, 0, 0, 1, 0, 0, 0, 1],
        "noise_variance": 0.005,
        "extrinsics": {"T": [0, -0.5, 0.5], "W": turn.tolist()},
    }
    file = tmp_path / "calibration_odometry.json"
    file.write_text(json.dumps({"velocimeters": [meter]}))
    wheel = read_t265_odometry(file, rig(None).left_T_right)
    np.testing.assert_allclose(wheel.left_T_wheel[:3, 3], [0.05, 0.5, -0.5])
    np.testing.assert_allclose(wheel.left_T_wheel[:3, 0], [0, 0, 1], atol=1e-12)  # ahead is the optical axis
    np.testing.assert_allclose(wheel.left_T_wheel[:3, 2], [0, -1, 0], atol=1e-12)
    assert wheel.linear_matrix[0, 0] == 1.01 and wheel.speed_noise == pytest.approx(0.01)
    save_rig(rig(None), tmp_path / "a.yaml")
    assert main(["convert-calib", str(tmp_path / "a.yaml"), str(tmp_path / "b.yaml"), "--wheel", str(file)]) == 0
    assert load_rig(tmp_path / "b.yaml").wheel is not None
    file.write_text('{"velocimeters": []}')
    with pytest.raises(StereoSfmError, match="T265 odometry"):
        read_t265_odometry(file, np.eye(4))
