"""Points tracked in both cameras at several moments, for checking a calibration without a target."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from stereo_sfm.calib.matches import Matches, flattened, match_pair, pyramid_flow
from stereo_sfm.calib.patches import Patches, Warp, align, cut, smooth, unstretched
from stereo_sfm.calib.rectification import Rectification
from stereo_sfm.types import F64, U8, Bool, StereoImage

MIN_MOTION = 0.04  # of the image width, between two moments
MAX_MOMENTS = 6  # in a window
MAX_FRAMES = 24  # in a window
MIN_POINTS = 12  # in a window


@dataclass(frozen=True, eq=False)
class Window:
    """The same N points in both cameras at F moments, in pixels of the original images, NaN where not seen."""

    left: F64  # (F, N, 2)
    right: F64  # (F, N, 2)
    right_velocity: F64  # (F, N, 2) px/s in the right image, NaN where unknown
    rows: Matches  # the first moment's matches, in rectified px


@dataclass(eq=False)
class _Moment:
    """Rectified positions (N, 2) px, NaN where lost, and the right camera's velocities in px/s."""

    left: F64
    right: F64
    velocity: F64


@dataclass(eq=False)
class _Tracking:
    """A window under construction: rectified positions, float32."""

    start: Matches
    patches: Patches  # of the first left image
    warps: tuple[Warp, Warp]  # to the left and the right image of the last kept moment
    last: tuple[U8, U8]
    left: Any
    right: Any
    alive: Bool
    last_ns: int
    moments: list[_Moment]
    velocity: F64
    age: int = 0  # frames since the start
    fresh: int = 0  # frames since the last kept moment


def still_window(rectification: Rectification, image: StereoImage, max_matches: int, search_rows: int) -> Window:
    """A window of one moment: the matches of one pair. Arguments as those of `collect`."""
    assert image.right is not None
    rows = match_pair(rectification, *rectification.apply(image.left, image.right), max_matches, search_rows)
    left, right = rectification.left.to_source(rows.left)[None], rectification.right.to_source(rows.right)[None]
    return Window(left, right, np.full_like(right, np.nan), rows)


def collect(
    images: Iterable[StereoImage],
    rectification: Rectification,
    windows: int = 10,
    gap: int = 0,
    max_matches: int = 400,
    search_rows: int = 14,
) -> list[Window]:
    """Collect windows one after the other.

    Args:
        images: pairs in temporal order; those without a right image are skipped.
        rectification: of the rig to check.
        windows: maximum number.
        gap: frames between the end of one window and the start of the next.
        max_matches: corners of one window.
        search_rows: see `match_pair`.
    """
    out: list[Window] = []
    current: _Tracking | None = None
    pair: tuple[U8, U8] | None = None
    wait = 0
    for image in images:
        if image.right is None:
            continue
        if current is None and wait > 0:
            wait -= 1
            continue
        left, right = pair = rectification.apply(image.left, image.right)
        if current is None:
            matches = match_pair(rectification, left, right, max_matches, search_rows)
            current = _begin(matches, left, right, image.stamp_ns) if len(matches) >= MIN_POINTS else None
            if current is not None and current.alive.sum() < MIN_POINTS:
                current = None
            continue
        _advance(current, flattened(left), flattened(right), image.stamp_ns)
        if _moved(current) > MIN_MOTION * left.shape[1]:
            _keep(current, left, right)
        if len(current.moments) == MAX_MOMENTS or current.age >= MAX_FRAMES or current.alive.mean() < 0.3:
            out.append(_close(current, rectification, pair))
            current, wait = None, gap
            if len(out) >= windows:
                return out
    if current is not None and pair is not None:
        out.append(_close(current, rectification, pair))
    return out


def corners_for(frames: int, windows: int) -> int:
    """Number of corners in a window, more if a recording is too short for many windows."""
    return int(np.clip(4800 / max(1.0, min(windows, frames / MAX_FRAMES)), 400, 1600))


def _begin(matches: Matches, left: U8, right: U8, stamp_ns: int) -> _Tracking:
    """Patches of the left image, aligned in the right image."""
    patches = cut(smooth(left), matches.left)
    here = unstretched(matches.left)
    there, good = align(patches, smooth(right), unstretched(matches.right))
    a, b = here.uv, there.uv
    unknown = np.full(a.shape, np.nan)
    first = _Moment(matches.left, np.where(good[:, None], b, np.nan).astype(float), unknown)
    last = flattened(left), flattened(right)
    return _Tracking(matches, patches, (here, there), last, a, b, good, stamp_ns, [first], unknown)


def _advance(state: _Tracking, left: U8, right: U8, stamp_ns: int) -> None:
    seconds = max((stamp_ns - state.last_ns) * 1e-9, 1e-6)
    new_left, good_left = pyramid_flow(state.last[0], left, state.left)
    new_right, good_right = pyramid_flow(state.last[1], right, state.right)
    state.alive &= good_left & good_right
    state.velocity = np.where(state.alive[:, None], (new_right - state.right).astype(float) / seconds, np.nan)
    if state.age == 0:
        state.moments[0].velocity = state.velocity
    state.left, state.right, state.last = new_left, new_right, (left, right)
    state.last_ns, state.age, state.fresh = stamp_ns, state.age + 1, state.fresh + 1


def _moved(state: _Tracking) -> float:
    """Median motion in px since the last kept moment."""
    moved = np.linalg.norm(state.left - state.warps[0].uv, axis=1)[state.alive]
    return float(np.median(moved)) if len(moved) else 0.0


def _keep(state: _Tracking, left: U8, right: U8) -> None:
    """Add a moment: align the first image's patches in both rectified images, starting from the flow."""
    here, good = align(state.patches, smooth(left), Warp(state.left, state.warps[0].stretch))
    there, good_right = align(state.patches, smooth(right), Warp(state.right, state.warps[1].stretch))
    state.alive &= good & good_right
    lost = ~state.alive[:, None]
    a, b = np.where(lost, np.nan, here.uv), np.where(lost, np.nan, there.uv)
    state.moments.append(_Moment(a.astype(float), b.astype(float), state.velocity))
    state.left, state.right = np.where(lost, state.left, here.uv), np.where(lost, state.right, there.uv)
    state.warps, state.fresh = (Warp(state.left, here.stretch), Warp(state.right, there.stretch)), 0


def _close(state: _Tracking, rectification: Rectification, pair: tuple[U8, U8]) -> Window:
    """Keep the last moment too, and convert to pixels of the original images."""
    if state.fresh and len(state.moments) < MAX_MOMENTS:
        _keep(state, *pair)
    left = np.stack([rectification.left.to_source(m.left) for m in state.moments])
    right = np.stack([rectification.right.to_source(m.right) for m in state.moments])
    velocity = np.stack([_in_source(rectification, m.right, m.velocity) for m in state.moments])
    return Window(left, right, velocity, state.start)


def _in_source(rectification: Rectification, uv: F64, velocity: F64) -> F64:
    """Velocity in rectified px/s -> px/s of the original right image."""
    step = 1e-3
    return (rectification.right.to_source(uv + step * velocity) - rectification.right.to_source(uv)) / step
