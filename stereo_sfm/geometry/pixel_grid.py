"""Compiled grid over pixels: which of them may lie within a radius of another, without a look at all."""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false

from __future__ import annotations

import math

import numpy as np

from stereo_sfm.geometry.kernels import inner

MAX_CELLS = 512  # along either axis


@inner
def make_grid(uv, radius):
    """Square cells of at least `radius` px over pixels (N, 2); those with NaN are in none.

    Returns:
        (size px, least u, least v), (columns, rows), (C + 1,) where each cell begins in the list of members, row by
        row, and that list: rows of uv, ascending within a cell.
    """
    u0 = v0 = math.inf
    u1 = v1 = -math.inf
    for i in range(uv.shape[0]):
        if math.isfinite(uv[i, 0]) and math.isfinite(uv[i, 1]):
            u0, u1, v0, v1 = min(u0, uv[i, 0]), max(u1, uv[i, 0]), min(v0, uv[i, 1]), max(v1, uv[i, 1])
    if u1 < u0:
        return (1.0, 0.0, 0.0), (1, 1), np.zeros(2, np.int64), np.zeros(0, np.int64)
    size = max(radius, 1.0, (u1 - u0) / MAX_CELLS, (v1 - v0) / MAX_CELLS)
    columns, rows = int((u1 - u0) / size) + 1, int((v1 - v0) / size) + 1
    cell, starts = np.full(uv.shape[0], -1), np.zeros(columns * rows + 1, np.int64)
    for i in range(uv.shape[0]):
        if math.isfinite(uv[i, 0]) and math.isfinite(uv[i, 1]):
            cell[i] = int((uv[i, 1] - v0) / size) * columns + int((uv[i, 0] - u0) / size)
            starts[cell[i] + 1] += 1
    for c in range(columns * rows):
        starts[c + 1] += starts[c]
    members, at = np.empty(starts[-1], np.int64), starts[:-1].copy()
    for i in range(uv.shape[0]):
        if cell[i] >= 0:
            members[at[cell[i]]] = i
            at[cell[i]] += 1
    return (size, u0, v0), (columns, rows), starts, members


@inner
def cells_near(u, v, frame, shape):
    """Columns and rows (first, behind the last) of the cells in which all pixels within the radius lie; maybe none."""
    size, u0, v0 = frame
    if not (abs(u - u0) < 1e9 and abs(v - v0) < 1e9):
        return 0, 0, 0, 0
    c, r = math.floor((u - u0) / size), math.floor((v - v0) / size)
    return max(c - 1, 0), min(c + 2, shape[0]), max(r - 1, 0), min(r + 2, shape[1])
