"""`Renderer`: clean pictures, depth and surface ids of a world from any pose, for any rig."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from calib.rig import Rig
from drivers.sim.shading import cast, smooth_edges
from drivers.sim.world import Tables
from stereo_sfm.geometry.cameras import Camera
from stereo_sfm.types import F32, F64, I64

EDGE_RAYS = np.array([[-0.125, -0.375], [0.375, -0.125], [0.125, 0.375], [-0.375, 0.125]])  # rotated grid, px
EDGE_CONTRAST = 4.0  # least step of brightness (of 255) worth several rays


class Moving(NamedTuple):
    """What differs from frame to frame, or is put into a store: people and flat pictures."""

    persons: F64  # (Q, 6) boxes
    persons_i: I64  # (Q, 2) ellipsoid range
    ellipsoids: F64  # (E, 14) centre, 3x3 world -> unit sphere, girth radius, half length
    ellipsoids_i: I64  # (E,) texture
    targets: F64  # (N, 14) world_R_target row by row, origin (top-left corner), width, height
    targets_i: I64  # (N,) texture


NOTHING = Moving(
    np.zeros((0, 6)),
    np.zeros((0, 2), np.int64),
    np.zeros((0, 14)),
    np.zeros(0, np.int64),
    np.zeros((0, 14)),
    np.zeros(0, np.int64),
)


@dataclass(frozen=True, eq=False)
class View:
    """One eye's picture."""

    image: F32  # (H, W) brightness, 0..255 before exposure, 0 where the lens shows nothing
    depth: F32  # (H, W) metres along the pixel's ray, NaN where the lens shows nothing
    ids: I64  # (H, W) surface of the pixel's centre, -1 where the lens shows nothing


class Eye:
    """A camera's rays, computed once."""

    def __init__(self, camera: Camera, max_angle_deg: float = 93.0) -> None:
        self.camera = camera
        grid = camera.bearing_grid()
        beyond = np.nan_to_num(grid[..., 2], nan=-2.0) < np.cos(np.deg2rad(max_angle_deg))
        grid[beyond] = np.nan
        self.bearings = np.ascontiguousarray(grid)
        du, dv = (np.linalg.norm(np.gradient(np.nan_to_num(grid), axis=a), axis=-1) for a in (1, 0))
        self.angles = np.sqrt(du * dv).astype(np.float32)  # (H, W) radians a pixel covers


class Renderer:
    """Renders one world for one rig."""

    def __init__(self, world: Tables, rig: Rig) -> None:
        self.world, self.rig = world, rig
        self.eyes = [Eye(c) for c in (rig.left, rig.right) if c is not None]

    def render(self, world_T_cam: F64, moving: Moving = NOTHING) -> tuple[View, View]:
        """Both eyes at a pose of the left eye (4, 4); the second is the first for a single camera."""
        left = self.view(0, world_T_cam, moving)
        return left, self.view(1, world_T_cam @ self.rig.left_T_right, moving) if len(self.eyes) > 1 else left

    def view(self, eye: int, world_T_eye: F64, moving: Moving = NOTHING) -> View:
        """One eye at its own pose (4, 4)."""
        rays, shape = self.eyes[eye], self.eyes[eye].bearings.shape[:2]
        pose = np.ascontiguousarray(world_T_eye, float)
        image, depth, ids = np.zeros(shape, np.float32), np.zeros(shape, np.float32), np.zeros(shape, np.int64)
        smooth = np.zeros(shape, np.float32)
        order = self._order(pose[:3, 3])
        cast(self.world, moving, order, pose, rays.bearings, rays.angles, image, depth, ids)
        smooth_edges(
            self.world,
            moving,
            order,
            pose,
            rays.bearings,
            rays.angles,
            image,
            ids,
            smooth,
            EDGE_RAYS,
            EDGE_CONTRAST,
            -1,
        )
        return View(smooth, depth, ids)

    def _order(self, origin: F64) -> I64:
        """Groups by distance, nearest first."""
        lo, hi = self.world.groups[:, :3], self.world.groups[:, 3:]
        gap = np.maximum(np.maximum(lo - origin, origin - hi), 0)
        return np.argsort((gap**2).sum(1), kind="stable").astype(np.int64)
