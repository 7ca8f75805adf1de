"""Settings of ORB-SLAM, stella_vslam, VINS and OpenVINS as calibrations: the numbers that their systems use."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from stereo_sfm.calib import Rig, load_rig
from stereo_sfm.calib.formats import recognise
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry.cameras import Fov, KannalaBrandt, Mei, Pinhole, RadTan

HEAD = "%YAML:1.0\n---\n"
# EuRoC's cameras, as ORB-SLAM2 and stella_vslam state them: original lenses and what rectifies them.
K_LEFT = "458.654, 0.0, 367.215, 0.0, 457.296, 248.375, 0.0, 0.0, 1.0"
K_RIGHT = "457.587, 0.0, 379.999, 0.0, 456.134, 255.238, 0.0, 0.0, 1"
D_LEFT = "-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05, 0.0"
D_RIGHT = "-0.28368365, 0.07451284, -0.00010473, -3.555907e-05, 0.0"
R_LEFT = (
    "0.999966347530033, -0.001422739138722922, 0.008079580483432283, 0.001365741834644127, 0.9999741760894847, "
    "0.007055629199258132, -0.008089410156878961, -0.007044357138835809, 0.9999424675829176"
)
R_RIGHT = (
    "0.9999633526194376, -0.003625811871560086, 0.007755443660172947, 0.003680398547259526, 0.9999684752771629, "
    "-0.007035845251224894, -0.007729688520722713, 0.007064130529506649, 0.999945173484644"
)
CENTRE = "435.2046959714599, 0, 367.4517211914062, {tx}, 0, 435.2046959714599, 252.2008514404297, 0, 0, 0, 1, 0"


def matrix(name: str, rows: int, cols: int, data: str) -> str:
    return f"{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {cols}\n   dt: d\n   data: [{data}]\n"


def orbslam2_euroc() -> str:
    out = HEAD + "Camera.fx: 435.2\nCamera.fy: 435.2\nCamera.cx: 367.4\nCamera.cy: 252.2\nCamera.bf: 47.9\n"
    for side, k, d, r, tx in (
        ("LEFT", K_LEFT, D_LEFT, R_LEFT, "0"),
        ("RIGHT", K_RIGHT, D_RIGHT, R_RIGHT, "-47.90639384423901"),
    ):
        out += f"{side}.height: 480\n{side}.width: 752\n" + matrix(f"{side}.K", 3, 3, k) + matrix(f"{side}.D", 1, 5, d)
        out += matrix(f"{side}.R", 3, 3, r) + matrix(f"{side}.P", 3, 4, CENTRE.format(tx=tx))
    return out


STELLA = f"""
Camera:
  name: "EuRoC stereo"
  setup: "stereo"
  model: "perspective"
  fx: 435.2046959714599
  fy: 435.2046959714599
  cx: 367.4517211914062
  cy: 252.2008514404297
  k1: 0.0
  k2: 0.0
  p1: 0.0
  p2: 0.0
  k3: 0.0
  fps: 20.0
  cols: 752
  rows: 480
  focal_x_baseline: 47.90639384423901
  color_order: "Gray"
StereoRectifier:
  K_left: [{K_LEFT}]
  D_left: [{D_LEFT}]
  R_left: [{R_LEFT}]
  K_right: [{K_RIGHT}]
  D_right: [{D_RIGHT}]
  R_right: [{R_RIGHT}]
