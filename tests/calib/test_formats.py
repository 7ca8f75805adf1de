"""Every format: round trips, conventions on known rigs, and one line for what is missing or malformed."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from stereo_sfm.calib import Rig, load_rig, save_rig
from stereo_sfm.calib.formats import FORMATS, recognise
from stereo_sfm.calib.formats.euroc import read_euroc
from stereo_sfm.calib.formats.kalibr import read_kalibr
from stereo_sfm.calib.formats.kapture import read_kapture
from stereo_sfm.calib.formats.kitti import read_kitti
from stereo_sfm.calib.formats.opencv import read_opencv
from stereo_sfm.calib.imu import Imu
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import (
    Camera,
    DoubleSphere,
    Epipolar,
    Eucm,
    Fov,
    KannalaBrandt,
    Mei,
    Pinhole,
    RadTan,
    Tilted,
)
from tests.synthetic import fisheye_rig

NEARLY = se3.exp(np.array([0.0639, 3e-4, -2e-4, 0.004, -0.011, 0.002]))  # left_T_right
BODY = se3.exp(np.array([0.02, -0.04, 0.01, 1.2, -0.3, 0.9]))  # body_T_left
FISHEYE = Rig(
    KannalaBrandt(848, 800, 286.2216, 287.4801, 419.467, 386.9751, (-0.004348, 0.037126, -0.035539, 0.005773)),
    KannalaBrandt(848, 800, 285.2292, 286.3337, 422.039, 397.016, (-0.005279, 0.038634, -0.036636, 0.006108)),
    NEARLY,
    BODY,
    name="t265",
    serial="845412110103",
)
RADTAN = Rig(
    RadTan(752, 480, 458.654, 457.296, 367.215, 248.375, (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05)),
    RadTan(752, 480, 457.587, 456.134, 379.999, 255.238, (-0.28368365, 0.07451284, -0.00010473, -3.5559e-05)),
    NEARLY,
    BODY,
)
RATIONAL = Rig(
    RadTan(1280, 800, 799.7, 799.1, 640.5, 402.2, (8.1, -3.2, 1e-4, -2e-4, 0.4, 8.4, -2.1, 0.2)),
    RadTan(1280, 800, 801.2, 800.3, 631.5, 398.2, (7.9, -3.1, -1e-4, 2e-4, 0.3, 8.2, -2.0, 0.1)),
    NEARLY,
)
IDEAL = Rig(
    Pinhole(1241, 376, 718.856, 718.856, 607.1928, 185.2157),
    Pinhole(1241, 376, 718.856, 718.856, 607.1928, 185.2157),
    se3.from_rotation_translation(np.eye(3), np.array([0.537165718864418, 0, 0])),
)
OAK = (0.32, -0.06, -3.7e-05, 7.6e-05, -0.0023, 0.654, -0.034, -0.009, 0.0011, -0.0004, 0.0007, 0.0002, 0.003, -0.001)
FEW = {  # lenses that few formats know, and those
    "tilted": (Tilted, OAK, ("rig", "ros", "opencv", "foxglove", "depthai")),
    "fov": (Fov, (0.93,), ("rig", "kalibr", "colmap", "kapture")),
    "mei": (Mei, (1.9, -0.01, 0.02, 0.001, -0.002), ("rig", "kalibr")),
    "double_sphere": (DoubleSphere, (-0.17, 0.59), ("rig", "kalibr", "basalt")),
    "eucm": (Eucm, (0.63, 1.04), ("rig", "kalibr", "basalt")),
}
OTHERS = {
    name: Rig(lens(1280, 800, 577.8, 577.9, 627.2, 410.3, d), lens(1280, 800, 578.8, 577.1, 630.2, 407.3, d), NEARLY)
    for name, (lens, d, _) in FEW.items()
}
RIGS = {"fisheye": FISHEYE, "radtan": RADTAN, "rational": RATIONAL, "ideal": IDEAL} | OTHERS
FILES = {"rig": "rig.yaml", "kalibr": "camchain.yaml", "opencv": "stereo.yml", "kitti": "calib.txt"}
NO_BODY = ("depthai", "ros", "opencv", "kitti", "colmap", "foxglove")  # dialects that have no place for body_T_left
CANNOT = {("kitti", r) for r in ("fisheye", "radtan", "rational")} | {("kalibr", "rational"), ("euroc", "rational")}
CANNOT |= {(f, name) for name, (_, _, known) in FEW.items() for f in FORMATS if f not in known}


def target(folder: Path, name: str) -> Path:
    return folder / (FILES.get(name) or (name if FORMATS[name][3] else f"{name}.json"))


def same_lens(a: Camera, b: Camera, tolerance: float) -> None:
    assert a.model == b.model
    assert a.size == b.size
    np.testing.assert_allclose(a.params, b.params, rtol=tolerance, atol=tolerance)


def same_rig(a: Rig, b: Rig, tolerance: float, body: bool) -> None:
    same_lens(a.left, b.left, tolerance)
    assert a.right is not None and b.right is not None
    same_lens(a.right, b.right, tolerance)
    np.testing.assert_allclose(b.left_T_right, a.left_T_right, rtol=0, atol=max(tolerance, 1e-15))
    if body:
        np.testing.assert_allclose(b.body_T_left, a.body_T_left, rtol=0, atol=max(tolerance, 1e-15))


@pytest.mark.parametrize("rig_name", RIGS)
@pytest.mark.parametrize("name", FORMATS)
def test_round_trip(tmp_path: Path, name: str, rig_name: str) -> None:
    rig, path = RIGS[rig_name], target(tmp_path, name)
    if (name, rig_name) in CANNOT:
        with pytest.raises(StereoSfmError):
            save_rig(rig, path, name)
        return
    save_rig(rig, path, name)
    assert recognise(path) == name
    same_rig(rig, load_rig(path), 1e-12, body=name not in NO_BODY)


def test_own_file_keeps_every_bit(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    for i in range(50):
        params = rng.standard_normal(8) * 10.0 ** rng.integers(-9, 3, 8)
        rig = Rig(
            KannalaBrandt(848, 800, 286 + params[0], 286, 424, 400 + params[1], tuple(params[2:6] * 1e-3)),
            Epipolar(900, 800, 300 + params[6], 300, 449.5, 399.5),
            se3.exp(rng.standard_normal(6)),
            se3.exp(rng.standard_normal(6)),
            depth=bool(i % 2),
            name="a: 'b'",
            serial="0012",
            readout_s=0.001 * abs(params[7]) / (1 + abs(params[7])),
        )
        save_rig(rig, tmp_path / "rig.yaml")
        back = load_rig(tmp_path / "rig.yaml")
        assert np.array_equal(back.left.params, rig.left.params) and np.array_equal(back.left_T_right, rig.left_T_right)
        assert back.right is not None and back.right.model == "epipolar" and back.right.fx == rig.right.fx  # type: ignore[union-attr]
        assert np.array_equal(back.body_T_left, rig.body_T_left)
        assert (back.depth, back.name, back.serial) == (rig.depth, rig.name, rig.serial)
        assert back.readout_s == rig.readout_s


def test_a_readout_that_a_dialect_cannot_state(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    rig = replace(RADTAN, readout_s=0.02)
    save_rig(rig, tmp_path / "rig.yaml")
    assert not caplog.records
    save_rig(rig, tmp_path / "camchain.yaml", "kalibr")
    assert "kalibr cannot store the readout" in caplog.text
    (tmp_path / "rig.yaml").write_text((tmp_path / "rig.yaml").read_text().replace("readout_s: 0.02", "readout_s:"))
    assert load_rig(tmp_path / "rig.yaml").readout_s == 0.0


def test_masks_and_depth_that_a_format_cannot_state(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    mask = np.ones((RADTAN.left.height, RADTAN.left.width), bool)
    masked = replace(RADTAN, right_mask=mask)
    virtual = replace(RADTAN, right=RADTAN.left, depth=True)
    for rig in (masked, virtual):
        save_rig(rig, tmp_path / "rig.yaml")
    assert not caplog.records
    save_rig(masked, tmp_path / "camchain.yaml", "kalibr")
    assert "kalibr cannot store what is masked" in caplog.text and "virtual" not in caplog.text
    save_rig(virtual, tmp_path / "stereo.yml", "opencv")
    assert "opencv cannot store that the right camera is virtual" in caplog.text


def test_a_readout_in_milliseconds_is_rejected() -> None:
    with pytest.raises(StereoSfmError, match="readout of 28 s; give the seconds"):
        Rig(FISHEYE.left, readout_s=28.0)


@pytest.mark.parametrize("name", [n for n in FORMATS if n not in ("kitti", "depthai")])
def test_one_camera(tmp_path: Path, name: str) -> None:
    rig = Rig(FISHEYE.left)
    save_rig(rig, target(tmp_path, name), name)
    back = load_rig(target(tmp_path, name), name)
    assert back.right is None
    same_lens(rig.left, back.left, 1e-12)


def test_kalibr_chain_is_cam1_from_cam0(data_root: Path) -> None:
    rig = read_kalibr(data_root / "tum_vi_room1" / "camchain.yaml")
    assert rig.left_T_right[0, 3] == pytest.approx(0.10092, abs=1e-4)  # the right camera is on the right
    assert rig.baseline == pytest.approx(0.10095, abs=1e-4)
    assert isinstance(rig.left, KannalaBrandt) and rig.left.size == (1024, 1024)
    # the chain and the two T_cam_imu of the same file agree
    import yaml

    chain = yaml.safe_load((data_root / "tum_vi_room1" / "camchain.yaml").read_text())
    left_T_imu, right_T_imu = (np.array(chain[c]["T_cam_imu"]) for c in ("cam0", "cam1"))
    np.testing.assert_allclose(rig.left_T_right, left_T_imu @ np.linalg.inv(right_T_imu), atol=1e-6)


def test_euroc_sensors(data_root: Path) -> None:
    rig = read_euroc(data_root / "euroc_mh01")
    assert rig.baseline == pytest.approx(0.11007, abs=1e-4)
    assert rig.left_T_right[0, 3] > 0.1
    assert rig.body_T_left[0, 3] == pytest.approx(-0.0216401454975)
    assert load_rig(data_root / "euroc_mh01").left.fx == 458.654


def test_kitti_baseline_and_size(data_root: Path) -> None:
    rig = read_kitti(data_root / "kitti" / "sequences" / "00")
    assert rig.left.size == (1241, 376)
    np.testing.assert_allclose(rig.left_T_right[:3, 3], [0.5371657, 0, 0], atol=1e-6)


def test_kitti_raw_colour_pair(tmp_path: Path) -> None:
    p2 = "721.5377 0 609.5593 44.85728 0 721.5377 172.854 0.2163791 0 0 1 0.002745884"
    p3 = "721.5377 0 609.5593 -339.5242 0 721.5377 172.854 2.199936 0 0 1 0.002729905"
    size = "S_rect_02: 1242 375\nS_rect_03: 1242 375\n"
    text = f"calib_time: 09-Jan-2012 13:57:47\n{size}P_rect_02: {p2}\nP_rect_03: {p3}\n"
    (tmp_path / "calib_cam_to_cam.txt").write_text(text)
    rig = read_kitti(tmp_path, pair=(2, 3))
    assert rig.left.size == (1242, 375)
    point = np.array([1.0, -2.0, 9.0, 1.0])  # in the reference camera
    for camera, cam_T_ref, p in (
        (rig.left, se3.inverse(rig.body_T_left), p2),
        (rig.right, se3.inverse(rig.body_T_left @ rig.left_T_right), p3),
    ):
        h = np.array(p.split(), float).reshape(3, 4) @ point
        assert camera is not None
        np.testing.assert_allclose(camera.project((cam_T_ref @ point)[:3]), h[:2] / h[2], atol=1e-9)


def test_kapture_of_the_t265(data_root: Path) -> None:
    extrinsics = se3.from_rotation_translation(np.eye(3), np.array([0.064, 0, 0]))
    path = data_root / "t265_office" / "kapture_sensors.txt"
    rig = read_kapture(path, extrinsics)
    assert rig.right is not None and rig.right.fx == 283.999 and rig.left.cx == 424.355
    with pytest.raises(StereoSfmError, match="extrinsics are missing"):
        read_kapture(path)


def test_opencv_sample_without_size_or_extrinsics(data_root: Path) -> None:
    path = data_root / "calib_chessboard_pinhole" / "intrinsics.yml"
    with pytest.raises(StereoSfmError, match="image size"):
        read_opencv(path)
    with pytest.raises(StereoSfmError, match="'R' is missing"):
        read_opencv(path, size=(640, 480))


def test_opencv_pair_is_right_from_left(tmp_path: Path) -> None:
    import cv2

    save_rig(FISHEYE, tmp_path / "a.yml", "opencv")
    storage = cv2.FileStorage(str(tmp_path / "a.yml"), cv2.FILE_STORAGE_READ)
    rotation, translation = storage.getNode("R").mat(), storage.getNode("T").mat()
    point_left = np.array([0.3, 0.2, 2.0])
    point_right = rotation @ point_left + translation.ravel()
    np.testing.assert_allclose(point_right, np.linalg.inv(NEARLY)[:3] @ [*point_left, 1.0], atol=1e-14)
    assert translation[0, 0] < 0


def test_ros_right_projection_has_minus_focal_times_baseline(tmp_path: Path) -> None:
    import yaml

    save_rig(IDEAL, tmp_path, "ros")
    right = yaml.safe_load((tmp_path / "right.yaml").read_text())["projection_matrix"]["data"]
    assert right[3] == pytest.approx(-386.1448, abs=1e-3)  # KITTI's own P1
    assert right[2] == 607.1928


def test_colmap_shifts_half_a_pixel_and_inverts_the_pose(tmp_path: Path) -> None:
    save_rig(FISHEYE, tmp_path, "colmap")
    cameras = (tmp_path / "cameras.txt").read_text().splitlines()
    assert float(cameras[1].split()[6]) == pytest.approx(419.967)
    assert float((tmp_path / "rigs.txt").read_text().splitlines()[-1].split()[11]) < -0.06  # tx of cam1_from_rig


def test_colmap_reads_what_pycolmap_means(tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    for rig in (FISHEYE, RADTAN, RATIONAL, IDEAL):
        save_rig(rig, tmp_path, "colmap")
        fields = (tmp_path / "cameras.txt").read_text().splitlines()[1].split()
        theirs = pycolmap.Camera(
            model=fields[1], width=int(fields[2]), height=int(fields[3]), params=[float(v) for v in fields[4:]]
        )
        point = np.array([0.3, -0.2, 1.0])
        ours = rig.left.project(point) + 0.5
        np.testing.assert_allclose(np.ravel(theirs.img_from_cam(point)), ours, atol=1e-9)


def test_basalt_quaternion_is_camera_to_body(tmp_path: Path) -> None:
    save_rig(FISHEYE, tmp_path / "b.json", "basalt")
    value = json.loads((tmp_path / "b.json").read_text())["value0"]
    assert value["intrinsics"][0]["camera_type"] == "kb4"
    second = value["T_imu_cam"][1]
    expected = (BODY @ NEARLY)[:3, 3]
    np.testing.assert_allclose([second["px"], second["py"], second["pz"]], expected, atol=1e-12)


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("camchain.yaml", "cam0: {camera_model: pinhole}", "'resolution' is missing"),
        ("camchain.yaml", "cam0: [1, 2\n", "not YAML"),
        ("camchain.yaml", "cam0: {camera_model: ocam, resolution: [1, 2]}", "'ocam' is not supported"),
        (
            "left.yaml",
            "camera_matrix: {data: [1, 2]}\nimage_width: 3\nimage_height: 4",
            "K has 2 numbers instead of 9",
        ),
        ("rig.yaml", "stereo_sfm_rig: 1\nbody_T_left: [[1, 0, 0, 0], [0, 1, 0]]", "4 rows of 4 .*different lengths"),
        ("rig.yaml", "stereo_sfm_rig: 1\nbody_T_left: [1, 0, 0]", "4 rows of 4 numbers .*, found 3"),
        ("rig.yaml", "stereo_sfm_rig: 2", "this version of the program reads 1"),
        ("rig.yaml", "hello: 1", "cannot detect the calibration format"),
        ("calib.txt", "P0: 1 2 3\nP1: 4", "expected 12 numbers"),
        ("b.json", '{"T_imu_cam": 3}', "'value0' is missing"),
        ("f.json", '[{"K": [0,0,0,0,0,0,0,0,0], "width": 1, "height": 1}]', "not calibrated"),
        ("f.json", '{"K": [1,', "malformed"),
        ("stereo.yml", "%YAML:1.0\nM1: !!opencv-matrix\n", "malformed"),
    ],
)
def test_malformed_files_give_one_line(tmp_path: Path, name: str, content: str, says: str) -> None:
    (tmp_path / name).write_text(content)
    with pytest.raises(StereoSfmError, match=says) as caught:
        load_rig(tmp_path / name)
    assert "\n" not in str(caught.value)


def test_one_camera_of_euroc_names_the_folder(tmp_path: Path) -> None:
    save_rig(Rig(Pinhole(64, 48, 50, 50, 32, 24)), tmp_path / "mav0", "euroc")
    with pytest.raises(StereoSfmError, match=r"one camera of two, give the folder .*mav0\)$"):
        load_rig(tmp_path / "mav0" / "cam0" / "sensor.yaml")


def test_a_rig_without_a_body_is_its_own(tmp_path: Path) -> None:
    rig = replace(fisheye_rig(), body_T_left=np.eye(4))
    save_rig(rig, tmp_path / "rig.yaml")
    data = yaml.safe_load((tmp_path / "rig.yaml").read_text())
    del data["body_T_left"]
    (tmp_path / "rig.yaml").write_text(yaml.safe_dump(data, sort_keys=False))
    assert np.array_equal(load_rig(tmp_path / "rig.yaml").body_T_left, np.eye(4))


def test_extrinsics_in_millimetres_are_refused() -> None:
    rig = fisheye_rig()
    far = rig.left_T_right.copy()
    far[:3, 3] *= 1000
    with pytest.raises(StereoSfmError, match=r"give the extrinsics in metres .*--unit mm"):
        replace(rig, left_T_right=far)


def test_missing_file_and_format(tmp_path: Path) -> None:
    with pytest.raises(StereoSfmError, match="no calibration at"):
        load_rig("/nonexistent/rig.yaml")
    with pytest.raises(StereoSfmError, match="does not exist"):
        read_euroc("/nonexistent")
    with pytest.raises(StereoSfmError, match="unknown calibration format"):
        save_rig(IDEAL, tmp_path / "x", "xyz")
    for name in ("ros", "kalibr", "opencv", "basalt", "euroc"):
        with pytest.raises(StereoSfmError):
            save_rig(Rig(Epipolar(10, 10, 5, 5, 5, 5)), tmp_path / "never", name)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("factor", [1.1, 1e200])
def test_scaled_rotation_is_refused(factor: float, tmp_path: Path) -> None:
    save_rig(FISHEYE, tmp_path / "camchain.yaml", "kalibr")
    text = (tmp_path / "camchain.yaml").read_text()
    import yaml

    data = yaml.safe_load(text)
    data["cam1"]["T_cn_cnm1"][0][0] *= factor
    (tmp_path / "camchain.yaml").write_text(yaml.safe_dump(data))
    with pytest.raises(StereoSfmError, match="not orthonormal"):
        load_rig(tmp_path / "camchain.yaml")


def test_euroc_files_with_opencvs_header_and_matrices(tmp_path: Path) -> None:
    """As Kimera-VIO's copy of EuRoC has them."""
    save_rig(RADTAN, tmp_path, "euroc")
    for path in tmp_path.rglob("sensor.yaml"):
        path.write_text("%YAML:1.0\n" + path.read_text().replace("T_BS:", "T_BS: !!opencv-matrix"))
    assert "opencv-matrix" in (tmp_path / "cam0" / "sensor.yaml").read_text()
    same_rig(RADTAN, load_rig(tmp_path), 1e-12, body=True)


