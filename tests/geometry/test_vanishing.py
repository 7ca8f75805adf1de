"""Manhattan directions from great circles: exact and noisy scenes of known orientation, scenes without structure."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Camera, KannalaBrandt, Pinhole, RadTan
from stereo_sfm.geometry.lines import LineDetector, LineSegments
from stereo_sfm.geometry.robust import Degenerate
from stereo_sfm.geometry.vanishing import Manhattan, estimate, nearest_turn, polar_grid, search
from stereo_sfm.types import F64


def segments_from_space(ends_a: F64, ends_b: F64, noise: float, rng: np.random.Generator) -> LineSegments:
    a = ends_a / np.linalg.norm(ends_a, axis=1, keepdims=True) + rng.normal(size=ends_a.shape) * noise
    b = ends_b / np.linalg.norm(ends_b, axis=1, keepdims=True) + rng.normal(size=ends_b.shape) * noise
    a, b = a / np.linalg.norm(a, axis=1, keepdims=True), b / np.linalg.norm(b, axis=1, keepdims=True)
    normal = np.cross(a, b)
    sine = np.linalg.norm(normal, axis=1)
    return LineSegments(normal / sine[:, None], a, b, np.arctan2(sine, (a * b).sum(1)))


def manhattan_lines(
    cam_R_world: F64, seed: int, per_axis: int = 25, noise: float = 0.0, clutter: int = 0, everywhere: bool = False
) -> LineSegments:
    """Segments along the three world axes seen by a camera; `everywhere`: also beside and behind it (fisheye)."""
    rng = np.random.default_rng(seed)
    total = 3 * per_axis + clutter
    middle = rng.normal(size=(total, 3)) * 2
    if not everywhere:
        middle = np.stack([rng.uniform(-3, 3, total), rng.uniform(-2, 2, total), rng.uniform(3, 8, total)], 1)
    axis = np.concatenate([np.repeat(np.eye(3), per_axis, 0) @ cam_R_world.T, np.zeros((clutter, 3))])
    loose = rng.normal(size=(clutter, 3))
    axis[3 * per_axis :] = loose / np.linalg.norm(loose, axis=1, keepdims=True)
    half = rng.uniform(0.3, 1.0, (total, 1)) * axis
    return segments_from_space(middle - half, middle + half, noise, rng)


def error_deg(found: Manhattan, cam_R_world: F64) -> float:
    turned = nearest_turn(found.cam_R_axes, cam_R_world)
    return float(np.degrees(np.linalg.norm(se3.so3_log(turned.T @ cam_R_world))))


@pytest.mark.parametrize("everywhere", [False, True])
@pytest.mark.parametrize("seed", range(6))
def test_exact_lines_give_the_exact_orientation(seed: int, everywhere: bool) -> None:
    truth = se3.so3_exp(np.random.default_rng(seed).normal(size=3))
    lines = manhattan_lines(truth, seed, everywhere=everywhere)
    assert error_deg(estimate(lines, np.random.default_rng(0)), truth) < 1e-3


@pytest.mark.parametrize("everywhere", [False, True])
@pytest.mark.parametrize("seed", range(6))
def test_noise_and_clutter_leave_a_tenth_of_a_degree(seed: int, everywhere: bool) -> None:
    truth = se3.so3_exp(np.random.default_rng(seed).normal(size=3))
    lines = manhattan_lines(truth, seed, noise=0.0005, clutter=60, everywhere=everywhere)
    found = estimate(lines, np.random.default_rng(0))
    assert error_deg(found, truth) < 0.25
    assert error_deg(found, truth) < 4 * np.degrees(found.sigma)  # the stated uncertainty is honest


def test_the_grid_peaks_at_the_axes() -> None:
    truth = se3.so3_exp(np.array([0.1, 0.2, -0.3]))
    lines = manhattan_lines(truth, 1)
    assert polar_grid(lines).shape == (90, 360)
    found = search(lines, np.random.default_rng(0))
    best = np.abs(truth.T @ found).max(axis=0)
    assert (best > np.cos(np.radians(2.5))).all()


@pytest.mark.parametrize("seed", range(8))
def test_lines_without_structure_are_declined(seed: int) -> None:
    lines = manhattan_lines(np.eye(3), seed, per_axis=0, clutter=120)
    with pytest.raises(Degenerate, match="weak_structure"):
        estimate(lines, np.random.default_rng(seed))


@pytest.mark.parametrize("case", ["none", "few", "one_direction", "identical"])
def test_too_little_is_declined(case: str) -> None:
    lines = manhattan_lines(np.eye(3), 3)
    rows = {"none": [], "few": [0, 1, 30, 31], "one_direction": list(range(25)), "identical": [0] * 40}[case]
    few = LineSegments(lines.normals[rows], lines.starts[rows], lines.ends[rows], lines.angles[rows])
    with pytest.raises(Degenerate):
        estimate(few, np.random.default_rng(0))


def test_the_expected_orientation_settles_the_ambiguity() -> None:
    truth = se3.so3_exp(np.array([0.2, 1.4, 0.1]))
    lines = manhattan_lines(truth, 4, noise=0.0005)
    near = se3.so3_exp(np.array([0.05, -0.08, 0.03])) @ truth
    found = estimate(lines, np.random.default_rng(0), expected=near)
    assert np.degrees(np.linalg.norm(se3.so3_log(found.cam_R_axes.T @ truth))) < 0.2


def test_same_seed_same_bits() -> None:
    lines = manhattan_lines(np.eye(3), 5, noise=0.001, clutter=30)
    a, b = (estimate(lines, np.random.default_rng(7)).cam_R_axes for _ in range(2))
    assert (a == b).all()


CAMERAS: dict[str, Camera] = {
    "pinhole": Pinhole(640, 480, 400.0, 400.0, 319.5, 239.5),
    "radtan": RadTan(640, 480, 400.0, 402.0, 322.0, 238.0, (-0.28, 0.07, 0.0002, 0.0001)),
    "fisheye": KannalaBrandt(848, 800, 285.0, 286.0, 424.0, 400.0, (-0.004, 0.038, -0.036, 0.006)),
}


def box_image(camera: Camera, cam_R_world: F64) -> np.ndarray:
    """A tiled room drawn pixel by pixel: walls at +-2, +-1.5, +-6 metres with tiles of 0.5 m, anti-aliased."""
    scale = 2
    u, v = np.meshgrid(np.arange(camera.width * scale), np.arange(camera.height * scale))
    rays = camera.unproject(np.stack([(u + 0.5) / scale - 0.5, (v + 0.5) / scale - 0.5], -1)) @ cam_R_world
    half = np.array([2.0, 1.5, 6.0])
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = np.where(np.abs(rays) > 1e-9, half / np.abs(rays), np.inf)
    wall = np.argmin(np.nan_to_num(reach, nan=np.inf), axis=-1)
    hit = rays * np.take_along_axis(reach, wall[..., None], -1)
    tile = np.floor(np.nan_to_num(hit) / 0.5).astype(int)
    across = np.take_along_axis(
        np.stack(
            [tile[..., 1] * 7 + tile[..., 2], tile[..., 0] * 5 + tile[..., 2], tile[..., 0] * 3 + tile[..., 1]], -1
        ),
        wall[..., None],
        -1,
    )[..., 0]
    grey = 60 + 37 * (across * 2654435761 % 5) + 8 * wall
    grey = np.where(np.isfinite(rays[..., 0]), grey, 0).astype(np.float32)
    return np.clip(cv2.resize(grey, camera.size, interpolation=cv2.INTER_AREA), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("name", list(CAMERAS))
def test_orientation_from_images_within_a_tenth_of_a_degree(name: str) -> None:
    camera = CAMERAS[name]
    truth = se3.so3_exp(np.array([0.1, 0.5, 0.05]))
    lines = LineDetector(camera).detect(box_image(camera, truth))
    assert error_deg(estimate(lines, np.random.default_rng(0)), truth) < 0.1
    if name == "fisheye":
        middle = lines.starts + lines.ends
        off_axis = np.degrees(np.arccos(middle[:, 2] / np.linalg.norm(middle, axis=1)))
        assert off_axis.max() > 65  # the faces beside the front one contribute


def test_the_rim_of_a_fisheye_is_not_a_line() -> None:
    plain = np.full((800, 848), 90, np.uint8)
    assert len(LineDetector(CAMERAS["fisheye"]).detect(plain)) == 0


def test_an_image_without_lines_is_declined() -> None:
    noise = np.random.default_rng(0).integers(0, 255, (60, 80)).astype(np.uint8)
    blurred = cv2.GaussianBlur(cv2.resize(noise, (640, 480), interpolation=cv2.INTER_CUBIC), (0, 0), 3)
    with pytest.raises(Degenerate):
        estimate(LineDetector(CAMERAS["pinhole"]).detect(np.asarray(blurred, np.uint8)), np.random.default_rng(0))
