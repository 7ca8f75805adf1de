"""`Renderer`: images without sensor effects, depth and surface ids of a world from any pose, for any rig."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.drivers.sim.casting import cast, find_edges
from stereo_sfm.drivers.sim.kernels import TARGET
from stereo_sfm.drivers.sim.tables import Tables
from stereo_sfm.geometry.cameras import Camera
from stereo_sfm.types import F32, F64, I32, I64

EDGE_RAYS = np.array([[-0.11, -0.37], [0.38, 0.09], [-0.27, 0.28]])  # px, about the centre's own ray
EDGE_CONTRAST = 5.0  # step of brightness (of 255) above which a pixel gets several rays
SCRATCH = 1024  # rays traced before they are shaded
BREADTH = 1.3  # width of the texture filter in pixels, above 1 against aliasing
_CENTRE = np.zeros((1, 2))


def _grid(side: int) -> F64:
    """(side^2, 2) px: offsets of rays that fill a pixel evenly."""
    steps = (np.arange(side) - 0.5 * (side - 1)) / side
    return np.stack(np.meshgrid(steps, steps), -1).reshape(-1, 2)


TARGET_RAYS = _grid(6)  # for sub-pixel accuracy of flat targets


class Moving(NamedTuple):
    """Objects that move from frame to frame or are added to a store: people and flat targets."""

    persons: F64  # (Q, 6) boxes
    persons_i: I64  # (Q, 2) ellipsoid range
    ellipsoids: F64  # (E, 14) centre, 3x3 world -> unit sphere, girth radius, half length
    ellipsoids_i: I64  # (E,) texture
    targets: F64  # (N, 14) world_R_target row by row, origin (top-left corner), width, height
    targets_i: I64  # (N,) texture


NO_OBJECTS = Moving(
    np.zeros((0, 6)),
    np.zeros((0, 2), np.int64),
    np.zeros((0, 14)),
    np.zeros(0, np.int64),
    np.zeros((0, 14)),
    np.zeros(0, np.int64),
)


@dataclass(frozen=True, eq=False)
class View:
    """One camera's image without sensor effects."""

    image: F32  # (H, W) brightness, 0..255 before exposure, 0 outside the lens's field of view
    depth: F32  # (H, W) metres along the ray of the pixel's centre, NaN outside the field of view
    ids: I32  # (H, W) surface of the pixel's centre, -1 outside the field of view


def pixel_grid(camera: Camera) -> F64:
    """(H, W, 2) px."""
    return np.stack(np.meshgrid(np.arange(float(camera.width)), np.arange(float(camera.height))), -1)


class CameraRays:
    """The rays of a camera's pixels."""

    def __init__(self, camera: Camera, max_angle_deg: float = 93.0, displaced: F64 | None = None) -> None:
        """`displaced`: (H, W, 2) px from a pixel to where the camera's model expects what it shows."""
        self.camera = camera
        grid = camera.bearing_grid() if displaced is None else camera.unproject(pixel_grid(camera) + displaced)
        grid[np.nan_to_num(grid[..., 2], nan=-2.0) < np.cos(np.deg2rad(max_angle_deg))] = np.nan
        self.grid = grid  # (H, W, 3) unit bearings, NaN outside the field of view
        self.du, self.dv = (
            np.gradient(grid, axis=1),
            np.gradient(grid, axis=0),
        )  # (H, W, 3) per pixel
        angles = np.sqrt(np.linalg.norm(self.du, axis=-1) * np.linalg.norm(self.dv, axis=-1))
        self.angles = BREADTH * np.nan_to_num(angles, nan=1.0 / camera.fx)  # (H, W) radians that a pixel gathers
        self.inner = np.isfinite(self.du).all(-1) & np.isfinite(self.dv).all(-1)  # (H, W) has rays all around
        self.valid = np.flatnonzero(np.isfinite(grid[..., 2]))  # (N,) flat indices of pixels with a ray


class Near(NamedTuple):
    """Groups by distance from a camera, and within each group its blocks, nearest first; distances in metres."""

    groups: I64  # (G,)
    group_gaps: F64  # (G,)
    blocks: I64  # (B,) the blocks of group g in the places of its own range
    block_gaps: F64  # (B,)


def _gaps(boxes: F64, origin: F64) -> F64:
    """Distance from a point (3,) to boxes (N, 6)."""
    return np.linalg.norm(np.maximum(np.maximum(boxes[:, :3] - origin, origin - boxes[:, 3:]), 0), axis=1)


