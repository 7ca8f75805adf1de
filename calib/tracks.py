"""Points seen by both eyes at several moments: what a calibration can be judged by without a target."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from calib.matches import Matches, flattened, lucas_kanade, match_pair, pyramid_flow
from calib.rectification import Rectification
from stereo_sfm.types import F64, U8, Bool, StereoImage

STEP = 0.04  # of the width: a moment is kept when the points moved so far since the last one
MOMENTS = 6  # of a window
LONGEST = 24  # frames of a window


@dataclass(frozen=True, eq=False)
class Window:
    """The same N points in both eyes at F moments, in pixels of the original images, NaN where not seen."""

    left: F64  # (F, N, 2)
    right: F64  # (F, N, 2)
    right_velocity: F64  # (F, N, 2) px/s in the right image, NaN where unknown
    rows: Matches  # the first moment's matches, in rectified px


@dataclass(eq=False)
class _Moment:
    """Rectified positions (N, 2) px, NaN where lost, and the right eye's velocities in px/s."""

    left: F64
    right: F64
    velocity: F64


@dataclass(eq=False)
class _Tracking:
    """A window while it grows: rectified positions, float32."""

    start: Matches
    kept: tuple[U8, Any]  # flattened left image of the last kept moment, and the points there
    last: tuple[U8, U8]
    left: Any
    right: Any
    alive: Bool
    last_ns: int
    moments: list[_Moment]
    velocity: F64
    age: int = 0  # frames since the start
    fresh: int = 0  # frames since the last kept moment


def collect(
    images: Iterable[StereoImage],
    rectification: Rectification,
    windows: int = 10,
    gap: int = 0,
    max_matches: int = 400,
    search_rows: int = 14,
) -> list[Window]:
    """Windows one after the other.

    Args:
        images: pairs in order of time; those without a right image are skipped.
        rectification: of the rig to judge.
        windows: at most so many.
        gap: frames between the end of one window and the start of the next.
        max_matches: corners of one window.
        search_rows: see `match_pair`.
    """
    out: list[Window] = []
    current: _Tracking | None = None
    wait = 0
    for image in images:
        if image.right is None:
            continue
        if current is None and wait > 0:
            wait -= 1
            continue
        left, right = rectification.apply(image.left, image.right)
        if current is None:
            matches = match_pair(rectification, left, right, max_matches, search_rows)
            if len(matches) >= 12:
                current = _begin(matches, flattened(left), flattened(right), image.stamp_ns)
            continue
        _advance(current, flattened(left), flattened(right), image.stamp_ns)
        if _moved(current) > STEP * left.shape[1]:
            _keep(current)
        if len(current.moments) == MOMENTS or current.age >= LONGEST or current.alive.mean() < 0.3:
            out.append(_close(current, rectification))
            current, wait = None, gap
            if len(out) >= windows:
                return out
    if current is not None:
        out.append(_close(current, rectification))
    return out


def _begin(matches: Matches, left: U8, right: U8, stamp_ns: int) -> _Tracking:
    a, b = matches.left.astype(np.float32), matches.right.astype(np.float32)
    unknown = np.full(a.shape, np.nan)
    first = _Moment(matches.left, matches.right, unknown)
    return _Tracking(matches, (left, a), (left, right), a, b, np.ones(len(a), bool), stamp_ns, [first], unknown)


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
    """Median movement in px since the last kept moment."""
    moved = np.linalg.norm(state.left - state.kept[1], axis=1)[state.alive]
    return float(np.median(moved)) if len(moved) else 0.0


def _keep(state: _Tracking) -> None:
    """A moment: the left points refined against the last moment's, the right ones against the left."""
    left, good = lucas_kanade(state.kept[0], state.last[0], state.kept[1], state.left)
    right, good_right = lucas_kanade(*state.last, left, state.right)
    state.alive &= good & (np.linalg.norm(left - state.left, axis=1) < 1.5)
    good_right &= np.linalg.norm(right - state.right, axis=1) < 2.0
    seen = state.alive & good_right
    state.moments.append(
        _Moment(np.where(state.alive[:, None], left, np.nan), np.where(seen[:, None], right, np.nan), state.velocity)
    )
    state.left = np.where(state.alive[:, None], left, state.left)
    state.kept, state.fresh = (state.last[0], state.left), 0


def _close(state: _Tracking, rectification: Rectification) -> Window:
    """Keep the end too, and go back to the original images' pixels."""
    if state.fresh and len(state.moments) < MOMENTS:
        _keep(state)
    left = np.stack([rectification.left.to_source(m.left.astype(float)) for m in state.moments])
    right = np.stack([rectification.right.to_source(m.right.astype(float)) for m in state.moments])
    velocity = np.stack([_in_source(rectification, m.right.astype(float), m.velocity) for m in state.moments])
    return Window(left, right, velocity, state.start)


def _in_source(rectification: Rectification, uv: F64, velocity: F64) -> F64:
    """Velocity in rectified px/s -> in px/s of the original right image."""
    step = 1e-3
    return (rectification.right.to_source(uv + step * velocity) - rectification.right.to_source(uv)) / step
