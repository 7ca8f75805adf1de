"""Rectification: rows agree on exact data, fields of view are kept, images follow the tables."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from stereo_sfm.calib.rectification import Rectification, rectify
from stereo_sfm.calib.rig import Rig
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Pinhole, RadTan
from stereo_sfm.geometry.stereo import epipolar_angle, rectifying_rotations, triangulate
from tests.synthetic import fisheye_rig, pinhole_rig

EUROC = Rig(
    RadTan(752, 480, 458.654, 457.296, 367.215, 248.375, (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05)),
    RadTan(752, 480, 457.587, 456.134, 379.999, 255.238, (-0.28368365, 0.07451284, -0.00010473, -3.5559e-05)),
    se3.exp(np.array([0.110, -0.0003, 0.0009, 0.014, -0.002, 0.007])),
    se3.exp(np.array([0.02, -0.04, 0.01, 1.2, -0.3, 0.9])),
)
TURNED = replace(fisheye_rig(), left_T_right=se3.exp(np.array([0.06, 0.012, -0.009, 0.05, 0.11, -0.08])))
CASES = [
    (EUROC, "pinhole", None),
    (EUROC, "epipolar", None),
    (fisheye_rig(), "pinhole", 100.0),
    (fisheye_rig(), "epipolar", None),
    (TURNED, "epipolar", None),
    (TURNED, "pinhole", 110.0),
]


def points_before(rig: Rig, count: int = 4000) -> np.ndarray:
    """(N, 3) points from near to far around the left camera's axis, in the left camera."""
    rng = np.random.default_rng(7)
    directions = rng.standard_normal((count, 3)) * [1.2, 1.2, 0.5] + [0, 0, 1]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return directions * rng.uniform(0.25, 30, (count, 1))


