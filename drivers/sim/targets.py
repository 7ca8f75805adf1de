"""Flat images of metric size at a pose: calibration boards, posters, walls of dots; alone or inside a store."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereo_sfm.drivers.sim import textures
from stereo_sfm.drivers.sim.atlas import Atlas
from stereo_sfm.drivers.sim.render import NO_OBJECTS, Moving
from stereo_sfm.drivers.sim.tables import Tables, make_tables
from stereo_sfm.types import F64, U8


@dataclass(frozen=True, eq=False)
class FlatTarget:
    """An image on a rectangle.

    Its frame: origin at the outer corner of the top-left pixel, x right, y down, z away from the viewer, so that a
    camera in front of it sees it upright with an identity rotation.
    """

    image: U8  # (h, w); sides that are powers of two are used as they are, others are resampled
    width: float  # metres
    height: float
    world_T_target: F64  # (4, 4)


def empty_room(extent: tuple[float, float, float] = (12.0, 10.0, 3.6), seed: int = 0) -> Tables:
    """A room with a floor, a ceiling and plain walls; nothing in it."""
    rng = np.random.default_rng([seed, 23])
    atlas = Atlas()
    surfaces = [
        atlas.add(textures.floor_tiles(rng, 512), (2.4, 2.4), wrap=True),
        atlas.add(textures.floor_scuffs(rng, 256, 256), (extent[0], extent[1]), wrap=True),
        atlas.add(textures.ceiling(rng, 512), (2.4, 2.4), wrap=True),
        atlas.add(textures.wall(rng), (1.2, 3.6), wrap=True),
    ]
    return make_tables(atlas, extent, surfaces)


def place(world: Tables, targets: list[FlatTarget], moving: Moving = NO_OBJECTS) -> tuple[Tables, Moving]:
    """The world with the targets' images, and the moving objects with the targets; `move` moves them."""
    atlas = Atlas(used=len(world.texels))
    for target in targets:
        atlas.add(target.image)
    texels, table, sizes = atlas.pack()
    first = len(world.textures)
    world = world._replace(
        texels=np.concatenate([world.texels, texels]),
        textures=np.concatenate([world.textures, table]),
        texture_sizes=np.concatenate([world.texture_sizes, sizes]),
    )
    indices = np.arange(first, first + len(targets), dtype=np.int64)
    rows = np.array([_row(t, t.world_T_target) for t in targets]).reshape(-1, 14)
    return world, moving._replace(targets=rows, targets_i=indices)


def move(moving: Moving, target: FlatTarget, world_T_target: F64, index: int = 0) -> Moving:
    """FlatTarget number `index` at another pose."""
    rows = moving.targets.copy()
    rows[index] = _row(target, world_T_target)
    return moving._replace(targets=rows)


def _row(target: FlatTarget, world_T_target: F64) -> F64:
    rotation, origin = world_T_target[:3, :3], world_T_target[:3, 3]
    return np.concatenate([rotation.ravel(), origin, [target.width, target.height]])
