"""Depth of a keyframe: of its pair, and of the motion from an earlier one and to a later one, joined by variances."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import chain, groupby, repeat

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.dense.depth import DepthImage, pair_depth
from stereo_sfm.dense.views import PairView, motion_view, stereo_view
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.types import F32, F64, I64, U8

MOTION_M = (
    0.1,
    0.4,
)  # between keyframes that are matched: less is a pair's own baseline, with more, views differ
BEST_M = 0.3
VIEW_PX = 640  # longest side of a view: finer ones cost more than a voxel of 2 cm shows
STEP = 2  # px of a view between depths: a voxel of 2 cm at 2.5 m and 200 px a radian
AGREE_SIGMAS = 3.0
AROUND = 16  # keyframes before and after one that may be `MOTION_M` apart
SPACING_M, SPACING_DEG = 0.25, 15.0  # between keyframes with depth: a shelf 1 m away is still seen by several


@dataclass(frozen=True, eq=False)
class KeyframeImages:
    """One keyframe, with what its depth is made of."""

    number: int  # row in the map
    rig: Rig
    map_T_cam: F64  # (4, 4)
    left: U8
    right: U8 | None


def with_partners(
    frames: Iterable[KeyframeImages], sessions: I64
) -> Iterator[tuple[KeyframeImages, list[KeyframeImages]] | None]:
    """Each keyframe with an earlier and a later one to match; None for one that shows what another showed.

    What one of them cannot see behind an edge the other often can, and of three depths two can outvote the third.
    """
    for _, visit in groupby(frames, lambda k: int(sessions[k.number])):
        last: KeyframeImages | None = None
        for past, now, coming in _around(visit):
            if last is not None and not shows_more(last, now):
                yield None
                continue
            last = now
            yield now, [k for k in (partner(past, now), partner(coming, now)) if k is not None]


def _around(
    visit: Iterable[KeyframeImages],
) -> Iterator[tuple[Sequence[KeyframeImages], KeyframeImages, Sequence[KeyframeImages]]]:
    past: deque[KeyframeImages] = deque(maxlen=AROUND)
    coming: deque[KeyframeImages] = deque()
    for one in chain(visit, repeat(None, AROUND)):
        if one is not None:
            coming.append(one)
        if coming and (one is None or len(coming) > AROUND):
            now = coming.popleft()
            yield past, now, coming
            past.append(now)


def partner(keyframes: Sequence[KeyframeImages], now: KeyframeImages) -> KeyframeImages | None:
    """The keyframe whose distance is nearest to `BEST_M`, None where none is `MOTION_M` apart."""
    apart = [float(np.linalg.norm(k.map_T_cam[:3, 3] - now.map_T_cam[:3, 3])) for k in keyframes]
    good = [i for i, d in enumerate(apart) if MOTION_M[0] <= d <= MOTION_M[1]]
    return keyframes[min(good, key=lambda i: abs(apart[i] - BEST_M))] if good else None


def shows_more(last: KeyframeImages, now: KeyframeImages) -> bool:
    """Whether the camera moved or turned enough since `last` for a depth image of its own."""
    moved = se3.inverse(last.map_T_cam) @ now.map_T_cam
    turned = 0.5 * (np.trace(moved[:3, :3]) - 1) < np.cos(np.deg2rad(SPACING_DEG))
    return bool(turned or np.linalg.norm(moved[:3, 3]) >= SPACING_M)


def keyframe_depth(now: KeyframeImages, others: Iterable[KeyframeImages]) -> DepthImage | None:
    """Depth of a keyframe's left camera; None where there is one camera and no motion.

    Every `STEP`-th pixel is refined, of the left images alone: other keyframes tell gross errors.
    """
    rig, found = now.rig, list[DepthImage]()
    scale = min(1.0, VIEW_PX / max(rig.left.size))
    if rig.second_camera is not None and now.right is not None:
        found.append(pair_depth(_pair_view(rig, scale), now.left, now.right, STEP))
    for other in others:
        now_T_other = se3.inverse(now.map_T_cam) @ other.map_T_cam
        view = motion_view(rig, other.rig, now_T_other, scale * rig.left.fx)
        if view is not None:
            found.append(pair_depth(view, now.left, other.left, STEP))
    return joined(found) if found else None


@lru_cache(4)
def _pair_view(rig: Rig, scale: float) -> PairView:
    return stereo_view(rig, scale)


def joined(images: Sequence[DepthImage]) -> DepthImage:
    """All in the view of the first: means by variance of what most agree on, nothing where they contradict each other.

    Ranges are compared by their inverses, whose errors are alike near and far.
    """
    first = images[0]
    measured = [(first.ranges, first.sigmas), *(seen_in(first, other) for other in images[1:])]
    inverse = np.stack([1 / ranges for ranges, _ in measured])
    variance = np.stack([np.square(sigmas / ranges**2) for ranges, sigmas in measured])
    apart = np.square(inverse[:, None] - inverse)  # (N, N, H, W)
    agree = apart <= AGREE_SIGMAS**2 * (variance[:, None] + variance)
    weight = np.nan_to_num(1 / variance)
    known = (agree * weight).sum(axis=1)  # by those that agree with each
    chosen = np.take_along_axis(agree, known.argmax(axis=0)[None, None], axis=0)[0]
    total = (chosen * weight).sum(axis=0)
    most = 2 * chosen.sum(axis=0) > np.isfinite(inverse).sum(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        out = np.where(most, total / (chosen * weight * np.nan_to_num(inverse)).sum(axis=0), np.nan)
        sigmas = out * out / np.sqrt(total)
    return replace(first, ranges=out.astype(np.float32), sigmas=sigmas.astype(np.float32))


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
