"""Matches between two views of a scene with exact truth, as the motion estimators get them."""

from __future__ import annotations

import numpy as np

from stereo_sfm.geometry import se3
from stereo_sfm.papers.motion_estimator import FramePair
from stereo_sfm.types import F64

PIXEL = 1.0 / 400.0
BLANK = np.zeros((4, 4), np.uint8)


def unit(v: F64) -> F64:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def frame_pair(
    now_T_last: F64,
    count: int = 150,
    noise_px: float = 0.0,
    outliers: float = 0.0,
    wide: bool = False,
    seed: int = 0,
    baseline: float = 0.1,
    depth: bool = True,
) -> FramePair:
    """Points around a camera that moves by `now_T_last`; stereo depth has the noise that the pixels give it."""
    rng = np.random.default_rng(seed)
    if wide:
        last = unit(rng.normal(size=(count, 3))) * rng.uniform(1.5, 6, (count, 1))
    else:
        last = np.stack([rng.uniform(-3, 3, count), rng.uniform(-2, 2, count), rng.uniform(2, 8, count)], 1)
    now = se3.transform(now_T_last, last)
    bad = rng.permutation(count)[: int(outliers * count)]
    now[bad] = now[np.roll(bad, 1)]
    sides: list[tuple[F64, F64, F64]] = []
    for points in (last, now):
        distance = np.linalg.norm(points, axis=1)
        sigma = distance**2 * max(noise_px, 0.1) * PIXEL / baseline
        bearing = unit(unit(points) + rng.normal(size=points.shape) * noise_px * PIXEL)
        measured = bearing * (distance + rng.normal(size=count) * (sigma if noise_px else 0.0))[:, None]
        sides.append((bearing, measured if depth else np.full_like(points, np.nan), sigma))
    (b0, p0, s0), (b1, p1, s1) = sides
    return FramePair(b0, b1, p0, p1, s0, s1, PIXEL, BLANK, BLANK, 0, 1)
