"""Doors of a floor plan: doorways that it shows, and doors that people set."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from stereo_sfm.export.floor_plan import FREE, OCCUPIED, FloorPlan
from stereo_sfm.maps.labels import Door
from stereo_sfm.types import U8, Bool

NARROW_M, WIDE_M = 0.7, 1.6  # of a doorway: wheelchairs pass, and carts; cross aisles are wider
THICK_M = 0.5  # most of a wall, with what hangs on it
JAMB_M = 0.5  # of wall on each side
JAMB_CELLS = 3  # of it that are occupied: the rest is unknown, as the inside of walls is
BEYOND_M = 0.7  # from the wall's middle to where the floor is wide again
WIDER_M = 0.6  # by which it is
SEEN = 0.9  # share of that floor that must have been seen free
SAME_M = 0.8  # between the middles of one door as found and as set

Gap = tuple[float, float, float]  # first and last column, row: in cells


@dataclass(frozen=True)
class PlannedDoor:
    """A door on a floor plan."""

    door: Door
    seen_open: bool  # the plan shows a doorway there


def plan_doors(plan: FloorPlan, doors: Sequence[Door] = ()) -> list[PlannedDoor]:
    """Doorways that a plan shows, with the name of the door that was set there, then the other doors that were set.

    A doorway is an opening of 0.7 to 1.6 m in a thin wall along x or y, with wide floor before and behind it.
    """
    found = _doorways(plan)
    out: list[PlannedDoor] = []
    named: set[str] = set()
    for start, end in found:
        middle = np.add(start, end) / 2
        near = [d for d in doors if d.name not in named and np.linalg.norm(d.middle - middle) < SAME_M]
        name = min(near, key=lambda d: float(np.linalg.norm(d.middle - middle))).name if near else ""
        named |= {name} - {""}
        out.append(PlannedDoor(Door(name, start, end), True))
    out += [PlannedDoor(d, False) for d in doors if d.name not in named]
    return out


def _doorways(plan: FloorPlan) -> list[tuple[tuple[float, float], tuple[float, float]]]:
    """Both ends of each, in metres, ordered by place."""
    rising = plan.image[::-1]  # the first row has the least y
    out: list[tuple[tuple[float, float], tuple[float, float]]] = []
    for along_x in (True, False):
        for u0, u1, v in _gaps(rising if along_x else np.ascontiguousarray(rising.T), plan.resolution):
            (x0, y0), (x1, y1) = ((u, v) if along_x else (v, u) for u in (u0, u1))
            (ox, oy), r = plan.origin, plan.resolution
            out.append(((ox + x0 * r, oy + y0 * r), (ox + x1 * r, oy + y1 * r)))
    return sorted(out)


def _gaps(cells: U8, resolution: float) -> list[Gap]:
    """Doorways in walls along the rows."""
    occupied = cells == OCCUPIED
    free = cv2.medianBlur((cells == FREE).astype(np.uint8), 3).astype(bool) & ~occupied
    groups: list[list[tuple[int, int, int]]] = []  # of one opening in neighbouring rows
    for row in range(len(cells)):
        for u0, u1 in _openings(free[row], resolution):
            for group in groups:
                v0, v1, last = group[-1]
                if last == row - 1 and min(u1, v1) > max(u0, v0):
                    group.append((u0, u1, row))
                    break
            else:
                groups.append([(u0, u1, row)])
    out: list[Gap] = []
    for group in groups:
        low, high = group[0][2], group[-1][2] + 1
        u0, u1 = (int(np.median([gap[k] for gap in group])) for k in (0, 1))
        if (high - low) * resolution <= THICK_M and _is_doorway(occupied, free, (u0, u1), (low, high), resolution):
            out.append((u0, u1, 0.5 * (low + high)))
    return out


def _openings(free: Bool, resolution: float) -> list[tuple[int, int]]:
    """Columns from and to which a row is free between two pieces of wall."""
    edges = np.flatnonzero(np.diff(np.concatenate([[1], free.astype(np.int8), [1]])))
    walls = list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))  # whatever is not free
    return [
        (b, c)
        for (a, b), (c, d) in itertools.pairwise(walls)
        if NARROW_M <= (c - b) * resolution <= WIDE_M and min(b - a, d - c) * resolution >= JAMB_M
    ]


def _is_doorway(occupied: Bool, free: Bool, gap: tuple[int, int], rows: tuple[int, int], resolution: float) -> bool:
    """Whether a wall is seen on both sides of a gap, and wide floor before and behind it, with nothing in the way."""
    (u0, u1), (low, high) = gap, rows
    jamb, beyond, wider = (round(m / resolution) for m in (JAMB_M, BEYOND_M, 0.5 * WIDER_M))
    middle, along = (low + high) // 2, slice(max(low - 1, 0), high + 1)
    if middle < beyond or middle + beyond >= len(free):
        return False
    sides = occupied[along, max(u0 - jamb, 0) : u0 + 1], occupied[along, u1 - 1 : u1 + jamb]
    if min(side.sum() for side in sides) < JAMB_CELLS:
        return False
    quarter = (u1 - u0) // 4
    if occupied[middle - beyond : middle + beyond + 1, u0 + quarter : u1 - quarter].any():
        return False
    floor = slice(max(u0 - wider, 0), u1 + wider)
    return all(free[row, floor].mean() >= SEEN for row in (middle - beyond, middle + beyond))