def test_the_three_forms_of_opencvs_files(tmp_path: Path) -> None:
    """Files written by OpenCV are read in all its forms."""
    for name in ("stereo.yml", "stereo.xml", "stereo.json"):
        save_rig(RADTAN, tmp_path / name, "opencv")
        same_rig(RADTAN, read_opencv(tmp_path / name), 1e-12, body=False)


ALIASES = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{b}: &{b} [{', '.join([f'*{a}'] * 9)}]\n" for a, b in zip("abcdefghijklm", "bcdefghijklmn", strict=True)
)


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("rig.yaml", f"stereo_sfm_rig: 1\n{ALIASES}left: *n\n", "more values than any calibration"),
        ("rig.yaml", "stereo_sfm_rig: 1\nleft: " + "[" * 10_000, "nested too deeply"),
        ("rig.yaml", "stereo_sfm_rig: 1\nleft: &a {model: *a}\n", "contains itself"),
        ("rig.yaml", "stereo_sfm_rig: 1\nleft: 1" + ":1" * 50_000, "100001 characters"),
        ("rig.yaml", "stereo_sfm_rig: 1\n#" + "x" * (1 << 20), "no calibration"),
        ("rig.yaml", "stereo_sfm_rig: 1\n#" + "x" * (5 << 20), "it has 5 MB, more than 4"),
        ("basalt.json", '{"T_imu_cam": ' + "[" * 100_000, "nested too deeply"),
        (
            "stereo.yml",
            "%YAML:1.0\nM1: !!opencv-matrix\n  rows: 90000\n  cols: 90000\n  dt: d\n  data: [1]",
            "expected",
        ),
    ],
)
def test_texts_that_stand_for_more_than_a_calibration(tmp_path: Path, name: str, content: str, says: str) -> None:
    (tmp_path / name).write_text(content)
    with pytest.raises(StereoSfmError, match=says) as error:
        load_rig(tmp_path / name)
    assert "\n" not in str(error.value)


