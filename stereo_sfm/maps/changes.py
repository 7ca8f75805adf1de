"""What a session changed in a map, in words: `aisle 4, left, 2-5 m: new`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from stereo_sfm.geometry import se3
from stereo_sfm.maps.floor import HIGH, LOW
from stereo_sfm.maps.labels import Aisle
from stereo_sfm.maps.update import Update
from stereo_sfm.types import F64

ENOUGH = 8  # points of the session in a cell that was looked at, of earlier sessions in one that the map knew
CHANGED = 0.35  # of the usual share of points found again, below which a cell has changed
BESIDE_M = 3.0  # metres from an aisle's line to its shelves: wide aisles have four to six
NEAR_M = 6.0  # metres from a keyframe; points farther away are too uncertain
VIEWS = 3  # keyframes that see a point that counts: one by chance is seen by fewer
NEW, OTHER = "new", "changed"


def changed_cells(update: Update, map_T_floor: F64) -> list[tuple[str, float, float]]:
    """Square metres of the floor whose shelves are new to the map or show other things: kind, x, y (middle).

    Where a session finds again far fewer of its points than it usually does, although it sees that square and the map
    knew it, other things stand there.
    """
    s, sessions = update.together, update.together_sessions
    floor_T_map = se3.inverse(map_T_floor)
    points = se3.transform(floor_T_map, s.points)
    centres = s.map_T_kf[:, :3, 3]
    near = np.linalg.norm(s.points[s.obs_pt] - centres[s.obs_kf], axis=1) < NEAR_M
    solid = (points[:, 2] > LOW) & (points[:, 2] < HIGH)
    ours = sessions[s.obs_kf] == update.session
    views = [np.bincount(s.obs_pt[near & by], minlength=len(s.pt_ids)) for by in (ours, ~ours)]
    mine, before = ((count >= VIEWS) & solid for count in views)
    cell = np.floor(points[:, :2]).astype(np.int64)
    cells, which = np.unique(cell, axis=0, return_inverse=True)
    seen, known, again = (np.bincount(which[rows], minlength=len(cells)) for rows in (mine, before, mine & before))
    looked = (seen >= ENOUGH) & (known >= ENOUGH)
    usual = float(np.median(again[looked] / seen[looked])) if looked.any() else 0.0
    missing = usual * seen - again
    other = looked & (again < CHANGED * usual * seen) & (missing > 2 * np.sqrt(usual * seen))  # sigmas of a count
    new = (seen >= ENOUGH) & (known < ENOUGH)
    rows = np.flatnonzero(new | other).tolist()
    return [(NEW if new[k] else OTHER, *(cells[k] + 0.5).tolist()) for k in rows]


def describe_changes(cells: Sequence[tuple[str, float, float]], aisles: Sequence[Aisle]) -> list[str]:
    """Lines for people; cells beside no aisle by their place on the floor plan."""
    spans: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for kind, x, y in cells:
        where, begin, end = _where(np.array([[x, y]]), aisles)
        spans.setdefault((where, kind), []).append((begin, end))
    out: list[str] = []
    for (where, kind), parts in sorted(spans.items()):
        for begin, end in _together(sorted(parts)):
            to = " to " if begin < 0 else "-"
            out.append(f"{where}{begin:.0f}{to}{end:.0f} m: {kind}")
    return out


def _where(xy: F64, aisles: Sequence[Aisle]) -> tuple[str, float, float]:
    """The shelf, and the metres along it at which a cell begins and ends."""
    best, text, middle, least = BESIDE_M, f"y {xy[0, 1]:.1f} m, x ", float(xy[0, 0]), -np.inf
    for aisle in aisles:
        along, left = (float(v[0]) for v in aisle.place(xy))
        if -0.5 <= along <= aisle.length + 0.5 and abs(left) < best:
            best = abs(left)
            text, middle, least = f"{aisle.name}, {'left' if left > 0 else 'right'}, ", along, 0.0
    return text, max(middle - 0.5, least), max(middle + 0.5, least)


def _together(parts: list[tuple[float, float]]) -> list[tuple[float, float]]:
    out: list[tuple[float, float]] = []
    for begin, end in parts:
        if out and begin <= out[-1][1] + 0.5:
            out[-1] = out[-1][0], max(end, out[-1][1])
        else:
            out.append((begin, end))
    return out
