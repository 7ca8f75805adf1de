"""Camera models: exact round trips, derivatives, agreement with OpenCV, NaN where a model ends."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from stereo_sfm.calib.rig import Rig
from stereo_sfm.errors import StereoSfmError
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
from stereo_sfm.geometry.param_jacobian import parameter_jacobian, parameter_vector, with_parameters

PINHOLE = Pinhole(640, 480, 400.0, 402.0, 319.5, 239.5)
EUROC = RadTan(752, 480, 458.654, 457.296, 367.215, 248.375, (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05))
DESK = RadTan(640, 480, 517.3, 516.5, 318.6, 255.3, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633))
RATIONAL = RadTan(1280, 800, 799.7, 799.1, 640.5, 402.2, (8.1, -3.2, 1e-4, -2e-4, 0.4, 8.4, -2.1, 0.2))
T265 = KannalaBrandt(848, 800, 286.2216, 287.4801, 419.467, 386.9751, (-0.004348, 0.037126, -0.035539, 0.005773))
TUM_VI = KannalaBrandt(1024, 1024, 380.81, 380.81, 510.29, 514.33, (0.01017, -0.010816, 0.0059428, -0.00166228))
WIDE = Epipolar(900, 800, 290.0, 291.0, 449.5, 399.5)
OAK = (0.32, -0.06, -3.7e-05, 7.6e-05, -0.0023, 0.654, -0.034, -0.009, 0.0011, -0.0004, 0.0007, 0.0002, 0.003, -0.001)
TILTED = Tilted(1280, 800, 577.8, 577.9, 627.2, 410.3, OAK)
FOV = Fov.published(640, 480, 330.0, 332.0, 320.5, 238.0, (0.93,))
# Kalibr's omni and its kin on TUM VI and T265 (Usenko et al., 3DV 2018, tables)
MEI = Mei.published(752, 480, 900.0, 899.0, 370.0, 240.0, (0.95, -0.13, 0.07, 1e-3, -5e-4))
MEI_WIDE = Mei.published(1024, 1024, 760.0, 761.0, 510.0, 514.0, (1.8, -0.02, 0.03, 2e-4, 1e-4))
DS = DoubleSphere.published(1024, 1024, 313.2, 313.2, 638.7, 514.4, (-0.1735, 0.5929))
DS_NARROW = DoubleSphere.published(640, 480, 320.0, 321.0, 320.0, 240.0, (0.3, 0.4))
EUCM = Eucm(1024, 1024, 380.0, 380.0, 510.3, 514.3, (0.63, 1.04))
CAMERAS = {
    "tilted": TILTED,
    "fov": FOV,
    "mei": MEI,
    "mei_wide": MEI_WIDE,
    "double_sphere": DS,
    "double_sphere_narrow": DS_NARROW,
    "eucm": EUCM,
    "pinhole": PINHOLE,
    "euroc": EUROC,
    "desk": DESK,
    "rational": RATIONAL,
    "t265": T265,
    "tum_vi": TUM_VI,
    "epipolar": WIDE,
}
ALL = pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS.keys())


def pixel_grid(camera: Camera, step: float = 7.3) -> np.ndarray:
    """(N, 2) pixels over the whole image, off the raster."""
    u, v = np.meshgrid(np.arange(0, camera.width - 1, step), np.arange(0, camera.height - 1, step))
    return np.stack([u.ravel(), v.ravel()], -1)


@ALL
def test_every_pixel_with_a_bearing_projects_back(camera: Camera) -> None:
    uv = pixel_grid(camera)
    bearings = camera.unproject(uv)
    seen = np.isfinite(bearings[:, 0])
    assert seen.mean() > (0.75 if camera in (T265, TILTED, MEI_WIDE, DS) else 0.97)
    np.testing.assert_allclose(np.linalg.norm(bearings[seen], axis=1), 1.0, atol=1e-14)
    depth = np.linspace(0.2, 40, seen.sum())[:, None]
    np.testing.assert_allclose(camera.project(bearings[seen] * depth), uv[seen], rtol=0, atol=1e-9)


@ALL
def test_every_direction_in_range_unprojects_back(camera: Camera) -> None:
    rng = np.random.default_rng(1)
    points = rng.standard_normal((20000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    uv = camera.project(points)
    seen = camera.inside(uv)
    if isinstance(camera, KannalaBrandt):  # at the very end of the range the radius is flat and holds no angle
        seen &= np.arccos(points[:, 2]) < camera.params[12] - 1e-3
    if camera is TILTED:
        seen &= np.hypot(*points[:, :2].T) < (np.sqrt(camera.params[12]) - 1e-2) * points[:, 2]
    assert seen.sum() > 300
    back = camera.unproject(uv[seen])
    np.testing.assert_allclose(back, points[seen], rtol=0, atol=1e-9)


@ALL
def test_derivative_by_the_point(camera: Camera) -> None:
    rng = np.random.default_rng(2)
    uv = rng.uniform([5, 5], [camera.width - 6, camera.height - 6], (400, 2))
    bearings = camera.unproject(uv)
    points = bearings[np.isfinite(bearings[:, 0])] * rng.uniform(0.3, 9, (np.isfinite(bearings[:, 0]).sum(), 1))
    same, jac = camera.project_jacobian(points)
    np.testing.assert_array_equal(same, camera.project(points))
    step = 1e-6
    for axis in range(3):
        d = np.zeros(3)
        d[axis] = step
        numeric = (camera.project(points + d) - camera.project(points - d)) / (2 * step)
        fine = np.isfinite(numeric[:, 0])  # a step may leave the range
        assert fine.mean() > 0.99
        scale = np.abs(jac[fine]).max((1, 2))[:, None]
        assert np.max(np.abs(jac[fine, :, axis] - numeric[fine]) / scale) < 1e-6


@ALL
def test_derivative_by_the_parameters(camera: Camera) -> None:
    rng = np.random.default_rng(3)
    uv = rng.uniform([100, 100], [camera.width - 100, camera.height - 100], (200, 2))
    points = camera.unproject(uv)
    points = points[np.isfinite(points[:, 0])] * 2.5
    jac = parameter_jacobian(camera, points)
    vector = parameter_vector(camera)
    assert jac.shape == (len(points), 2, len(vector))
    for i in range(len(vector)):
        step = 1e-5 * max(1.0, abs(vector[i]))
        d = np.zeros(len(vector))
        d[i] = step
        plus, minus = (with_parameters(camera, vector + s * d).project(points) for s in (1, -1))
        np.testing.assert_allclose(jac[:, :, i], (plus - minus) / (2 * step), rtol=1e-6, atol=1e-5)


coefficient = st.floats(-0.08, 0.08)


@settings(max_examples=60, deadline=None)
@given(st.tuples(coefficient, coefficient, coefficient, coefficient), st.integers(0, 2**31))
@example((0.049103116314639386, 0.049103116314639386, 0.049103116314639386, -0.02284182026778242), 9245)
def test_kannala_brandt_agrees_with_opencv(k: tuple[float, float, float, float], seed: int) -> None:
    camera = KannalaBrandt(848, 800, 286.0, 287.0, 420.0, 390.0, k)
    theta = np.random.default_rng(seed).uniform(0.01, min(1.5, camera.params[12] - 1e-3), 60)
    phi = np.random.default_rng(seed + 1).uniform(-np.pi, np.pi, 60)
    points = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
    zero = np.zeros(3)
    theirs, _ = cv2.fisheye.projectPoints(points[:, None], zero, zero, camera.matrix, np.array(k))
    np.testing.assert_allclose(camera.project(points), theirs[:, 0], atol=1e-8)
    np.testing.assert_allclose(camera.unproject(theirs[:, 0]), points, atol=1e-9)


@settings(max_examples=60, deadline=None)
@given(
    st.tuples(*[st.floats(-0.3, 0.3)] * 2, *[st.floats(-0.01, 0.01)] * 2, *[st.floats(-0.2, 0.2)] * 4),
    st.sampled_from([4, 5, 8]),
    st.integers(0, 2**31),
)
def test_radtan_agrees_with_opencv(d: tuple[float, ...], count: int, seed: int) -> None:
    camera = RadTan(640, 480, 420.0, 421.0, 318.0, 242.0, d[:count])
    edge = np.sqrt(camera.params[12]) if camera.params[12] > 0 else 9.0
    xy = np.random.default_rng(seed).uniform(-1, 1, (80, 2)) * min(0.7 * edge, 1.0) / np.sqrt(2)
    points = np.column_stack([xy, np.ones(80)]) * 3.0
    zero = np.zeros(3)
    theirs, _ = cv2.projectPoints(points, zero, zero, camera.matrix, np.array(d[:count]))
    ours = camera.project(points)
    np.testing.assert_allclose(ours, theirs[:, 0], atol=1e-8)
    back = camera.unproject(ours)
    np.testing.assert_allclose(back[:, :2] / back[:, 2:], xy, atol=1e-9)


@settings(max_examples=60, deadline=None)
@given(
    st.tuples(
        *[st.floats(-0.3, 0.3)] * 2, *[st.floats(-0.01, 0.01)] * 2, *[st.floats(-0.2, 0.2)] * 4,
        *[st.floats(-0.01, 0.01)] * 4, *[st.floats(-0.1, 0.1)] * 2,
    ),
    st.sampled_from([12, 14]),
    st.integers(0, 2**31),
)  # fmt: skip
def test_fourteen_coefficients_agree_with_opencv(d: tuple[float, ...], count: int, seed: int) -> None:
    camera = Tilted(640, 480, 420.0, 421.0, 318.0, 242.0, d[:count])
    edge = np.sqrt(camera.params[12]) if camera.params[12] > 0 else 9.0
    xy = np.random.default_rng(seed).uniform(-1, 1, (80, 2)) * min(0.6 * edge, 1.0) / np.sqrt(2)
    points = np.column_stack([xy, np.ones(80)]) * 3.0
    zero = np.zeros(3)
    theirs, _ = cv2.projectPoints(points, zero, zero, camera.matrix, np.array(d[:count]))
    ours = camera.project(points)
    np.testing.assert_allclose(ours, theirs[:, 0], rtol=0, atol=1e-9)
    back = camera.unproject(ours)
    np.testing.assert_allclose(back[:, :2] / back[:, 2:], xy, atol=1e-9)


def wide_rays(camera: Camera) -> np.ndarray:
    """(N, 3) rays up to 110 degrees from the axis that the camera sees."""
    theta, phi = np.meshgrid(np.linspace(0.01, 1.92, 60), np.linspace(-3, 3, 25))
    rays = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1).reshape(-1, 3)
    return rays[np.isfinite(camera.project(rays)[:, 0])]


def plane(camera: Camera, points: np.ndarray) -> np.ndarray:
    """(N, 2) pixels without focal length and principal point."""
    return (camera.project(points) - [camera.cx, camera.cy]) / camera.published_focal


def test_wide_models_are_the_published_formulas() -> None:
    for camera in (MEI, MEI_WIDE):  # cv::omnidir::projectPoints, Kalibr's OmniProjection
        xi, k1, k2, p1, p2 = camera.distortion
        points = wide_rays(camera) * 2.5
        x, y = (points[:, :2] / (points[:, 2:] + xi * np.linalg.norm(points, axis=1)[:, None])).T
        r2 = x * x + y * y
        gain = 1 + k1 * r2 + k2 * r2**2
        theirs = [x * gain + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * gain + 2 * p2 * x * y + p1 * (r2 + 2 * y * y)]
        np.testing.assert_allclose(plane(camera, points), np.array(theirs).T, atol=1e-12)
    for camera in (DS, DS_NARROW):  # equations 40 to 42
        xi, alpha = camera.distortion
        x, y, z = (points := wide_rays(camera) * 2.5).T
        d1 = np.sqrt(x * x + y * y + z * z)
        d2 = np.sqrt(x * x + y * y + (xi * d1 + z) ** 2)
        depth = alpha * d2 + (1 - alpha) * (xi * d1 + z)
        np.testing.assert_allclose(plane(camera, points), np.stack([x, y], -1) / depth[:, None], atol=1e-12)
    alpha, beta = EUCM.distortion
    x, y, z = (points := wide_rays(EUCM) * 2.5).T
    depth = alpha * np.sqrt(beta * (x * x + y * y) + z * z) + (1 - alpha) * z
    np.testing.assert_allclose(plane(EUCM, points), np.stack([x, y], -1) / depth[:, None], atol=1e-12)
    x, y, z = (points := wide_rays(FOV) * 2.5).T  # Kalibr's FovDistortion
    (w,), r = FOV.distortion, np.hypot(x, y) / z
    gain = np.arctan(2 * np.tan(w / 2) * r) / (r * w)
    np.testing.assert_allclose(plane(FOV, points), np.stack([x / z, y / z], -1) * gain[:, None], atol=1e-12)


def test_wide_models_see_beyond_ninety_degrees_and_end_where_they_fold() -> None:
    for camera in (MEI, MEI_WIDE, DS, EUCM):
        angles = np.linspace(0, np.pi - 1e-3, 2000)
        u = camera.project(np.stack([np.sin(angles), 0 * angles, np.cos(angles)], -1))[:, 0]
        seen = np.isfinite(u)
        assert angles[seen].max() > np.deg2rad(95)
        assert not seen[np.argmin(seen) :].any() or seen.all()  # one range
        assert (np.diff(u[seen]) > 0).all()


@pytest.mark.parametrize(
    "camera",
    [
        DoubleSphere(64, 48, 50, 50, 32, 24, (0.1, 1.2)),
        Eucm(64, 48, 50, 50, 32, 24, (0.5, -1.0)),
        Fov(64, 48, 50, 50, 32, 24, (4.0,)),
        Mei(64, 48, 50, 50, 32, 24, (-1.5,)),
        Tilted(64, 48, 50, 50, 32, 24, (0.0,) * 12 + (1.5, 0.0)),
    ],
)
def test_coefficients_outside_their_range_are_refused(camera: Camera) -> None:
    with pytest.raises(StereoSfmError, match=r"invalid calibration of the left camera: (alpha|w|xi|tilt)"):
        Rig(camera)


def test_nothing_behind_a_pinhole() -> None:
    for camera in (PINHOLE, EUROC):
        uv = camera.project(np.array([[0.1, 0.2, -1.0], [0.0, 0.0, 0.0], [np.nan, 0, 1]]))
        assert np.isnan(uv[:2]).all() and not camera.inside(uv).any()


def test_fisheye_sees_beyond_ninety_degrees_and_stops_where_it_folds() -> None:
    camera = KannalaBrandt(848, 800, 286.0, 286.0, 424.0, 400.0, (0.0, -0.03))
    limit = (1 / 0.15) ** 0.25  # d/dt (t - 0.03 t^5) = 0, 92 degrees
    assert camera.params[12] == pytest.approx(limit, abs=2e-4)
    angles = np.array([np.deg2rad(91), limit - 1e-3, limit + 1e-3, np.pi])
    uv = camera.project(np.stack([np.sin(angles), 0 * angles, np.cos(angles)], -1))
    assert np.isfinite(uv[:2]).all() and np.isnan(uv[2:]).all()
    edge = 286 * limit * (1 - 0.03 * limit**4)
    assert np.isfinite(camera.unproject(np.array([424 + edge - 0.1, 400.0]))).all()
    assert np.isnan(camera.unproject(np.array([424 + edge + 0.1, 400.0]))).all()


def test_barrel_distortion_stops_where_it_folds() -> None:
    camera = RadTan(640, 480, 300.0, 300.0, 320.0, 240.0, (-0.3, 0.0))
    limit = np.sqrt(1 / 0.9)  # d/dr (r - 0.3 r^3) = 0
    assert np.sqrt(camera.params[12]) == pytest.approx(limit, abs=2e-3)
    assert np.isfinite(camera.project(np.array([limit - 5e-3, 0.0, 1.0]))).all()
    assert np.isnan(camera.project(np.array([limit + 5e-3, 0.0, 1.0]))).all()
    peak = 300 * limit * (1 - 0.3 * limit**2)
    assert np.isnan(camera.unproject(np.array([320 + peak + 1, 240.0]))).all()
    assert np.isfinite(camera.unproject(np.array([320 + peak - 0.1, 240.0]))).all()


def test_the_optical_axis_is_exact() -> None:
    for camera in CAMERAS.values():
        np.testing.assert_allclose(camera.project(np.array([0.0, 0.0, 3.0])), [camera.cx, camera.cy], atol=1e-12)
        np.testing.assert_allclose(camera.unproject(np.array([camera.cx, camera.cy])), [0, 0, 1], atol=1e-12)
        _, jac = camera.project_jacobian(np.array([[0.0, 0.0, 2.0], [1e-8, 1e-8, 2.0]]))
        np.testing.assert_allclose(jac[0], jac[1], atol=1e-5)


@ALL
def test_the_focal_length_is_that_of_the_centre(camera: Camera) -> None:
    """Pixels per radian, which what follows images relies on."""
    a = 1e-6
    for axis, focal in ((0, camera.fx), (1, camera.fy)):
        ray = np.array([0.0, 0.0, 1.0])
        ray[axis] = a
        assert (camera.project(ray)[axis] - [camera.cx, camera.cy][axis]) / a == pytest.approx(focal, rel=2e-3)


def test_epipolar_rows_are_epipolar_planes() -> None:
    points = np.random.default_rng(5).uniform([-3, -2, 0.3], [3, 2, 5], (500, 3))
    shifted = points - [0.07, 0, 0]
    np.testing.assert_allclose(WIDE.project(points)[:, 1], WIDE.project(shifted)[:, 1], atol=1e-10)
    assert (WIDE.project(points)[:, 0] > WIDE.project(shifted)[:, 0]).all()  # positive disparity


def test_shapes_masks_and_borders() -> None:
    assert T265.project(np.ones((3, 4, 3))).shape == (3, 4, 2)
    assert T265.project_jacobian(np.ones((2, 5, 3)))[1].shape == (2, 5, 2, 3)
    grid = T265.bearing_grid()
    assert grid.shape == (800, 848, 3)
    mask = T265.valid_mask(np.deg2rad(80))
    assert mask.shape == (800, 848) and mask[400, 420] and not mask[0, 0]
    angle = np.rad2deg(np.arccos(grid[mask][:, 2].min()))
    assert angle <= 80 + 1e-9
    assert not PINHOLE.inside(np.array([np.nan, 3.0]))
    assert PINHOLE.inside(np.array([639.0, 479.0])) and not PINHOLE.inside(np.array([639.0, 479.0]), 1)


def test_too_many_coefficients() -> None:
    with pytest.raises(ValueError, match="at most 4"):
        KannalaBrandt(10, 10, 1, 1, 1, 1, (0, 0, 0, 0, 0))
    with pytest.raises(ValueError, match="at most 0"):
        Pinhole(10, 10, 1, 1, 1, 1, (0.1,))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("camera", [RadTan, KannalaBrandt])
@pytest.mark.parametrize("value", [1e300, float("inf"), float("nan"), 1e7])
def test_a_distortion_that_no_lens_has_is_refused_in_one_line(camera: type[Camera], value: float) -> None:
    lens = camera(64, 48, 50, 50, 32, 24, (0.1, value, 0.0, 0.0))
    with pytest.raises(StereoSfmError, match="invalid calibration of the left camera: distortion"):
        Rig(lens)


def test_a_focal_length_that_no_camera_has_is_refused() -> None:
    """Rectified to it, an image would have more pixels than the memory holds."""
    with pytest.raises(StereoSfmError, match=r"invalid calibration of the left camera: fx 100000$"):
        Rig(Pinhole(64, 48, 1e5, 50.0, 32.0, 24.0))
    Rig(Pinhole(64, 48, 6400.0, 6400.0, 32.0, 24.0))
