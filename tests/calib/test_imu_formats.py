"""The IMU through the formats that store it: what they mean, and what they say is lost."""

from __future__ import annotations

import json
import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from stereo_sfm.calib import Rig, load_rig, save_rig
from stereo_sfm.calib.formats import FORMATS, WITH_IMU
from stereo_sfm.calib.formats.wheel_files import read_t265_odometry
from stereo_sfm.calib.imu import Imu
from stereo_sfm.calib.rectification import rectify
from stereo_sfm.calib.wheel import Wheel
from stereo_sfm.cli import main
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from tests.synthetic import fisheye_rig

POSE = se3.exp(np.array([0.03, -0.01, 0.02, 1.2, -0.4, 2.0]))
NOISE = {"gyro_noise": 1.6e-4, "accel_noise": 1.1e-3, "gyro_walk": 2e-5, "accel_walk": 4e-4, "rate_hz": 400.0}
PLAIN = Imu(POSE, **NOISE, offset_s=0.004)
_RNG = np.random.default_rng(5)
FULL = replace(
    PLAIN,
    gyro_matrix=np.eye(3) + _RNG.normal(0, 0.01, (3, 3)), gyro_bias=_RNG.normal(0, 0.01, 3),
    accel_matrix=np.eye(3) + _RNG.normal(0, 0.01, (3, 3)), accel_bias=_RNG.normal(0, 0.1, 3),
)  # fmt: skip
FILES = {
    "rig": "rig.yaml",
    "kalibr": "camchain.yaml",
    "euroc": "folder",
    "basalt": "basalt.json",
    "depthai": "oak.json",
}


def rig(imu: Imu | None, body: bool = False) -> Rig:
    return replace(
        fisheye_rig(), imu=imu, body_T_left=np.eye(4) if imu is None or not body else se3.inverse(imu.left_T_imu)
    )


def imu_of(found: Rig) -> Imu:
    assert found.imu is not None
    return found.imu


def in_left(imu: Imu, gyro: np.ndarray, accel: np.ndarray) -> np.ndarray:  # type: ignore[type-arg]
    """Corrected samples in the left camera's axes: the same whatever the sensor's own are called."""
    return np.hstack([part @ imu.left_T_imu[:3, :3].T for part in imu.correct(gyro, accel)])


@pytest.mark.parametrize("one", [False, True])
@pytest.mark.parametrize("name", ["rig", "kalibr", "euroc", "basalt", "depthai"])
def test_pose_and_noise_come_back(tmp_path: Path, name: str, one: bool) -> None:
    if name == "depthai" and one:
        pytest.skip("depthai's file is of a pair")
    whole = rig(PLAIN)
    saved = replace(whole, right=None) if one else whole
    save_rig(saved, tmp_path / FILES[name], name)
    back = imu_of(load_rig(tmp_path / FILES[name]))
    np.testing.assert_allclose(back.left_T_imu, PLAIN.left_T_imu, atol=1e-12)
    for key, value in NOISE.items():
        if name != "depthai" or key != "rate_hz":
            assert getattr(back, key) == pytest.approx(value)
    assert back.offset_s == pytest.approx(0.0 if name in ("euroc", "depthai") else 0.004)


@pytest.mark.parametrize("name", ["rig", "basalt", "depthai"])
def test_scale_and_biases_come_back(tmp_path: Path, name: str) -> None:
    save_rig(rig(FULL), tmp_path / FILES[name], name)
    back = load_rig(tmp_path / FILES[name])
    samples = _RNG.normal(0, 1, (20, 3)), _RNG.normal(0, 5, (20, 3))
    np.testing.assert_allclose(in_left(imu_of(back), *samples), in_left(FULL, *samples), atol=1e-9)
    np.testing.assert_allclose(imu_of(back).left_T_imu[:3, 3], FULL.left_T_imu[:3, 3], atol=1e-9)
    np.testing.assert_allclose(back.left_T_right, fisheye_rig().left_T_right, atol=1e-9)


