"""Points seen by both eyes at two moments: what a calibration can be judged by without a target."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from calib.matches import Matches, flattened, lucas_kanade, match_pair, pyramid_flow
from calib.rectification import Rectification
from stereo_sfm.types import F64, U8, Bool, StereoImage

MOVED = 0.05  # of the width: a window ends when its points moved so far
LONGEST = 12  # frames of a window


@dataclass(frozen=True, eq=False)
class Window:
    """The same N points in both eyes at one or two moments, in pixels of the original images, NaN where not seen."""

    left: F64  # (F, N, 2)
    right: F64  # (F, N, 2)
    right_velocity: F64  # (F, N, 2) px/s in the right image, NaN where unknown
    rows: Matches  # the first moment's matches, in rectified px


@dataclass(eq=False)
class _Tracking:
    """A window while it grows: rectified positions, float32."""

    start: Matches
    first: tuple[U8, U8]  # flattened images of the first moment
    last: tuple[U8, U8]
    left: Any
    right: Any
    alive: Bool
    last_ns: int
    age: int = 0
    first_velocity: F64 = field(default_factory=lambda: np.zeros((0, 2)))
    velocity: F64 = field(default_factory=lambda: np.zeros((0, 2)))


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
        if _finished(current, left.shape[1]):
            out.append(_close(current, rectification))
            current, wait = None, gap
            if len(out) >= windows:
                return out
    if current is not None:
        out.append(_close(current, rectification))
    return out


def _begin(matches: Matches, left: U8, right: U8, stamp_ns: int) -> _Tracking:
    a, b = matches.left.astype(np.float32), matches.right.astype(np.float32)
    return _Tracking(matches, (left, right), (left, right), a, b, np.ones(len(a), bool), stamp_ns)


def _advance(state: _Tracking, left: U8, right: U8, stamp_ns: int) -> None:
    seconds = max((stamp_ns - state.last_ns) * 1e-9, 1e-6)
    new_left, good_left = pyramid_flow(state.last[0], left, state.left)
    new_right, good_right = pyramid_flow(state.last[1], right, state.right)
    state.velocity = (new_right - state.right).astype(float) / seconds
    if state.age == 0:
        state.first_velocity = state.velocity
    state.alive &= good_left & good_right
    state.left, state.right, state.last = new_left, new_right, (left, right)
    state.last_ns, state.age = stamp_ns, state.age + 1


def _finished(state: _Tracking, width: int) -> bool:
    if state.age >= LONGEST or state.alive.mean() < 0.5:
        return True
    moved = np.linalg.norm(state.left - state.start.left, axis=1)[state.alive]
    return float(np.median(moved)) > MOVED * width


def _close(state: _Tracking, rectification: Rectification) -> Window:
    """Refine the end against the start and between the eyes, and go back to the original images' pixels."""
    count = len(state.start)
    shape = (1 if state.age == 0 else 2, count, 2)
    left, right, velocity = np.full(shape, np.nan), np.full(shape, np.nan), np.full(shape, np.nan)
    left[0] = rectification.left.to_source(state.start.left)
    right[0] = rectification.right.to_source(state.start.right)
    if state.age:
        begin = state.start.left.astype(np.float32)
        end_left, good = lucas_kanade(state.first[0], state.last[0], begin, state.left)
        end_right, good_right = lucas_kanade(*state.last, end_left, state.right)
        good &= good_right & state.alive
        good &= np.linalg.norm(end_left - state.left, axis=1) < 1.5
        good &= np.linalg.norm(end_right - state.right, axis=1) < 2.0
        left[1, good] = rectification.left.to_source(end_left[good].astype(float))
        right[1, good] = rectification.right.to_source(end_right[good].astype(float))
        velocity[0] = _moved(rectification, state.start.right, state.first_velocity)
        velocity[1] = _moved(rectification, end_right.astype(float), state.velocity)
        velocity[:, ~state.alive] = np.nan
    return Window(left, right, velocity, state.start)


def _moved(rectification: Rectification, uv: F64, velocity: F64) -> F64:
    """Velocity in rectified px/s -> in px/s of the original right image."""
    step = 1e-3
    return (rectification.right.to_source(uv + step * velocity) - rectification.right.to_source(uv)) / step
