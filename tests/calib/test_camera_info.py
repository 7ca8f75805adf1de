"""CameraInfo of messages and of files by one reader: names, damaged numbers, extrinsics of R, P and transforms."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from stereo_sfm.calib import load_rig
from stereo_sfm.calib.formats.camera_info import CameraInfo, infos_from_rig
from stereo_sfm.drivers.mcap.messages import Transform
from stereo_sfm.drivers.mcap.rig import camera_of, other_reading, stereo_rig
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import KannalaBrandt, Pinhole, RadTan, Tilted
from tests.synthetic import fisheye_rig

TOPICS = ("/left/camera_info", "/right/camera_info")
RIG = fisheye_rig()


def pair() -> tuple[CameraInfo, CameraInfo]:
    left, right = infos_from_rig(RIG, "equidistant")
    return replace(left, frame="cam_l"), replace(right, frame="cam_r")


def pinholes() -> tuple[CameraInfo, CameraInfo]:
    """Without a rotation in R."""
    left, right = (
        replace(info, distortion_model="plumb_bob", coefficients=(-0.2, 0.1), r=np.eye(3)) for info in pair()
    )
    return left, right


@pytest.mark.parametrize(
    ("model", "coefficients", "lens"),
    [
        ("equidistant", (0.1, 0.2, 0.3, 0.4, 0.0), KannalaBrandt),
        ("Kannala_Brandt", (0.1, 0.2, 0.3, 0.4), KannalaBrandt),
        ("fisheye", (0.1, 0.2), KannalaBrandt),
        ("none", (), Pinhole),
        ("none", (0.0,) * 5, Pinhole),
        ("radtan", (-0.2, 0.1, 0.0, 0.0), RadTan),
        ("", (-0.2, 0.1, 0.0, 0.0, 0.01), RadTan),
        ("rational_polynomial", (*(0.1,) * 8, *(0.0,) * 6), RadTan),
        ("rational_polynomial", (*(0.1,) * 8, 0.0, 0.0, 0.0, 0.0, 0.01, 0.0), Tilted),
    ],
)
def test_names_that_drivers_use(model: str, coefficients: tuple[float, ...], lens: type) -> None:
    info = replace(pair()[0], distortion_model=model, coefficients=coefficients)
    assert type(camera_of(info, TOPICS[0], False)) is lens


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"p": np.full((3, 4), np.nan)}, "P is not finite"),
        ({"r": np.full((3, 3), np.inf)}, "R is not finite"),
        ({"coefficients": (np.nan, 0.0, 0.0, 0.0)}, "D is not finite"),
        ({"k": np.full((3, 3), np.nan)}, "K is not finite"),
        ({"k": np.zeros((3, 3))}, "K is zero: the camera is not calibrated"),
        ({"r": 2 * np.eye(3)}, "R is no rotation"),
        ({"r": np.diag([1.0, 1.0, -1.0])}, "R is no rotation"),
        ({"p": np.diag([-1.0, 1.0, 1.0, 0.0])[:3]}, "P has no focal length"),
        ({"coefficients": (0.1,) * 5}, "D has 5 coefficients, a fisheye four"),
        ({"distortion_model": "spline"}, "'spline' is not supported"),
    ],
)
def test_damaged_messages_name_topic_and_field(change: dict[str, object], says: str) -> None:
    left, right = pair()
    with pytest.raises(StereoSfmError, match=rf"the calibration on /right/camera_info cannot be used: .*{says}"):
        stereo_rig(left, replace(right, **change), TOPICS, False, [])  # type: ignore[arg-type]


def test_extrinsics_of_r_and_p_where_both_name_one_frame() -> None:
    left, right = (replace(info, frame="camera") for info in pair())
    rig = stereo_rig(left, right, TOPICS, False, [])
    np.testing.assert_allclose(rig.left_T_right, RIG.left_T_right, atol=1e-12)
    bare = replace(right, p=np.column_stack([right.k, np.zeros(3)]))
    with pytest.raises(
        StereoSfmError, match=r"both cameras name the frame 'camera'.*no baseline.*transforms are of a, b"
    ):
        stereo_rig(left, bare, TOPICS, False, [Transform(0, "a", "b", np.eye(4))])


def test_a_rotation_that_only_the_transforms_have(caplog: pytest.LogCaptureFixture) -> None:
    left, right = (replace(info, frame="camera") for info in pinholes())
    base_T_left = se3.exp(np.array([0.3, -0.1, 0.2, 0.5, 0.2, -1.0]))
    optical = [
        Transform(0, "base", "port", base_T_left),
        Transform(0, "base", "starboard", base_T_left @ RIG.left_T_right),
        Transform(0, "port", "housing", se3.exp(np.array([0.0, 0.0, 0.0, 1.2, -1.2, 1.2]))),
    ]
    rig = stereo_rig(left, right, TOPICS, False, optical)
    np.testing.assert_allclose(rig.left_T_right, RIG.left_T_right, atol=1e-12)
    assert "taken from the transform of port to starboard" in caplog.text
    rig = stereo_rig(left, right, TOPICS, False, [])
    np.testing.assert_allclose(rig.left_T_right[:3, :3], np.eye(3), atol=1e-12)
    assert "no transform tells it" in caplog.text


def test_a_leading_slash_is_no_other_frame() -> None:
    left, right = (replace(info, p=np.zeros((3, 4))) for info in pair())
    apart = Transform(0, "/cam_l", "cam_r", RIG.left_T_right)
    rig = stereo_rig(left, replace(right, frame="/cam_r"), TOPICS, False, [apart])
    np.testing.assert_array_equal(rig.left_T_right, RIG.left_T_right)


def test_the_other_reading_of_rectified_and_original_images() -> None:
    left, right = pair()
    for rectified in (False, True):
        found = other_reading(left, right, TOPICS, rectified, [])
        assert found is not None and ("not rectified" in found[0]) == rectified
        assert isinstance(found[1].left, KannalaBrandt if rectified else Pinhole)
    without = replace(left, coefficients=()), replace(right, coefficients=())
    assert other_reading(*without, TOPICS, True, []) is None  # P is K turned by R
    assert other_reading(left, replace(right, p=np.zeros((3, 4))), TOPICS, False, []) is None


def test_transforms_between_the_cameras_go_before_p_of_raw_images() -> None:
    left, right = pinholes()
    named = [Transform(0, "cam_l", "cam_r", RIG.left_T_right)]
    np.testing.assert_allclose(stereo_rig(left, right, TOPICS, False, named).left_T_right, RIG.left_T_right)
    rectified = stereo_rig(left, right, TOPICS, True, named)
    np.testing.assert_allclose(rectified.left_T_right[:3, :3], np.eye(3))
    assert isinstance(rectified.left, Pinhole)


def test_rectified_images_whose_baseline_only_the_transforms_have() -> None:
    left, right = pinholes()
    right = replace(right, p=left.p)  # infrared topics of RealSense: Tx = 0
    shift = se3.from_rotation_translation(np.eye(3), np.array([0.05, 0.0, 0.0]))
    rig = stereo_rig(left, right, TOPICS, True, [Transform(0, "cam_l", "cam_r", shift)])
    assert rig.baseline == 0.05
    with pytest.raises(StereoSfmError, match=r"no transform from 'cam_l' to 'cam_r' \(there are no transforms\)"):
        stereo_rig(left, right, TOPICS, True, [])


def test_a_vertical_pair_has_its_baseline_in_ty() -> None:
    left, right = pinholes()
    p = left.p.copy()
    p[1, 3] = -0.1 * p[1, 1]
    rig = stereo_rig(left, replace(right, p=p), TOPICS, True, [])
    np.testing.assert_allclose(rig.left_T_right[:3, 3], [0, 0.1, 0], atol=1e-15)


def _write(folder: Path, name: str, info: CameraInfo) -> None:
    arrays = {"camera_matrix": info.k, "rectification_matrix": info.r, "projection_matrix": info.p}
    data: dict[str, object] = {k: {"rows": len(v), "data": v.ravel().tolist()} for k, v in arrays.items()}
    d = {"rows": 1, "data": list(info.coefficients)}
    head = {"image_width": info.width, "image_height": info.height, "distortion_model": info.distortion_model}
    (folder / name).write_text(yaml.safe_dump(head | {"distortion_coefficients": d} | data))


@pytest.mark.parametrize(
    ("left", "right"),
    [
        ("left.yaml", "right.yaml"),
        ("infra1.yaml", "infra2.yaml"),
        ("cam1.yaml", "cam2.yaml"),
        ("fisheye1.yaml", "fisheye2.yaml"),
        ("Left_info.yml", "Right_info.yml"),
        ("head_l.yaml", "head_r.yaml"),
    ],
)
def test_pairs_of_files_by_their_names(tmp_path: Path, left: str, right: str) -> None:
    for name, info in zip((left, right), pair(), strict=True):
        _write(tmp_path, name, info)
    for path in (tmp_path, tmp_path / left):
        np.testing.assert_allclose(load_rig(path).left_T_right, RIG.left_T_right, atol=1e-9)


def test_numbered_files_without_a_baseline_are_no_pair(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    for name in ("webcam_2024_1.yaml", "webcam_2024_2.yaml"):
        _write(tmp_path, name, pair()[0])
    assert load_rig(tmp_path / "webcam_2024_1.yaml").right is None
    assert "are no pair (P of the second has no Tx)" in caplog.text


def test_a_drawing_of_the_robot_does_not_replace_a_calibration(caplog: pytest.LogCaptureFixture) -> None:
    """Its cameras are parallel and a round number apart; R and P say how they were calibrated."""
    left, right = pair()
    drawn = Transform(0, "cam_l", "cam_r", se3.exp(np.array([0.06, 0.0, 0.0, 0.0, 0.0, 0.0])))
    rig = stereo_rig(left, right, TOPICS, False, [drawn])
    np.testing.assert_allclose(rig.left_T_right, RIG.left_T_right, atol=1e-12)
    assert "R and P say how they were calibrated" in caplog.text
    measured = Transform(0, "cam_l", "cam_r", RIG.left_T_right @ se3.exp(np.array([0, 0, 0, 0.001, 0, 0])))
    rig = stereo_rig(left, right, TOPICS, False, [measured])
    np.testing.assert_array_equal(rig.left_T_right, measured.matrix)