def test_basalt_corrects_a_sample_as_we_do(tmp_path: Path) -> None:
    save_rig(rig(FULL), tmp_path / "basalt.json", "basalt")
    value = json.loads((tmp_path / "basalt.json").read_text())["value0"]
    a, g = np.array(value["calib_accel_bias"]), np.array(value["calib_gyro_bias"])
    accel_scale = np.array([[a[3], 0, 0], [a[4], a[6], 0], [a[5], a[7], a[8]]])
    gyro_scale = np.stack([g[3:6], g[6:9], g[9:12]], axis=1)  # by columns
    q = value["T_imu_cam"][0]
    imu_R_left = se3.rotation_from_quaternion(np.array([q[k] for k in ("qx", "qy", "qz", "qw")]))
    gyro, accel = np.array([0.3, -0.2, 0.5]), np.array([1.0, -9.0, 2.0])
    theirs = np.hstack([
        (gyro + gyro_scale @ gyro - g[:3]) @ imu_R_left, (accel + accel_scale @ accel - a[:3]) @ imu_R_left
    ])  # fmt: skip
    np.testing.assert_allclose(theirs, in_left(FULL, gyro[None], accel[None])[0], atol=1e-9)
    assert value["cam_time_offset_ns"] == 4_000_000 and value["imu_update_rate"] == 400.0
    assert value["gyro_noise_std"] == [1.6e-4] * 3


def test_kalibr_has_the_imu_as_its_body(tmp_path: Path) -> None:
    save_rig(rig(PLAIN, body=True), tmp_path / "camchain.yaml", "kalibr")
    chain = yaml.safe_load((tmp_path / "camchain.yaml").read_text())
    np.testing.assert_allclose(chain["cam0"]["T_cam_imu"], PLAIN.left_T_imu, atol=1e-12)
    expected = se3.inverse(fisheye_rig().left_T_right) @ PLAIN.left_T_imu
    np.testing.assert_allclose(chain["cam1"]["T_cam_imu"], expected, atol=1e-12)
    assert chain["cam0"]["timeshift_cam_imu"] == 0.004
    assert yaml.safe_load((tmp_path / "imu.yaml").read_text())["gyroscope_noise_density"] == 1.6e-4
    save_rig(rig(replace(PLAIN, rate_hz=100.0)), tmp_path / "camchain.yaml", "kalibr")  # over both
    assert imu_of(load_rig(tmp_path / "camchain.yaml")).rate_hz == 100.0
    with pytest.raises(StereoSfmError, match=r"would belong to other\.yaml"):
        save_rig(rig(None), tmp_path / "other.yaml", "kalibr")


@pytest.mark.parametrize("name", sorted(FORMATS))
def test_what_is_lost_is_said(tmp_path: Path, name: str, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING)
    body = se3.exp(np.array([1.0, 0, 0, 0, 0, 0.3]))
    whole = replace(rectify(rig(FULL), "pinhole").rig if name == "kitti" else rig(FULL), body_T_left=body)
    path = tmp_path / (FILES.get(name) or (name if FORMATS[name][3] else f"{name}.json"))
    save_rig(whole, path, name)
    said = caplog.text
    if name not in WITH_IMU:
        assert f"{name} cannot store an IMU" in said
    else:
        assert ("scale and misalignment and biases" in said) == (name in ("kalibr", "euroc"))
        assert ("time offset" in said) == (name in ("euroc", "depthai"))
    assert ("the body is the IMU" in said) == (name in ("kalibr", "basalt"))
    caplog.clear()
    save_rig(rig(PLAIN, body=True), tmp_path / "again" / path.name, name if name != "kitti" else "rig")
    assert (not caplog.text) == (name in ("rig", "kalibr", "basalt", "kitti"))


def test_the_t265_odometry_file_is_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    wheel = Wheel(se3.exp(np.array([0.1, 0.4, -0.5, 1.0, -1.2, 0.8])), linear_matrix=1.02 * np.eye(3), speed_noise=0.02)
    save_rig(replace(rig(None), wheel=wheel), tmp_path / "a.yaml")
    args = ["convert-calib", str(tmp_path / "a.yaml"), str(tmp_path / "b.yaml")]
    file = tmp_path / "calibration_odometry.json"
    assert main([*args, "--wheel-output", str(file)]) == 0
    back = read_t265_odometry(file, fisheye_rig().left_T_right)
    np.testing.assert_allclose(back.left_T_wheel, wheel.left_T_wheel, atol=1e-12)
    assert back.linear_matrix[0, 0] == pytest.approx(1.02) and back.speed_noise == pytest.approx(0.02)
    capsys.readouterr()
    assert main([*args, "--overwrite", "--wheel-output", str(tmp_path)]) == 2
    assert "cannot write" in capsys.readouterr().err
    save_rig(rig(None), tmp_path / "a.yaml")
    assert main([*args, "--overwrite", "--wheel-output", str(file)]) == 2
    assert "says nothing about wheels" in capsys.readouterr().err
