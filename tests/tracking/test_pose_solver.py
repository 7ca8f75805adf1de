"""Motion-only optimisation and stereo triangulation on exact scenes, in every camera model."""

from __future__ import annotations

import numpy as np
import pytest

from stereo_sfm.calib.rig import Rig
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Camera, Epipolar, KannalaBrandt, Pinhole, RadTan
from stereo_sfm.tracking.flow import pose_solver
from stereo_sfm.tracking.flow.stereo_cameras import StereoCameras
from stereo_sfm.tracking.flow.stereo_match import triangulate
from stereo_sfm.types import F64

CAMERAS = [
    Pinhole(640, 480, 400, 401, 320, 240),
    RadTan(752, 480, 458.6, 457.3, 367.2, 248.4, (-0.2834, 0.0739, 0.00019, 1.76e-5)),
    KannalaBrandt(848, 800, 286.2, 287.5, 419.5, 387.0, (-0.004348, 0.037126, -0.035539, 0.005773)),
    Epipolar(900, 800, 290, 290, 450, 400),
]
SCALES = np.array([20.0, 10.0, 5.0, 3.0, 2.0, 2.0, 2.0, 2.0])
NO_PRIOR = np.eye(4), np.full(6, np.inf)


def rig(camera: Camera, depth: bool = False) -> Rig:
    return Rig(camera, camera, se3.exp(np.array([0.1, 0.002, -0.001, 0.01, -0.02, 0.005])), depth=depth)


def scene(camera: Camera, count: int, seed: int) -> tuple[F64, F64, F64, F64]:
    """True pose, points in the odometry frame, exact pixels in both cameras."""
    rng = np.random.default_rng(seed)
    pose = se3.exp(rng.normal(size=6) * [0.1, 0.1, 0.1, 0.05, 0.05, 0.05])
    uv = rng.uniform([60, 60], [camera.width - 60, camera.height - 60], (count, 2))
    bearing = camera.unproject(uv)
    keep = bearing[:, 2] > 0.2
    points_cam = bearing[keep] * rng.uniform(1, 8, (int(keep.sum()), 1))
    cameras = StereoCameras.of(rig(camera))
    uv_right = camera.project(se3.transform(cameras.right_T_left, points_cam))
    return pose, se3.transform(pose, points_cam), uv[keep], uv_right


def seen(direction: F64, rho: F64, variance: F64, uv: F64, uv_right: F64) -> pose_solver.SeenPoints:
    return pose_solver.SeenPoints(np.zeros_like(direction), direction, rho, variance, uv, uv_right, np.zeros(0))


def solve(
    camera: Camera,
    points: F64,
    uv: F64,
    uv_right: F64,
    variance: float = 1e-10,
    prior: tuple[F64, F64] = NO_PRIOR,
    depth: bool = False,
) -> tuple[F64, F64, F64]:
    cameras = StereoCameras.of(rig(camera, depth))
    distance = np.linalg.norm(points, axis=1)
    n = len(points)
    pose, _, covariance, error = pose_solver.optimise_pose(
        np.eye(4), np.zeros(6), 0.1, np.ones(6),
        seen(points / distance[:, None], 1 / distance, np.full(n, variance), uv, uv_right), cameras, 0.5, SCALES,
        *prior,
    )  # fmt: skip
    return pose, covariance, error


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda c: c.model)
def test_exact_pixels_give_the_exact_pose(camera: Camera) -> None:
    pose, points, uv, uv_right = scene(camera, 120, 0)
    found, covariance, error = solve(camera, points, uv, uv_right)
    assert np.abs(found - pose).max() < 1e-8
    assert error.max() < 1e-6
    assert np.linalg.eigvalsh(covariance).min() > 0


def test_a_prior_counts_by_its_covariance() -> None:
    """Normal equations of both (Barfoot, State Estimation for Robotics, section 8.3), at the pose they give."""
    rng = np.random.default_rng(2)
    _, points, uv, uv_right = scene(CAMERAS[0], 120, 0)
    noisy, noisy_right = (x + rng.normal(0, 0.02, x.shape) for x in (uv, uv_right))
    without, covariance, _ = solve(CAMERAS[0], points, noisy, noisy_right)
    information = np.linalg.inv(covariance)
    sigmas = 1.0 / np.sqrt(np.diag(information))
    off = sigmas * [1.0, -1.0, 1.0, 1.0, -1.0, 1.0]
    found, both, _ = solve(CAMERAS[0], points, noisy, noisy_right, prior=(without @ se3.exp(off), sigmas))
    prior = np.diag(1.0 / sigmas**2)
    assert np.allclose(both, np.linalg.inv(information + prior), rtol=0.02, atol=1e-3 * np.diag(both).max())
    moved = se3.log(se3.inverse(without) @ found)
    assert np.allclose(moved, np.linalg.solve(information + prior, prior @ off), atol=0.05 * np.abs(off).max())


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda c: c.model)
def test_forty_percent_outliers_do_not_matter(camera: Camera) -> None:
    rng = np.random.default_rng(3)
    pose, points, uv, uv_right = scene(camera, 300, 1)
    bad = rng.random(len(uv)) < 0.4
    uv[bad] += rng.uniform(-40, 40, (int(bad.sum()), 2))
    found, _, error = solve(camera, points, uv, uv_right)
    assert np.abs(found - pose).max() < 2e-3
    assert (error[~bad] < 3).mean() > 0.98