def both_eyes(rectification: Rectification, points_left: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where the original cameras see the points, in rectified pixels; only points inside both images."""
    left, right = rectification.left, rectification.right
    original = rectification_source[id(rectification)]
    uv_left = original.left.project(points_left)
    uv_right = right.source.project(se3.transform(se3.inverse(original.left_T_right), points_left))
    seen = left.source.inside(uv_left) & right.source.inside(uv_right)
    a, b = left.from_source(uv_left[seen]), right.from_source(uv_right[seen])
    kept = left.target.inside(a) & right.target.inside(b)
    return a[kept], b[kept]


rectification_source: dict[int, Rig] = {}


def make(rig: Rig, projection: str, hfov: float | None, size: tuple[int, int] | None = None) -> Rectification:
    out = rectify(rig, projection, hfov, size)
    rectification_source[id(out)] = rig
    return out


@pytest.mark.parametrize(("rig", "projection", "hfov"), CASES)
def test_rows_agree_and_disparity_is_depth(rig: Rig, projection: str, hfov: float | None) -> None:
    rectification = make(rig, projection, hfov)
    a, b = both_eyes(rectification, points_before(rig))
    assert len(a) > 500
    assert np.abs(a[:, 1] - b[:, 1]).max() < 1e-8
    assert (a[:, 0] - b[:, 0]).min() > 0
    new = rectification.rig
    assert new.baseline == pytest.approx(rig.baseline)
    np.testing.assert_allclose(new.left_T_right, se3.exp(np.array([rig.baseline, 0, 0, 0, 0, 0])), atol=1e-15)


@pytest.mark.parametrize(("rig", "projection", "hfov"), CASES)
def test_the_new_rig_sees_what_the_old_one_saw(rig: Rig, projection: str, hfov: float | None) -> None:
    rectification = make(rig, projection, hfov)
    points = points_before(rig)
    a, b = both_eyes(rectification, points)
    new = rectification.rig
    assert new.right is not None
    in_rect = triangulate(new.left.unproject(a), new.right.unproject(b), new.left_T_right)
    back = se3.transform(rectification.cam_T_rect, in_rect)
    nearest, _ = cKDTree(points).query(back)
    assert nearest.max() < 1e-6
    # body_T_left follows: the same point in the body from both rigs
    body = se3.transform(new.body_T_left, in_rect)
    np.testing.assert_allclose(body, se3.transform(rig.body_T_left, back), atol=1e-9)


@pytest.mark.parametrize("rig", [fisheye_rig(), TURNED])
def test_epipolar_keeps_150_degrees_of_a_fisheye(rig: Rig) -> None:
    rectification = rectify(rig, "epipolar")
    both = rectification.left.mask & rectification.right.mask
    bearings = rectification.rig.left.bearing_grid()
    middle_row = round(rectification.rig.left.cy)
    row = bearings[middle_row][both[middle_row]]
    span = np.rad2deg(np.arcsin(row[-1, 0]) - np.arcsin(row[0, 0]))
    assert span >= 150
    middle_column = round(rectification.rig.left.cx)
    column = bearings[:, middle_column][both[:, middle_column]]
    assert np.rad2deg(np.arctan2(column[-1, 1], column[-1, 2]) - np.arctan2(column[0, 1], column[0, 2])) >= 135
    assert both.mean() > 0.75


def test_pinhole_field_of_view_is_as_requested() -> None:
    for hfov in (60.0, 90.0, 120.0):
        camera = rectify(fisheye_rig(), "pinhole", hfov, (640, 480)).rig.left
        assert camera.size == (640, 480)
        assert np.rad2deg(2 * np.arctan(0.5 * 640 / camera.fx)) == pytest.approx(hfov)
    with pytest.raises(StereoSfmError, match="choose 10 to 150"):
        rectify(fisheye_rig(), "pinhole", 160.0)


def test_pinhole_default_has_no_black_border() -> None:
    rectification = rectify(EUROC, "pinhole")
    assert rectification.left.mask.mean() > 0.999 and rectification.right.mask.mean() > 0.999


def test_pinhole_default_copes_with_corners_beyond_the_lens_model() -> None:
    folding = (-0.314, 0.136, 0.0002, -0.0007, -0.0331)
    camera = RadTan(752, 480, 459.7, 458.7, 369.9, 248.2, folding)
    assert np.isnan(camera.unproject(np.array([751.0, 479.0]))).any() or camera.params[12] > 0
    narrow = replace(camera, fx=420.0, fy=420.0)
    assert np.isnan(narrow.unproject(np.array([751.0, 479.0]))).any()
    rectification = rectify(Rig(narrow, narrow, se3.exp(np.array([0.11, 0, 0, 0, 0, 0]))), "pinhole")
    assert 300 < rectification.rig.left.fx < 500
    assert rectification.left.mask.mean() > 0.99


def test_a_rectified_pair_stays_as_it_is() -> None:
    rig = pinhole_rig()
    rectification = rectify(rig, "pinhole")
    np.testing.assert_array_equal(rectification.rig.left.params, rig.left.params)
    image = np.random.default_rng(0).integers(0, 255, (480, 640), dtype=np.uint8)
    left, right = rectification.apply(image, image)
    np.testing.assert_array_equal(left, image)
    np.testing.assert_array_equal(right, image)


def test_images_follow_the_tables_and_are_black_outside() -> None:
    rig = fisheye_rig()
    rectification = rectify(rig, "epipolar")
    u, v = np.meshgrid(np.arange(848), np.arange(800))
    picture = (128 + 60 * np.sin(u / 23.0) + 60 * np.cos(v / 19.0)).astype(np.uint8)
    out = rectification.left.apply(picture)
    assert (out[~rectification.left.mask] == 0).all()
    inner = rectification.left.mask & np.roll(rectification.left.mask, 3, 1) & np.roll(rectification.left.mask, -3, 1)
    uu, vv = np.meshgrid(np.arange(out.shape[1], dtype=float), np.arange(out.shape[0], dtype=float))
    source = rectification.left.to_source(np.stack([uu, vv], -1))
    expected = 128 + 60 * np.sin(source[..., 0] / 23.0) + 60 * np.cos(source[..., 1] / 19.0)
    assert np.abs(out.astype(float) - expected)[inner].max() < 3.0
    with pytest.raises(StereoSfmError, match="848x800"):
        rectification.left.apply(picture[:, :-1])


def test_refusals() -> None:
    rig = fisheye_rig()
    with pytest.raises(StereoSfmError, match="two cameras"):
        rectify(Rig(rig.left), "pinhole")
    with pytest.raises(StereoSfmError, match="unknown projection"):
        rectify(rig, "mercator")
    with pytest.raises(StereoSfmError, match="swapped"):
        rectify(replace(rig, left_T_right=se3.inverse(rig.left_T_right)), "pinhole")
    with pytest.raises(StereoSfmError, match="cannot be rectified"):
        rectify(replace(rig, left_T_right=se3.exp(np.array([0, 0, 0.1, 0, 0, 0]))), "epipolar")


def test_rectifying_rotations_agree_with_opencv() -> None:
    import cv2

    k = np.eye(3) * [400, 400, 1]
    right_T_left = se3.inverse(TURNED.left_T_right)
    r1, r2, *_ = cv2.stereoRectify(k, None, k, None, (640, 480), right_T_left[:3, :3], right_T_left[:3, 3])
    ours_left, ours_right = rectifying_rotations(TURNED.left_T_right)
    np.testing.assert_allclose(ours_left @ ours_right.T, np.asarray(r1) @ np.asarray(r2).T, atol=0.2)
    np.testing.assert_allclose(ours_left[0], np.asarray(r1)[0], atol=1e-9)  # the same baseline axis
    np.testing.assert_allclose(ours_right[0], np.asarray(r2)[0], atol=1e-9)


def test_epipolar_angle_and_triangulation_on_exact_rays() -> None:
    points = points_before(TURNED)
    left = points / np.linalg.norm(points, axis=1, keepdims=True)
    in_right = se3.transform(se3.inverse(TURNED.left_T_right), points)
    right = in_right / np.linalg.norm(in_right, axis=1, keepdims=True)
    assert np.abs(epipolar_angle(left, right, TURNED.left_T_right)).max() < 1e-12
    np.testing.assert_allclose(triangulate(left, right, TURNED.left_T_right), points, rtol=1e-7, atol=1e-7)
    assert np.isnan(triangulate(left, -right, TURNED.left_T_right)).all()
    lowered = se3.so3_exp(np.array([-1e-4, 0, 0]))  # turn the right rays down about x
    tilted = (
        right
        @ (
            np.linalg.inv(rectifying_rotations(TURNED.left_T_right)[1])
            @ lowered
            @ rectifying_rotations(TURNED.left_T_right)[1]
        ).T
    )
    np.testing.assert_allclose(epipolar_angle(left, tilted, TURNED.left_T_right), 1e-4, atol=1e-9)


def test_pinhole_of_different_cameras_shares_one_camera() -> None:
    rig = Rig(
        Pinhole(640, 480, 400, 401, 310, 240),
        Pinhole(640, 480, 420, 419, 330, 236),
        se3.exp(np.array([0.1, 0, 0, 0, 0, 0])),
    )
    rectification = make(rig, "pinhole", None)
    a, b = both_eyes(rectification, points_before(rig))
    assert np.abs(a[:, 1] - b[:, 1]).max() < 1e-9


def test_a_rectified_image_that_shows_fewer_rows_was_read_in_less_time() -> None:
    fisheye = replace(fisheye_rig(), readout_s=0.03)
    cropped = rectify(fisheye, "pinhole", 90.0).rig
    rows = fisheye.left.project(
        cropped.left.unproject(np.array([[cropped.left.cx, 0.0], [cropped.left.cx, cropped.left.height - 1.0]]))
    )
    part = (rows[1, 1] - rows[0, 1]) / (fisheye.left.height - 1)
    assert 0.3 < part < 0.9
    assert cropped.readout_s == pytest.approx(0.03 * part, rel=0.02)
    assert rectify(fisheye_rig(), "pinhole", 90.0).rig.readout_s == 0.0