"""


def of_text(folder: Path, text: str, name: str = "settings.yaml", **options: object) -> Rig:
    (folder / name).write_text(text)
    return load_rig(folder / name, **options)


@pytest.mark.parametrize(("kind", "text"), [("orbslam", orbslam2_euroc()), ("stella", STELLA)])
def test_original_lenses_of_settings_that_rectify(tmp_path: Path, kind: str, text: str, data_root: Path) -> None:
    rig = of_text(tmp_path, text)
    assert recognise(tmp_path / "settings.yaml") == kind
    true = load_rig(data_root / "euroc_mh01")
    assert rig.right is not None and true.right is not None
    assert isinstance(rig.left, RadTan) and rig.left.size == (752, 480)
    np.testing.assert_allclose(rig.left.params, true.left.params, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(rig.right.params, true.right.params, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(rig.left_T_right, true.left_T_right, atol=2e-5)


def test_orbslam2_rectified_and_depth(tmp_path: Path) -> None:
    camera = HEAD + "Camera.fx: 718.856\nCamera.fy: 718.856\nCamera.cx: 607.2\nCamera.cy: 185.2\nCamera.k1: 0.0\n"
    rig = of_text(tmp_path, camera + "Camera.width: 1241\nCamera.height: 376\nCamera.bf: 386.1448\n")
    assert isinstance(rig.left, Pinhole) and rig.baseline == pytest.approx(386.1448 / 718.856, abs=1e-12)
    with pytest.raises(StereoSfmError, match=r"no image size stated .*--size WxH"):
        of_text(tmp_path, camera)
    depth = camera.replace("k1: 0.0", "k1: 0.26") + "Camera.bf: 40.0\nDepthMapFactor: 5000.0\n"
    rig = of_text(tmp_path, depth, size=(640, 480))
    assert rig.right is None and rig.left.size == (640, 480) and rig.left.distortion == (0.26,)
    with pytest.raises(StereoSfmError, match="baseline of rectified images and a lens that distorts"):
        of_text(tmp_path, depth.replace("DepthMapFactor", "Other"), size=(640, 480))


@pytest.mark.parametrize("model", ["radial_division", "equirectangular"])
def test_lenses_that_we_have_not_are_refused(model: str, tmp_path: Path) -> None:
    """Also where the file lacks the focal length, which an equirectangular image has not."""
    stella = STELLA.replace('"perspective"', f'"{model}"')
    for text in (stella, f"Camera:\n  name: x\n  model: {model}\n  cols: 64\n  rows: 32\n"):
        with pytest.raises(StereoSfmError, match=f"Camera.model '{model}' is not supported .*perspective, fisheye"):
            of_text(tmp_path, text)
    orbslam = orbslam2_euroc().split("LEFT")[0] + f'Camera.type: "{model}"\n'
    with pytest.raises(StereoSfmError, match=f"Camera.type '{model}' is not supported .*pinhole, rectified") as refused:
        of_text(tmp_path, orbslam)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("old", [False, True])
def test_orbslam3_fisheye_pair_with_imu(tmp_path: Path, old: bool) -> None:
    first, pose, body = ("Camera", "Tlr", "Tbc") if old else ("Camera1", "Stereo.T_c1_c2", "IMU.T_b_c1")
    text = HEAD + 'File.version: "1.0"\nCamera.type: "KannalaBrandt8"\nCamera.width: 512\nCamera.height: 512\n'
    for name, fx in ((first, 190.9), ("Camera2", 190.4)):
        values = {"fx": fx, "fy": fx, "cx": 254.9, "cy": 256.8, "k1": 0.0034, "k2": 0.0007, "k3": -0.002, "k4": 0.0002}
        text += "".join(f"{name}.{key}: {value}\n" for key, value in values.items())
    text += matrix(
        pose, 3 if old else 4, 4, "1, 0, 0, 0.101, 0, 1, 0, 0.002, 0, 0, 1, 0.001" + ("" if old else ", 0, 0, 0, 1")
    )
    text += matrix(body, 4, 4, "0, -1, 0, 0.04, 1, 0, 0, 0.05, 0, 0, 1, -0.06, 0, 0, 0, 1")
    text += "IMU.NoiseGyro: 0.00016\nIMU.NoiseAcc: 0.0028\nIMU.GyroWalk: 2.2e-05\nIMU.AccWalk: 0.00086\n"
    rig = of_text(tmp_path, text)
    assert isinstance(rig.left, KannalaBrandt) and rig.right is not None and rig.right.fx == 190.4
    np.testing.assert_allclose(rig.left_T_right[:3, 3], [0.101, 0.002, 0.001])
    np.testing.assert_allclose(rig.body_T_left[:3, 3], [0.04, 0.05, -0.06])
    assert rig.imu is not None and rig.imu.gyro_noise == 0.00016 and rig.imu.accel_walk == 0.00086
    np.testing.assert_allclose(rig.imu.left_T_imu @ rig.body_T_left, np.eye(4), atol=1e-15)


def test_vins_fusion_with_its_camera_files(tmp_path: Path) -> None:
    camera = (
        "%YAML:1.0\n---\nmodel_type: MEI\ncamera_name: camera\nimage_width: 752\nimage_height: 480\n"
        "mirror_parameters:\n   xi: {xi}\ndistortion_parameters:\n"
        "   k1: -0.01\n   k2: 0.02\n   p1: 0.001\n   p2: -0.002\n"
        "projection_parameters:\n   gamma1: 763.5\n   gamma2: 762.6\n   u0: 379.9\n   v0: 248.3\n"
    )
    for k, xi in enumerate((1.9, 2.0)):
        (tmp_path / f"cam{k}_mei.yaml").write_text(camera.format(xi=xi))
    text = HEAD + 'imu: 1\nnum_of_cam: 2\ncam0_calib: "cam0_mei.yaml"\ncam1_calib: "cam1_mei.yaml"\ntd: 0.004\n'
    text += matrix("body_T_cam0", 4, 4, "0, -1, 0, -0.02, 1, 0, 0, -0.06, 0, 0, 1, 0.01, 0, 0, 0, 1")
    text += matrix("body_T_cam1", 4, 4, "0, -1, 0, -0.02, 1, 0, 0, 0.05, 0, 0, 1, 0.01, 0, 0, 0, 1")
    rig = of_text(tmp_path, text)
    assert recognise(tmp_path / "settings.yaml") == "vins"
    assert isinstance(rig.left, Mei) and rig.left.distortion == (1.9, -0.01, 0.02, 0.001, -0.002)
    assert rig.left.published_focal == pytest.approx((763.5, 762.6))
    assert rig.right is not None and rig.right.distortion[0] == 2.0
    np.testing.assert_allclose(rig.left_T_right[:3, 3], [0.11, 0, 0], atol=1e-12)
    assert rig.imu is not None and rig.imu.offset_s == 0.004
    alone = load_rig(tmp_path / "cam1_mei.yaml")
    assert alone.right is None and alone.left.distortion[0] == 2.0
    (tmp_path / "cam1_mei.yaml").unlink()
    with pytest.raises(StereoSfmError, match=r"cam1_mei\.yaml does not exist"):
        load_rig(tmp_path / "settings.yaml")


def test_vins_mono_and_its_other_models(tmp_path: Path) -> None:
    text = HEAD + "model_type: KANNALA_BRANDT\nimage_width: 640\nimage_height: 480\nprojection_parameters:\n"
    text += (
        "   k2: 0.01\n   k3: 0.02\n   k4: 0.03\n   k5: 0.04\n   mu: 275.1\n   mv: 274.9\n   u0: 315.9\n   v0: 247.5\n"
    )
    text += matrix("extrinsicRotation", 3, 3, "0, -1, 0, 1, 0, 0, 0, 0, 1")
    text += matrix("extrinsicTranslation", 3, 1, "0.02, 0.03, 0.04")
    rig = of_text(tmp_path, text)
    assert isinstance(rig.left, KannalaBrandt) and rig.left.distortion == (0.01, 0.02, 0.03, 0.04)
    np.testing.assert_allclose(rig.body_T_left[:3, 3], [0.02, 0.03, 0.04])
    with pytest.raises(StereoSfmError, match="'SCARAMUZZA' is not supported"):
        of_text(tmp_path, text.replace("KANNALA_BRANDT", "SCARAMUZZA"))


def chain(camera: str, pose: str) -> str:
    poses = ("1.0, 0.0, 0.0, 0.01", "1.0, 0.0, 0.0, 0.11")
    out = ""
    for k, x in enumerate(poses):
        rows = f"    - [{x}]\n    - [0.0, 1.0, 0.0, 0.02]\n    - [0.0, 0.0, 1.0, 0.03]\n    - [0.0, 0.0, 0.0, 1.0]\n"
        out += f"cam{k}:\n  {pose}:\n{rows}  timeshift_cam_imu: 0.003\n  resolution: [752, 480]\n{camera}"
    return out


def test_openvins_states_the_inverse_of_kalibrs_pose(tmp_path: Path) -> None:
    camera = "  camera_model: pinhole\n  intrinsics: [458.6, 457.2, 367.2, 248.3]\n  distortion_model: radtan\n"
    camera += "  distortion_coeffs: [-0.28, 0.07, 0.0002, 1.8e-05]\n"
    (tmp_path / "kalibr_imucam_chain.yaml").write_text(HEAD + chain(camera, "T_imu_cam"))
    (tmp_path / "imu_chain.yaml").write_text(
        HEAD + "imu0:\n  accelerometer_noise_density: 0.002\n  gyroscope_noise_density: 0.00017\n  update_rate: 200.0\n"
    )
    text = HEAD + 'verbosity: "INFO"\nrelative_config_imu: "imu_chain.yaml"\n'
    rig = of_text(tmp_path, text + 'relative_config_imucam: "kalibr_imucam_chain.yaml"\n', "estimator_config.yaml")
    assert rig.left_T_right[0, 3] == pytest.approx(0.1)
    np.testing.assert_allclose(rig.body_T_left[:3, 3], [0.01, 0.02, 0.03])
    assert rig.imu is not None and rig.imu.accel_noise == 0.002 and rig.imu.offset_s == 0.003
    assert load_rig(tmp_path / "kalibr_imucam_chain.yaml").baseline == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("model", "before", "lens", "after", "distortion"),
    [
        ("omni", "1.9, ", "radtan", "[-0.01, 0.02, 0.001, -0.002]", (1.9, -0.01, 0.02, 0.001, -0.002)),
        ("ds", "-0.17, 0.59, ", "none", "[]", (-0.17, 0.59)),
        ("eucm", "0.63, 1.04, ", "none", "[]", (0.63, 1.04)),
        ("pinhole", "", "fov", "[0.93]", (0.93,)),
    ],
)
def test_kalibrs_other_models(
    tmp_path: Path, model: str, before: str, lens: str, after: str, distortion: tuple[float, ...]
) -> None:
    camera = f"  camera_model: {model}\n  intrinsics: [{before}458.6, 457.2, 367.2, 248.3]\n"
    camera += f"  distortion_model: {lens}\n  distortion_coeffs: {after}\n"
    rig = of_text(tmp_path, chain(camera, "T_cam_imu"))
    assert rig.left.distortion == distortion and rig.left.published_focal == pytest.approx((458.6, 457.2))
    if model == "pinhole":
        assert isinstance(rig.left, Fov)


def test_any_two_cameras_of_a_chain(tmp_path: Path) -> None:
    step = (
        "  T_cn_cnm1:\n  - [1.0, 0.0, 0.0, {x}]\n  - [0.0, 1.0, 0.0, 0.0]\n  - [0.0, 0.0, 1.0, 0.0]\n  - [0, 0, 0, 1]\n"
    )
    text = ""
    for k, x in enumerate((0, -0.06, -0.07)):
        text += (
            f"cam{k}:\n"
            + (step.format(x=x) if k else "")
            + f"  camera_model: pinhole\n  intrinsics: [{400 + k}, 400, 320, 240]\n"
        )
        text += "  distortion_model: none\n  distortion_coeffs: []\n  resolution: [640, 480]\n"
    for pair, right in (((0, 1), 0.06), ((0, 2), 0.13), ((1, 2), 0.07), ((2, 0), -0.13)):
        rig = of_text(tmp_path, text, pair=pair)
        assert rig.right is not None and (rig.left.fx, rig.right.fx) == tuple(400 + k for k in pair)
        np.testing.assert_allclose(rig.left_T_right[:3, 3], [right, 0, 0], atol=1e-12)
    with pytest.raises(StereoSfmError, match="key 'cam3' is missing"):
        of_text(tmp_path, text, pair=(0, 3))
    with pytest.raises(StereoSfmError, match="format kalibr is read with pair, unit, not with size"):
        of_text(tmp_path, text, size=(1, 2))
