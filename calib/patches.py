"""Sub-pixel alignment of small patches under affine warps and brightness changes.

The inverse compositional algorithm of Baker and Matthews (IJCV 56, 2004, section 3.2) for an affine warp with gain and
offset. Every later image is aligned with the first one, so that errors do not accumulate along a track.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereo_sfm.types import F64, U8, Bool

HALF = 8  # px: half the size of a patch
F32 = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Patches:
    """The appearance of points in one image."""

    offset: F32  # (P, 2) px from the centre
    value: F32  # (N, P)
    slope: F32  # (N, P, 8) derivative of the value by position (2), affine warp (4), gain and offset, windowed
    inverse: F32  # (N, 8, 8) of the normal equations


@dataclass(eq=False)
class Warp:
    """Patches in another image: a pixel at offset x from the centre maps to uv + stretch @ x."""

    uv: F32  # (N, 2)
    stretch: F32  # (N, 2, 2)


def smooth(image: U8) -> F32:
    """The image smoothed for alignment."""
    import cv2

    return np.asarray(cv2.GaussianBlur(image.astype(np.float32), (0, 0), 0.8), np.float32)


def cut(image: F32, uv: F64) -> Patches:
    """Patches around (N, 2) px of a smoothed image."""
    import cv2

    steps = np.arange(-HALF, HALF + 1, dtype=np.float32)
    offset = np.stack([m.ravel() for m in np.meshgrid(steps, steps)], -1).astype(np.float32)
    place = uv[:, None].astype(np.float32) + offset
    across: Any = cv2.Sobel(image, cv2.CV_32F, 1, 0, ksize=3, scale=1 / 8)
    down: Any = cv2.Sobel(image, cv2.CV_32F, 0, 1, ksize=3, scale=1 / 8)
    value, gx, gy = (_sample(p, place) for p in (image, across, down))
    x, y = offset.T
    centred = value - value.mean(1, keepdims=True)
    slope = np.stack([gx, gy, gx * x, gx * y, gy * x, gy * y, centred, np.ones_like(gx)], -1)
    window = np.exp(-(x * x + y * y) / (2 * (0.6 * HALF) ** 2))[:, None]
    normal = np.swapaxes(slope * window, 1, 2) @ slope
    diagonal = np.einsum("nii->ni", normal)
    diagonal *= 1.0 + 1e-4
    diagonal += 1e-2
    return Patches(offset, value, slope * window, np.linalg.inv(normal).astype(np.float32))


def align(patches: Patches, image: F32, start: Warp, iterations: int = 8) -> tuple[Warp, Bool]:
    """The warps of the patches in another smoothed image, and (N,) whether each converged.

    Args:
        patches: of the first image. image: the other image.
        start: initial warps, within about two pixels.
    """
    uv, stretch = start.uv, start.stretch
    moved, seen = np.full(len(uv), np.inf, np.float32), patches.value
    for _ in range(iterations):
        place = uv[:, None] + patches.offset @ np.swapaxes(stretch, 1, 2)
        seen = _sample(image, np.asarray(place, np.float32))
        error = seen - patches.value
        step = (patches.inverse @ (np.swapaxes(patches.slope, 1, 2) @ error[..., None]))[..., 0]
        change = np.eye(2, dtype=np.float32) + np.clip(step[:, 2:6], -0.3, 0.3).reshape(-1, 2, 2)
        stretch = np.asarray(stretch @ np.linalg.inv(change), np.float32)
        shift = (stretch @ np.clip(step[:, :2], -2, 2)[..., None])[..., 0]
        uv = np.asarray(uv - shift, np.float32)
        moved = np.abs(shift).max(1)
    size = np.linalg.det(stretch)
    good = (moved < 0.02) & (size > 0.25) & (size < 4) & (_likeness(patches.value, seen) > 0.9)
    good &= np.linalg.norm(uv - start.uv, axis=1) < 2.5
    height, width = image.shape
    inside = (uv > HALF).all(1) & (uv[:, 0] < width - 1 - HALF) & (uv[:, 1] < height - 1 - HALF)
    return Warp(uv, stretch), good & inside


def unstretched(uv: F64) -> Warp:
    """An initial warp from positions only."""
    return Warp(uv.astype(np.float32), np.broadcast_to(np.eye(2, dtype=np.float32), (len(uv), 2, 2)).copy())


def _sample(image: F32, place: F32) -> F32:
    """(N, P) values at (N, P, 2) px, bilinear."""
    import cv2

    nothing: Any = None
    options: Any = {"interpolation": cv2.INTER_LINEAR, "borderMode": cv2.BORDER_REPLICATE}
    return np.asarray(cv2.remap(image, np.ascontiguousarray(place), nothing, **options), np.float32)


def _likeness(a: F32, b: F32) -> F32:
    """(N,) normalised cross-correlation."""
    a, b = a - a.mean(1, keepdims=True), b - b.mean(1, keepdims=True)
    return (a * b).sum(1) / np.maximum(np.sqrt((a * a).sum(1) * (b * b).sum(1)), 1e-6)
