"""The tables that the compiled ray caster reads, and how they are collected."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from stereo_sfm.drivers.sim.atlas import Atlas
from stereo_sfm.drivers.sim.kernels import SOLID
from stereo_sfm.types import F64, I64, U8


class Tables(NamedTuple):
    """Everything that stands still. Metres; world axes: x along the aisles, y across them, z up, floor at 0."""

    room: F64  # (3,) extent
    groups: F64  # (G, 6) lo xyz, hi xyz around several blocks
    groups_i: I64  # (G, 2) first and last + 1 block
    blocks: F64  # (B, 6) lo xyz, hi xyz
    blocks_i: I64  # (B, 10) kind, facing, first and last + 1 level, six textures
    levels: F64  # (L, 3) z of the board's bottom, the floor products stand on, the top of the slot
    levels_i: I64  # (L, 5) first and last + 1 facing, offset into bins, open above, number of bins
    # (F, 11) cell u0 u1, box u0 u1, lower box's front w and top z, upper box's, 1 / unit height, 1 / depth, 1 / width
    facings: F64
    facings_i: I64  # (F, 7) textures front, side, top; block; level; form; material
    bins: I64  # (N,) first facing whose cell reaches into a bin of BIN metres
    texels: U8  # (M,)
    textures: I64  # (T, 4) offset, log2 width, log2 height, wraps
    texture_sizes: F64  # (T, 2) metres, (0, 0) for images that stretch
    # (M, 5) reflectance straight on, factor of reflection, roughness (radians), slope of ripples, share let through; in
    # the order of stereo_sfm.drivers.sim.optics; empty where nothing shines
    materials: F64
    panes: F64  # (P, 6) lo xyz, hi xyz of panes of glass, flat in x or y
    surfaces: I64  # (4 + SKIN + 1,) textures of floor, floor wear, ceiling, walls, then people's clothes, hair, skin


@dataclass
class Builder:
    """Collects rows of the tables."""

    atlas: Atlas = field(default_factory=Atlas)
    groups: list[list[float]] = field(default_factory=list[list[float]])
    groups_i: list[list[int]] = field(default_factory=list[list[int]])
    blocks: list[list[float]] = field(default_factory=list[list[float]])
    blocks_i: list[list[int]] = field(default_factory=list[list[int]])
    levels: list[list[float]] = field(default_factory=list[list[float]])
    levels_i: list[list[int]] = field(default_factory=list[list[int]])
    facings: list[list[float]] = field(default_factory=list[list[float]])
    facings_i: list[list[int]] = field(default_factory=list[list[int]])
    bins: list[int] = field(default_factory=list[int])
    materials: list[list[float]] = field(default_factory=list[list[float]])
    panes: list[list[float]] = field(default_factory=list[list[float]])

    def end_group(self, first: int) -> None:
        """Blocks from `first` on become a group."""
        rows = np.array(self.blocks[first:])
        self.groups.append([*rows[:, :3].min(0), *rows[:, 3:].max(0)])
        self.groups_i.append([first, len(self.blocks)])

    def solid(self, lo: tuple[float, float, float], hi: tuple[float, float, float], faces: list[int]) -> None:
        """A plain box; `faces` are textures of -x, +x, -y, +y, bottom, top."""
        self.blocks.append([*lo, *hi])
        self.blocks_i.append([SOLID, 0, 0, 0, *faces])


def make_tables(
    atlas: Atlas, room: tuple[float, float, float], surfaces: list[int], parts: Builder | None = None
) -> Tables:
    """Pack what was collected."""
    b = parts or Builder()
    texels, table, sizes = atlas.pack()
    return Tables(
        np.array(room, float),
        np.array(b.groups, float).reshape(-1, 6),
        np.array(b.groups_i, np.int64).reshape(-1, 2),
        np.array(b.blocks, float).reshape(-1, 6),
        np.array(b.blocks_i, np.int64).reshape(-1, 10),
        np.array(b.levels, float).reshape(-1, 3),
        np.array(b.levels_i, np.int64).reshape(-1, 5),
        np.array(b.facings, float).reshape(-1, 11),
        np.array(b.facings_i, np.int64).reshape(-1, 7),
        np.array(b.bins, np.int64),
        texels,
        table,
        sizes,
        np.array(b.materials, float).reshape(-1, 5),
        np.array(b.panes, float).reshape(-1, 6),
        np.array(surfaces, np.int64),
    )