def _near(world: Tables, origin: F64, reach: float) -> Near:
    """`reach`: metres that a camera moves about the origin while its rows are read."""
    groups, blocks = (np.maximum(_gaps(boxes, origin) - reach, 0) for boxes in (world.groups, world.blocks))
    order = np.argsort(groups, kind="stable")
    member = np.repeat(np.arange(len(groups)), np.diff(world.groups_i, axis=1).ravel())
    inside = np.lexsort((np.arange(len(blocks)), blocks, member))
    return Near(order.astype(np.int64), groups[order], inside.astype(np.int64), blocks[inside])


class Renderer:
    """Renders one world for one rig."""

    def __init__(self, world: Tables, rig: Rig, rays: int = 1, displaced: Sequence[F64 | None] = (None, None)) -> None:
        """Args:
            rays: squared, how many go through a pixel; 1: one, and a few more where surfaces meet.
            displaced: of each camera's pixels, see `CameraRays`.

        With one ray the texture's filter stands for the pixel. It is not what the pixel sees of a slanted surface, and
        edges inside a texture are some hundredths of a pixel from where they should be.
        """
        self.world, self.rig = world, rig
        self._pixel_rays = _grid(rays) if rays > 1 else None
        lenses = [c for c in (rig.left, rig.right) if c is not None]
        self.cameras = [CameraRays(c, displaced=d) for c, d in zip(lenses, displaced, strict=False)]
        whole, real = (np.empty((2, SCRATCH), dtype) for dtype in (np.int64, np.float64))
        self._scratch = real[0], whole[0], real[1], whole[1]

    def render(self, world_T_cam: F64, moving: Moving = NO_OBJECTS) -> tuple[View, View]:
        """Views of both cameras; of a single camera the first twice.

        `world_T_cam`: (4, 4) pose of the left camera, or with a rolling shutter one for each row (H, 4, 4).
        """
        left = self.view(0, world_T_cam, moving)
        return left, self.view(1, world_T_cam @ self.rig.left_T_right, moving) if len(self.cameras) > 1 else left

    def view(self, side: int, world_T_cam: F64, moving: Moving = NO_OBJECTS) -> View:
        """One camera at its own pose (4, 4), or poses of its rows (H, 4, 4)."""
        rays, shape = self.cameras[side], self.cameras[side].grid.shape[:2]
        view = View(
            np.zeros(shape, np.float32),
            np.full(shape, np.nan, np.float32),
            np.full(shape, -1, np.int32),
        )
        marks = np.full(shape, -1, np.int32) if len(self.world.materials) else view.ids
        self._cast(rays, world_T_cam, moving, rays.valid, _CENTRE, 0, view, marks)
        if self._pixel_rays is not None:
            self._cast(rays, world_T_cam, moving, np.flatnonzero(rays.inner), self._pixel_rays, 0, view, marks)
        else:
            found = np.empty(view.ids.size, np.int64)
            edges = found[: find_edges(view.image, marks, rays.inner, EDGE_CONTRAST, found)]
            self._cast(rays, world_T_cam, moving, edges, EDGE_RAYS, 1, view, marks)
        if len(moving.targets):
            shown = ((view.ids >> 4) & 7 == TARGET) & (view.ids >= 0)
            near = cv2.dilate(shown.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
            self._cast(
                rays,
                world_T_cam,
                moving,
                np.flatnonzero(near & rays.inner),
                TARGET_RAYS,
                0,
                view,
                marks,
            )
        return view

    def _cast(
        self,
        rays: CameraRays,
        world_T_cam: F64,
        moving: Moving,
        pixels: I64,
        offsets: F64,
        keep: int,
        view: View,
        marks: I32,
    ) -> None:
        """Write flat `pixels` of the view: the mean over rays at `offsets` (K, 2) px and `keep` times the old value.

        `marks`: (H, W) written as well: differ where a mirror image or what is seen through glass changes.
        """
        poses = np.ascontiguousarray(world_T_cam, float).reshape(-1, 4, 4)  # one, or one for each row
        origins = poses[:, :3, 3]
        middle = origins[len(origins) // 2]
        near = _near(self.world, middle, float(np.linalg.norm(origins - middle, axis=1).max()))
        flat = [a.reshape(-1, 3) for a in (rays.grid, rays.du, rays.dv)]
        out = [a.reshape(-1) for a in (view.image, view.depth, view.ids, marks)]
        height, width = view.image.shape
        rows = np.searchsorted(pixels, width * np.arange(height + 1)) if len(poses) > 1 else (0, len(pixels))
        for pose, first, last in zip(poses, rows[:-1], rows[1:], strict=True):
            cast(
                self.world,
                moving,
                near,
                pose,
                pixels[first:last],
                offsets,
                float(keep),
                *flat,
                rays.angles.ravel(),
                *out,
                *self._scratch,
            )
