"""Lenses that differ from their calibration: displacements of the pixels of each camera, smooth over the image.

A pixel at p shows what the calibration expects at p + d(p). The calibration is one that was fitted to this lens: what
its own terms can describe of a displacement is taken out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.drivers.sim.render import pixel_grid
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Camera, Pinhole, RadTan
from stereo_sfm.types import F64

ORDERS = 5  # of the cosines of a smooth field along each axis: the shortest wave is half of the image
ROW_ORDERS = 3  # of the errors of a rectification: it is computed from few parameters
STEP = 1e-5  # of a term, for its derivative
TANGENTIAL = slice(2, 4)  # among OpenCV's coefficients
SAMPLED = 200  # columns of pixels that a fit uses

Term = tuple[Camera, F64]  # the lens with one number changed, and a small rotation (3,) of it


@dataclass(frozen=True)
class LensErrors:
    """Root mean squares over the image, px."""

    residual: float = 0.0  # a random smooth field, which no term of a lens describes
    decentered: float = 0.0  # tangential distortion, fitted by all other terms (Brown 1966)
    tilted: float = 0.0  # thin prism distortion, the same (Weng, Cohen & Herniou, PAMI 14, 1992, equation 11)
    rows: float = 0.0  # a random smooth field of the right image's rows, not fitted

    def displacements(self, rig: Rig, seed: int) -> list[F64 | None]:
        """(H, W, 2) px for each camera, NaN beyond the lens; None without errors."""
        cameras = [c for c in (rig.left, rig.right) if c is not None]
        if not any((self.residual, self.decentered, self.tilted, self.rows)):
            return [None for _ in cameras]
        return [self._of(camera, side, np.random.default_rng([seed, side, 113])) for side, camera in enumerate(cameras)]

    def _of(self, camera: Camera, side: int, rng: np.random.Generator) -> F64 | None:
        pixels = pixel_grid(camera)
        bearings = camera.unproject(pixels)
        seen = np.isfinite(bearings).all(-1, keepdims=True)
        x = (pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
        r2 = np.square(x).sum(-1, keepdims=True)
        angle = rng.uniform(0, 2 * np.pi, 2)  # of decentering and of tilt, from camera to camera
        along, prism = (np.array([np.cos(a), np.sin(a)]) for a in angle)
        field = smooth_field((camera.height, camera.width, 2), ORDERS, rng)
        rows = smooth_field((camera.height, camera.width, 2), ROW_ORDERS, rng) * (0.0, float(side))
        total = np.zeros(pixels.shape)
        for rms, shape, fitted in (
            (self.residual, field, _terms(camera, True)),
            (self.decentered, r2 * along + 2 * x * (x @ along)[..., None], _terms(camera, False)),
            (self.tilted, r2 * prism, _terms(camera, False)),
            (self.rows, rows, ()),
        ):
            if rms > 0:
                left = np.where(seen, shape, np.nan)
                left = unexplained(camera, left, bearings, fitted) if fitted else left
                total += rms * left / max(float(np.sqrt(np.nanmean(np.square(left).sum(-1)))), 1e-12)
        return total if total.any() else None


def smooth_field(shape: tuple[int, int, int], orders: int, rng: np.random.Generator) -> F64:
    """(H, W, 2): random sums of cosines, less of the shorter waves."""
    i, j = np.arange(orders), np.arange(orders)
    weight = rng.normal(size=(orders, orders, 2)) / (1.0 + np.hypot(*np.meshgrid(i, j, indexing="ij")))[..., None]
    down, across = (np.cos(np.pi * np.outer((np.arange(n) + 0.5) / n, i)) for n in shape[:2])
    return np.einsum("hi,ijk,wj->hwk", down, weight, across)


def unexplained(camera: Camera, field: F64, bearings: F64, terms: Sequence[Term]) -> F64:
    """What a least-squares fit of terms of the lens leaves of a field (H, W, 2) px, NaN beyond the lens."""
    step = max(camera.width // SAMPLED, 1)
    some = slice(step // 2, None, step)
    at, values = bearings[some, some].reshape(-1, 3), field[some, some].reshape(-1)
    matrix = np.stack([_derivative(camera, term, at).reshape(-1) for term in terms], 1)
    used = np.isfinite(matrix).all(1) & np.isfinite(values)
    shares = np.linalg.lstsq(matrix[used], values[used], rcond=None)[0]
    for share, term in zip(shares.tolist(), terms, strict=True):
        field = field - share * _derivative(camera, term, bearings)
    return field


def _derivative(camera: Camera, term: Term, bearings: F64) -> F64:
    """(..., 2) px that bearings (..., 3) move with a term."""
    changed, turn = term
    return changed.project(bearings @ se3.so3_exp(turn).T) - camera.project(bearings)


def _terms(camera: Camera, tangential: bool) -> list[Term]:
    """Everything that a calibration fits: pose of the board, focal lengths, centre, distortion."""
    turns = [(camera, STEP * axis) for axis in np.eye(3)]
    inner = [(replace(camera, **{name: getattr(camera, name) + 1.0}), np.zeros(3)) for name in ("fx", "fy", "cx", "cy")]
    lens = camera
    if isinstance(camera, Pinhole):
        lens = RadTan(*camera.size, camera.fx, camera.fy, camera.cx, camera.cy, (0.0,) * 5)
    steps = STEP * np.eye(len(lens.distortion))
    if isinstance(lens, RadTan) and not tangential:
        steps = np.delete(steps, TANGENTIAL, axis=0)
    bent = [(replace(lens, distortion=tuple((step + lens.distortion).tolist())), np.zeros(3)) for step in steps]
    return [*turns, *inner, *bent]
