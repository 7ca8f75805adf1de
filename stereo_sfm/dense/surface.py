"""The surface of a distance field as quadrilaterals: one vertex in each cell that it crosses (Gibson, surface nets).

The vertex is the mean of the crossings of the cell's edges. Cells have numbers of the whole volume, and all cubes at a
border compute the same vertex of a cell, so meshes of cubes join by the numbers, one cube at a time in memory.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereo_sfm.dense.volume import APRON, SIDE, Cube, voxel_places
from stereo_sfm.types import F32, F64, I64, U8, Bool, ReadOnly

LEAST_VIEWS = 2  # keyframes that must have seen a voxel: one alone may be wrong
SPAN = 1 << 20  # cells along an axis, half of them negative: 20 km of 2 cm
OFFSETS = [(i, j, k) for i in (0, 1) for j in (0, 1) for k in (0, 1)]
EDGES = [(a, b) for a in range(8) for b in range(8) if a < b and bin(a ^ b).count("1") == 1]


@dataclass(frozen=True, eq=False)
class Surface(ReadOnly):
    """Vertices by the numbers of their cells."""

    cells: I64  # (V,) ascending
    vertices: F32  # (V, 3) in voxels
    grey: U8  # (V,)
    quads: I64  # (Q, 4) numbers of cells, counter-clockwise seen from before the surface

    def triangles(self) -> I64:
        """(T, 3) rows of its vertices."""
        return np.searchsorted(self.cells, self.quads)[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)


def extract(cube: Cube) -> Surface:
    """The surface in a cube, with the vertices just beyond its border that its quadrilaterals need."""
    d, seen = cube.distance, cube.views >= LEAST_VIEWS
    n = d.shape[0] - 1
    at = [np.s_[i : i + n, j : j + n, k : k + n] for i, j, k in OFFSETS]
    known = np.logical_and.reduce([seen[a] for a in at])
    inside = [d[a] < 0 for a in at]
    crossed = known & np.logical_or.reduce(inside) & ~np.logical_and.reduce(inside)
    places = np.argwhere(crossed)
    corner = np.stack([d[a][crossed] for a in at], axis=1).astype(np.float64)
    numbers = _numbers(places + voxel_places(cube.index))
    grey = np.stack([cube.grey[a][crossed] for a in at], axis=1)
    near = 1 / (np.abs(corner) + 1e-6)
    shade = (grey * near).sum(1) / near.sum(1)
    vertices = (places + voxel_places(cube.index) + _crossings(corner)).astype(np.float32)
    quads = _quads(d, crossed, cube)
    used = np.unique(quads)
    keep = np.isin(numbers, used)
    order = np.argsort(numbers[keep])
    return Surface(
        numbers[keep][order],
        vertices[keep][order],
        np.clip(np.rint(shade), 0, 255).astype(np.uint8)[keep][order],
        quads,
    )


def _crossings(corner: F64) -> F64:
    """(V, 3) mean of the crossings of the edges of cells with distances (V, 8) at their corners."""
    total, count = np.zeros((len(corner), 3)), np.zeros(len(corner))
    for a, b in EDGES:
        da, db = corner[:, a], corner[:, b]
        cut = (da < 0) != (db < 0)
        share = np.where(cut, da / np.where(cut, da - db, 1), 0)
        start, end = np.array(OFFSETS[a], float), np.array(OFFSETS[b], float)
        total += np.where(cut[:, None], start + share[:, None] * (end - start), 0)
        count += cut
    return total / np.maximum(count, 1)[:, None]


def _quads(d: F32, crossed: Bool, cube: Cube) -> I64:
    """Around each edge from a voxel of the cube itself on which the sign changes, if all four cells have a vertex."""
    out: list[I64] = []
    own = np.s_[APRON : APRON + SIDE]
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        here = d[own, own, own] < 0
        part: list[slice] = [own, own, own]
        part[axis] = np.s_[APRON + 1 : APRON + SIDE + 1]
        there = d[tuple(part)] < 0
        base = np.argwhere(here != there) + APRON
        front = here[here != there]  # the surface looks along +axis
        around = [base.copy() for _ in range(4)]  # cells, once around the edge
        around[0][:, u] -= 1
        around[0][:, v] -= 1
        around[1][:, v] -= 1
        around[3][:, u] -= 1
        full = np.logical_and.reduce([crossed[tuple(a.T)] for a in around])
        numbers = np.stack([_numbers(a + voxel_places(cube.index)) for a in around], axis=1)
        numbers = np.where(front[:, None], numbers, numbers[:, ::-1])
        out.append(numbers[full])
    return np.concatenate(out)


def _numbers(cells: I64) -> I64:
    """(N, 3) -> (N,) one number for each cell of the volume."""
    shifted = cells + SPAN // 2
    return (shifted[:, 0] * SPAN + shifted[:, 1]) * SPAN + shifted[:, 2]


class Numbering:
    """Numbers of vertices in the mesh of all cubes, which are added in order of their index.

    A vertex that several cubes list gets its number at the first. Cubes list cells of their own and of those before
    them along the axes, so cells at upper borders of two layers of cubes across x are all that is remembered.
    """

    def __init__(self) -> None:
        self._known: dict[int, int] = {}  # numbers of vertices by cells
        self._layer = self._count = 0

    def add(self, surface: Surface) -> tuple[Bool, I64]:
        """Whether each vertex (V,) of a cube, at least one, is new, and its number (V,) in the mesh."""
        cells = surface.cells
        if cells[-1] // SPAN**2 // SIDE > self._layer:
            self._layer = cells[-1] // SPAN**2 // SIDE
            first = (self._layer * SIDE - 1) * SPAN**2
            self._known = {cell: number for cell, number in self._known.items() if cell >= first}
        border = np.logical_or.reduce([cells // SPAN**axis % SIDE == SIDE - 1 for axis in range(3)])
        shared = cells[border].tolist()
        numbers = np.full(len(cells), -1, np.int64)
        numbers[border] = [self._known.get(cell, -1) for cell in shared]
        new = numbers < 0
        numbers[new] = self._count + np.arange(new.sum())
        self._count += int(new.sum())
        self._known.update(zip(shared, numbers[border].tolist(), strict=True))
        return new, numbers
