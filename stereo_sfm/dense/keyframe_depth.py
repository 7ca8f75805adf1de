"""Depth of a keyframe: of its pair, and of the motion from an earlier keyframe, joined by their variances."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.dense.depth import DepthImage, pair_depth
from stereo_sfm.dense.views import PairView, motion_view, stereo_view
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.types import F32, F64, U8

MOTION_M = (
    0.1,
    0.4,
)  # between keyframes that are matched: less is a pair's own baseline, with more, views differ
BEST_M = 0.3
VIEW_PX = 640  # longest side of a view: finer ones cost more than a voxel of 2 cm shows
STEP = 2  # px of a view between depths: a voxel of 2 cm at 2.5 m and 200 px a radian
AGREE_SIGMAS = 3.0
SPACING_M, SPACING_DEG = 0.25, 15.0  # between keyframes with depth: a shelf 1 m away is still seen by several


@dataclass(frozen=True, eq=False)
class KeyframeImages:
    """One keyframe, with what its depth is made of."""

    number: int  # row in the map
    rig: Rig
    map_T_cam: F64  # (4, 4)
    left: U8
    right: U8 | None


def earlier(keyframes: Sequence[KeyframeImages], now: KeyframeImages) -> KeyframeImages | None:
    """The keyframe whose distance is nearest to `BEST_M`, None where none is `MOTION_M` apart."""
    apart = [float(np.linalg.norm(k.map_T_cam[:3, 3] - now.map_T_cam[:3, 3])) for k in keyframes]
    good = [i for i, d in enumerate(apart) if MOTION_M[0] <= d <= MOTION_M[1]]
    return keyframes[min(good, key=lambda i: abs(apart[i] - BEST_M))] if good else None


def shows_more(last: KeyframeImages, now: KeyframeImages) -> bool:
    """Whether the camera moved or turned enough since `last` for a depth image of its own."""
    moved = se3.inverse(last.map_T_cam) @ now.map_T_cam
    turned = 0.5 * (np.trace(moved[:3, :3]) - 1) < np.cos(np.deg2rad(SPACING_DEG))
    return bool(turned or np.linalg.norm(moved[:3, 3]) >= SPACING_M)


def keyframe_depth(now: KeyframeImages, before: KeyframeImages | None) -> DepthImage | None:
    """Depth of a keyframe's left camera; None where there is one camera and no motion.

    Every `STEP`-th pixel is refined, of the left images alone: other keyframes tell gross errors.
    """
    rig, pair = now.rig, None
    scale = min(1.0, VIEW_PX / max(rig.left.size))
    if rig.second_camera is not None and now.right is not None:
        pair = pair_depth(_pair_view(rig, scale), now.left, now.right, STEP)
    if before is None:
        return pair
    now_T_before = se3.inverse(now.map_T_cam) @ before.map_T_cam
    view = motion_view(rig.left, before.rig.left, now_T_before, scale * rig.left.fx)
    if view is None:
        return pair
    moved = pair_depth(view, now.left, before.left, STEP)
    return moved if pair is None else joined(pair, moved)


@lru_cache(4)
def _pair_view(rig: Rig, scale: float) -> PairView:
    return stereo_view(rig, scale)


def joined(first: DepthImage, second: DepthImage) -> DepthImage:
    """Both in the view of the first: means by variance where they agree, nothing where they contradict each other.

    Ranges are compared by their inverses, whose errors are alike near and far.
    """
    ranges, sigmas = seen_in(first, second)
    a, b = 1 / first.ranges, 1 / ranges
    va, vb = np.square(first.sigmas * a * a), np.square(sigmas * b * b)
    agree = np.abs(a - b) <= AGREE_SIGMAS * np.sqrt(va + vb)
    mean, variance = (a * vb + b * va) / (va + vb), va * vb / (va + vb)
    both = np.isfinite(a) & np.isfinite(b)
    inverse = np.where(both, np.where(agree, mean, np.nan), np.where(np.isfinite(a), a, b))
    spread = np.sqrt(np.where(both, variance, np.where(np.isfinite(a), va, vb)))
    out = 1 / inverse
    return replace(first, ranges=out.astype(np.float32), sigmas=(spread * out * out).astype(np.float32))


def seen_in(view: DepthImage, other: DepthImage) -> tuple[F32, F32]:
    """Ranges and standard deviations (H, W) of another image from the same place, at the pixels of a view."""
    rays = view.camera.bearing_grid() @ (view.cam_R_view.T @ other.cam_R_view)
    uv = other.camera.project(rays)
    inside = other.camera.inside(uv, -0.49)  # the nearest pixel is in the image
    at = np.rint(np.where(inside[..., None], uv, 0)).astype(np.int64)
    pick = at[..., 1], at[..., 0]
    nan = np.float32(np.nan)
    return np.where(inside, other.ranges[pick], nan), np.where(inside, other.sigmas[pick], nan)


def check_rig(rig: Rig) -> None:
    """Raises StereoSfmError for cameras whose depth comes with the images."""
    if rig.depth:
        raise StereoSfmError("this camera measures depth itself (RGB-D): dense depth is made from two grey images")