def test_kalibrs_chain_of_cameras_and_imu_alone(tmp_path: Path) -> None:
    """The IMU's pose and time are in it; its noise is in a file of the same beginning, or as usual."""
    save_rig(
        replace(RADTAN, imu=Imu(se3.inverse(BODY), offset_s=0.0123, gyro_noise=3e-4)),
        tmp_path / "camchain.yaml",
        "kalibr",
    )
    chain = tmp_path / "camchain.yaml"
    chain.rename(tmp_path / "walk-camchain-imucam.yaml")
    (tmp_path / "imu.yaml").rename(tmp_path / "walk-imu.yaml")
    rig = read_kalibr(tmp_path / "walk-camchain-imucam.yaml")
    assert rig.imu is not None and rig.imu.gyro_noise == 3e-4
    (tmp_path / "walk-imu.yaml").unlink()
    rig = read_kalibr(tmp_path / "walk-camchain-imucam.yaml")
    assert rig.imu is not None and rig.imu.offset_s == pytest.approx(0.0123)
    np.testing.assert_allclose(rig.imu.left_T_imu, se3.inverse(BODY), atol=1e-12)


def test_distortion_of_another_name_is_no_ideal_lens(tmp_path: Path) -> None:
    save_rig(RADTAN, tmp_path / "a.yml", "opencv")
    text = (tmp_path / "a.yml").read_text()
    for name in ("distortion_coefficients_left", "dist_coeffs"):
        (tmp_path / "b.yml").write_text(text.replace("D1:", f"{name}:"))
        assert read_opencv(tmp_path / "b.yml").left.distortion == RADTAN.left.distortion
    (tmp_path / "b.yml").write_text(text.replace("D1:", "distortion_coefficents:"))
    with pytest.raises(StereoSfmError, match="the distortion is not called D1, but distortion_coefficents"):
        read_opencv(tmp_path / "b.yml")
