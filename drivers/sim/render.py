"""`Renderer`: clean pictures, depth and surface ids of a world from any pose, for any rig."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from calib.rig import Rig
from drivers.sim.kernels import TARGET
from drivers.sim.shading import cast, find_edges
from drivers.sim.world import Tables
from stereo_sfm.geometry.cameras import Camera
from stereo_sfm.types import F32, F64, I32, I64

EDGE_RAYS = np.array([[-0.125, -0.375], [0.375, -0.125], [0.125, 0.375], [-0.375, 0.125]])  # rotated grid, px
EDGE_CONTRAST = 4.0  # least step of brightness (of 255) worth several rays
_STEPS = (np.arange(6) - 2.5) / 6
TARGET_RAYS = np.stack(np.meshgrid(_STEPS, _STEPS), -1).reshape(-1, 2)  # flat pictures are for sub-pixel measurement
CHUNK = 400_000  # rays at a time


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
    depth: F32  # (H, W) metres along the ray of the pixel's centre, NaN where the lens shows nothing
    ids: I32  # (H, W) surface of the pixel's centre, -1 where the lens shows nothing


class Eye:
    """A camera's rays, computed once."""

    def __init__(self, camera: Camera, max_angle_deg: float = 93.0) -> None:
        self.camera = camera
        grid = camera.bearing_grid()
        grid[np.nan_to_num(grid[..., 2], nan=-2.0) < np.cos(np.deg2rad(max_angle_deg))] = np.nan
        self.grid = grid  # (H, W, 3) unit bearings, NaN where the lens shows nothing
        self.du, self.dv = np.gradient(grid, axis=1), np.gradient(grid, axis=0)  # (H, W, 3) per pixel
        angles = np.sqrt(np.linalg.norm(self.du, axis=-1) * np.linalg.norm(self.dv, axis=-1))
        self.valid = np.flatnonzero(np.isfinite(grid[..., 2]))  # (N,) flat indices of pixels with a ray
        self.bearings = grid.reshape(-1, 3)[self.valid]  # (N, 3)
        self.angles = np.nan_to_num(angles, nan=1.0 / camera.fx).ravel()  # (H * W,) radians a pixel covers
        self.inner = np.isfinite(self.du).all(-1) & np.isfinite(self.dv).all(-1)  # (H, W) has rays all around

    def spread(self, pixels: I64, offsets: F64) -> tuple[F64, F64]:
        """Rays at `offsets` (K, 2) px inside flat `pixels` (M,) -> bearings (M * K, 3), angles (M * K,)."""
        centre, du, dv = (a.reshape(-1, 3)[pixels, None] for a in (self.grid, self.du, self.dv))
        rays = centre + offsets[:, :1] * du + offsets[:, 1:] * dv
        return rays.reshape(-1, 3), np.repeat(self.angles[pixels] / np.sqrt(len(offsets)), len(offsets))


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
        rays, shape = self.eyes[eye], self.eyes[eye].grid.shape[:2]
        values, depths, hits = self.cast(world_T_eye, moving, rays.bearings, rays.angles[rays.valid])
        image, depth = np.zeros(shape, np.float32), np.full(shape, np.nan, np.float32)
        ids = np.full(shape, -1, np.int32)
        image.flat[rays.valid], depth.flat[rays.valid], ids.flat[rays.valid] = values, depths, hits
        found = np.empty(ids.size, np.int64)
        edges = found[: find_edges(image, ids, EDGE_CONTRAST, found)]
        self._refine(rays, world_T_eye, moving, edges[rays.inner.flat[edges]], EDGE_RAYS, image)
        if len(moving.targets):
            near = cv2.dilate((ids >> 4 & 7 == TARGET).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
            self._refine(rays, world_T_eye, moving, np.flatnonzero(near & rays.inner), TARGET_RAYS, image)
        return View(image, depth, ids)

    def cast(self, world_T_eye: F64, moving: Moving, bearings: F64, angles: F64) -> tuple[F32, F32, I32]:
        """Rays (N, 3) of an eye, each standing for `angles` (N,) radians -> brightness, metres, surface (N,)."""
        n, pose = len(bearings), np.ascontiguousarray(world_T_eye, float)
        values, depths, ids = np.empty(n, np.float32), np.empty(n, np.float32), np.empty(n, np.int32)
        cast(self.world, moving, self._order(pose[:3, 3]), pose, bearings, angles, values, depths, ids)
        return values, depths, ids

    def _refine(self, rays: Eye, world_T_eye: F64, moving: Moving, pixels: I64, offsets: F64, image: F32) -> None:
        """Replace pixels of `image` by the mean over several rays each."""
        for part in np.array_split(pixels, len(pixels) * len(offsets) // CHUNK + 1):
            values = self.cast(world_T_eye, moving, *rays.spread(part, offsets))[0]
            image.flat[part] = values.reshape(-1, len(offsets)).mean(1)

    def _order(self, origin: F64) -> I64:
        """Groups by distance, nearest first."""
        lo, hi = self.world.groups[:, :3], self.world.groups[:, 3:]
        gap = np.maximum(np.maximum(lo - origin, origin - hi), 0)
        return np.argsort((gap**2).sum(1), kind="stable").astype(np.int64)
