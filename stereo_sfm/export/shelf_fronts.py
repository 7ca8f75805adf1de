"""Shelf fronts of a floor plan as lines, with the names of the aisles that they face."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from stereo_sfm.export.floor_plan import FREE, OCCUPIED, FloorPlan
from stereo_sfm.maps.changes import BESIDE_M
from stereo_sfm.maps.labels import Aisle
from stereo_sfm.types import U8

LONG_M = 1.0  # least length of a front
GAP_M = 0.5  # of a front that is not seen
OPEN_M = 0.3  # free floor in front of it
DEEP_M = 0.3  # by which what belongs to one front may be set back

Point = tuple[float, float]


@dataclass(frozen=True)
class Front:
    """A line along the front of a shelf, in metres of the floor plan."""

    start: Point
    end: Point
    faces: tuple[int, int]  # unit vector to the free floor
    label: str = ""  # "aisle 4, left"


def shelf_fronts(plan: FloorPlan, aisles: Sequence[Aisle] = ()) -> list[Front]:
    """Lines along x and y where occupied cells border on free floor, ordered by place."""
    image = plan.image[::-1]  # the first row has the least y
    found: list[Front] = []
    for faces in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        turned = np.ascontiguousarray(image.T if faces[0] else image)  # fronts along the columns of `turned`
        upwards = sum(faces) > 0
        for u0, u1, v in _lines(turned if upwards else np.ascontiguousarray(turned[::-1]), plan.resolution):
            v = v if upwards else turned.shape[0] - v
            ends = [((v, u) if faces[0] else (u, v)) for u in (u0, u1)]
            (x0, y0), (x1, y1) = (
                (plan.origin[0] + x * plan.resolution, plan.origin[1] + y * plan.resolution) for x, y in ends
            )
            found.append(_labelled(Front((x0, y0), (x1, y1), faces), aisles))
    return sorted(found, key=lambda f: (f.start, f.end, f.faces))


def _lines(cells: U8, resolution: float) -> list[tuple[float, float, float]]:
    """Fronts that face rising rows: first and last column, and row, in cells."""
    deep, far = max(round(DEEP_M / resolution), 1), max(round(OPEN_M / resolution), 1)
    free = (cells == FREE).astype(np.uint8)
    beyond = np.zeros_like(free)  # free floor within reach above a cell
    for k in range(1, far + 1):
        beyond[:-k] |= free[k:]
    border = (cells == OCCUPIED).astype(np.uint8) & beyond
    gap = 2 * round(0.5 * GAP_M / resolution) + 1
    together = cv2.morphologyEx(border, cv2.MORPH_CLOSE, np.ones((deep | 1, gap), np.uint8))
    count, labels, boxes, _ = cv2.connectedComponentsWithStats(together, connectivity=8)
    out: list[tuple[float, float, float]] = []
    for k in range(1, count):
        u0, v0, wide, high = (int(boxes[k, c]) for c in (0, 1, 2, 3))
        if wide * resolution < LONG_M or high > 3 * deep + wide // 4:
            continue
        inside = slice(v0, v0 + high), slice(u0, u0 + wide)
        mine = ((labels[inside] == k) & (border[inside] > 0))[::-1]
        edge = v0 + high - np.argmax(mine, axis=0)[mine.any(0)]  # the outermost cell in each column
        if len(edge):
            out.append((float(u0), float(u0 + wide), float(np.median(edge))))
    return out


def _labelled(front: Front, aisles: Sequence[Aisle]) -> Front:
    """With the name of the nearest aisle that it faces, and the side."""
    middle = np.add(front.start, front.end)[None] / 2
    best, label = BESIDE_M, ""
    for aisle in aisles:
        along, left = (float(v[0]) for v in aisle.place(middle))
        toward = float(aisle.place(middle + np.array(front.faces))[1][0]) - left
        facing = left * toward < 0 and abs(toward) > 0.7
        if facing and -0.5 < along < aisle.length + 0.5 and abs(left) < best:
            best, label = abs(left), f"{aisle.name}, {'left' if left > 0 else 'right'}"
    return Front(front.start, front.end, front.faces, label)