def test_the_left_image_alone_is_enough() -> None:
    pose, points, uv, uv_right = scene(CAMERAS[2], 120, 2)
    found, _, _ = solve(CAMERAS[2], points, uv, np.full_like(uv_right, np.nan))
    assert np.abs(found - pose).max() < 1e-7


@pytest.mark.parametrize("depth", [False, True])
def test_the_covariance_predicts_the_scatter(depth: bool) -> None:
    """Squared Mahalanobis length of the error has mean six when pixels and distances are as noisy as stated.

    A depth camera's right pixels have the noise of the left ones and of the disparities.
    """
    rng = np.random.default_rng(5)
    pose, points, uv, uv_right = scene(CAMERAS[0], 150, 4)
    lengths = []
    for _ in range(60):
        noise, noise_right = rng.normal(size=(2, *uv.shape)) * 0.5
        if depth:
            noise_right[:, 1] = 0.0
            noise_right += noise
        found, covariance, error = solve(CAMERAS[0], points, uv + noise, uv_right + noise_right, depth=depth)
        xi = se3.log(se3.inverse(pose) @ found)
        lengths.append(xi @ np.linalg.solve(covariance, xi))
        assert np.sqrt(np.mean(np.square(error))) == pytest.approx(1.0, abs=0.15)
    assert 4.0 < np.mean(lengths) < 9.0


def test_uncertain_distance_does_not_bias_the_pose() -> None:
    """Points whose distance is wrong by its stated variance: the marginalised solution stays near the truth."""
    rng = np.random.default_rng(6)
    pose, points, uv, uv_right = scene(CAMERAS[2], 300, 5)
    distance = np.linalg.norm(points, axis=1)
    rho = np.maximum(1 / distance + rng.normal(size=len(points)) * 0.05, 0.01)
    wrong = points * (1 / rho / distance)[:, None]
    naive, _, _ = solve(CAMERAS[2], wrong, uv, uv_right)
    aware, _, _ = solve(CAMERAS[2], wrong, uv, uv_right, 0.05**2)
    error = [np.linalg.norm(p[:3, 3] - pose[:3, 3]) for p in (naive, aware)]
    assert error[1] < 0.01
    assert error[1] < error[0]


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda c: c.model)
def test_triangulation_of_exact_pairs(camera: Camera) -> None:
    pose, points, uv, uv_right = scene(camera, 100, 7)
    cameras = StereoCameras.of(rig(camera))
    bearing, rho, variance, epipolar = triangulate(uv, uv_right, cameras, np.full(len(uv), 0.5))
    truth = se3.transform(se3.inverse(pose), points)
    good = np.isfinite(rho)
    assert good.mean() > 0.95
    assert np.abs((bearing / rho[:, None] - truth)[good]).max() < 1e-6
    assert epipolar[good].max() < 1e-6
    assert (variance[good] > 0).all()


def test_uncertain_distances_do_not_shorten_a_step() -> None:
    """Errors in variables: taken at the given distance, the derivatives make steps too short by its variance."""
    camera, relative, steps = CAMERAS[2], 0.1, list[float]()
    cameras = StereoCameras.of(rig(camera))
    for seed in range(60):
        rng = np.random.default_rng(seed)
        bearing = camera.unproject(rng.uniform([60, 60], [780, 740], (200, 2)))
        bearing = bearing[bearing[:, 2] > 0.2]
        points = bearing * rng.uniform(1, 3, (len(bearing), 1))
        pose = se3.exp(np.array([0, 0, 0.06, 0, 0, 0]))
        ahead = points - pose[:3, 3]
        uv = camera.project(ahead) + rng.normal(0, 0.3, (len(points), 2))
        rho = 1 / np.linalg.norm(points, axis=1)
        noisy = rho * (1 + relative * rng.normal(size=len(rho)))
        found = pose_solver.optimise_pose(
            np.eye(4), np.zeros(6), 0.1, np.ones(6),
            seen(bearing, noisy, (relative * rho) ** 2, uv, np.full_like(uv, np.nan)), cameras, 0.3, SCALES, *NO_PRIOR,
        )[0]  # fmt: skip
        steps.append(found[2, 3] / 0.06)
    assert abs(np.mean(steps) - 1) < 3 * np.std(steps) / np.sqrt(len(steps)) + 1e-3
    assert np.std(steps) / np.sqrt(len(steps)) < 0.002


def test_poses_that_are_products_of_many_stay_rotations() -> None:
    """Each pose is solved from the one before, which has an error: of a thousand images, no rotation is 1e-12 off."""
    camera = CAMERAS[0]
    cameras = StereoCameras.of(rig(camera))
    truth, points, uv, uv_right = scene(camera, 60, 2)
    distance = np.linalg.norm(points, axis=1)
    pose = truth @ se3.exp(np.array([0.01, 0.0, 0.0, 0.005, 0.0, 0.0]))
    pose[:3, :3] += np.random.default_rng(0).normal(0, 1e-6, (3, 3))
    for _ in range(1000):
        pose, *_ = pose_solver.optimise_pose(
            pose, np.zeros(6), 0.1, np.ones(6),
            seen(points / distance[:, None], 1 / distance, np.full(len(points), 1e-10), uv, uv_right), cameras, 0.5,
            SCALES, *NO_PRIOR,
        )  # fmt: skip
    assert np.abs(pose[:3, :3].T @ pose[:3, :3] - np.eye(3)).max() < 1e-12
    assert np.abs(pose - truth).max() < 1e-6
