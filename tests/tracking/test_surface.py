"""Disparity planes of matched windows, on pairs whose disparity is known at every pixel."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from stereo_sfm.tracking.flow import klt
from stereo_sfm.tracking.flow.stereo_cameras import StereoCameras
from stereo_sfm.tracking.flow.surface import fit_planes
from stereo_sfm.types import F32, F64, U8
from tests.synthetic import pinhole_rig

SIZE = (400, 400)
GRID = np.stack(np.meshgrid(np.arange(60.0, 340, 25), np.arange(60.0, 340, 25)), -1).reshape(-1, 2)


def texture(seed: int) -> F32:
    noise = np.random.default_rng(seed).normal(size=SIZE).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 1.5) + 3 * cv2.GaussianBlur(noise, (0, 0), 5.0)
    return (120 + 40 * smooth / smooth.std()).astype(np.float32)


def look(pattern: F32, u: F64, v: F64) -> F32:
    seen = cv2.remap(pattern, u.astype(np.float32), v.astype(np.float32), cv2.INTER_CUBIC, borderMode=cv2.BORDER_WRAP)
    return np.asarray(seen, np.float32)


def eight_bits(image: F32, seed: int, noise: float) -> U8:
    noisy = image + np.random.default_rng(seed).normal(0, noise, image.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def fit(left: U8, right: U8, uv: F64, uv_right: F64) -> tuple[F64, F64, F64]:
    return fit_planes(left, right, uv, uv_right, StereoCameras.of(pinhole_rig()), klt.WEIGHTS, klt.COORDINATES)


def matched(left: U8, right: U8, uv: F64, guess: F64) -> F64:
    """The window as a whole, aligned by translation."""
    return klt.track_translation((left,), (right,), uv, guess, 0, 0, 2.0, 0.6, klt.WEIGHTS)


@pytest.mark.parametrize("slope", [0.0, 0.06, -0.1])
def test_slanted_windows_fit_at_their_centre(slope: float) -> None:
    pattern, v, u = texture(1), *np.mgrid[: SIZE[0], : SIZE[1]].astype(float)
    middle, disparity = 200.0, 12.0
    right = look(pattern, (u + disparity - slope * middle) / (1 - slope), v)
    left, right = eight_bits(pattern, 2, 1.0), eight_bits(right, 3, 1.0)
    true = GRID - np.stack([disparity + slope * (GRID[:, 0] - middle), np.zeros(len(GRID))], 1)
    whole = matched(left, right, GRID, true)
    fitted, misfit, sigma_px = fit(left, right, GRID, whole)
    seen = np.isfinite(misfit)
    assert seen.mean() > 0.95
    error, before = (np.linalg.norm(found - true, axis=1)[seen] for found in (fitted, whole))
    assert np.sqrt((error**2).mean()) < 0.05
    assert slope == 0 or np.sqrt((error**2).mean()) < 0.6 * np.sqrt((before**2).mean())
    assert np.median(misfit[seen]) < 2
    assert 0.3 < np.sqrt((error**2).mean() / (sigma_px[seen] ** 2).mean()) < 3


def test_a_window_with_a_depth_edge_has_a_large_residual() -> None:
    near, far, v, u = texture(4), texture(5), *np.mgrid[: SIZE[0], : SIZE[1]].astype(float)
    edges, apart = 188.0, 2.5  # px of the edge, and between the disparities
    left = np.where(u < edges, near, far)
    right = np.where(u + 10 + apart < edges, look(near, u + 10 + apart, v), look(far, u + 10, v))
    left, right = eight_bits(left, 6, 1.0), eight_bits(right, 7, 1.0)
    uv = GRID.copy()
    disparity = np.where(uv[:, 0] < edges, 10 + apart, 10)
    guess = uv - np.stack([disparity, np.zeros(len(uv))], 1)
    _, misfit, _ = fit(left, right, uv, matched(left, right, uv, guess))
    on_edge = np.abs(uv[:, 0] - edges) < 6
    assert on_edge.sum() > 5
    typical = np.median(misfit[~on_edge & np.isfinite(misfit)])
    assert (misfit[on_edge] > 8 * typical).mean() > 0.8
    assert (misfit[~on_edge & (np.abs(uv[:, 0] - edges) > 15)] < 8 * typical).mean() > 0.9


def test_a_flat_window_has_an_uncertain_match() -> None:
    pattern = 120 + 0.03 * (texture(8) - 120)
    left, right = eight_bits(pattern, 9, 1.0), eight_bits(look(pattern, *reversed(np.mgrid[:400, :400] + 0.0)), 10, 1.0)
    _, _, sigma_px = fit(left, right, GRID, GRID.copy())
    assert np.median(sigma_px) > 0.3
    assert np.isinf(fit(left, right, GRID, np.full_like(GRID, np.nan))[1]).all()
