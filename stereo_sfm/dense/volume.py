"""A truncated signed distance field in cubes of 64 voxels a side, each computed from all keyframes that see it.

Curless and Levoy, SIGGRAPH 1996: the weighted mean of the distances along the rays, positive before a surface. Weights
are inverse variances, so that a near view of a shelf counts more than a far one; what is seen through by more weight
than ever saw a surface there vanishes. Of each voxel the three newest sessions that see it count: what three later
sessions contradict is gone. A cube depends on nothing but its keyframes, so cubes can be computed in any order, in
several processes, one at a time in memory, and again only where a keyframe moved.
"""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stereo_sfm.dense.depth import DepthImage
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.kernels import njit, project_one
from stereo_sfm.types import F32, F64, I64, Bool, ReadOnly

SIDE = 64  # voxels
APRON = 1  # voxels around a cube, from which its surface at the border follows
TRUNCATION = 4  # voxels before and behind a surface
SESSIONS = 3  # newest ones that count
TILE = 16  # px, of the coarse image of largest ranges
BLOCK = 11  # voxels a side that are left out together; 66 is a multiple


@dataclass(frozen=True, eq=False)
class Seen(ReadOnly):
    """A depth image with its place in the volume."""

    depth: DepthImage
    floor_T_cam: F64  # (4, 4)
    session: int

    def used(self, voxel: float) -> Bool:
        """(H, W) pixels whose range is known well enough to say where in the field a surface is."""
        return self.depth.sigmas <= TRUNCATION * voxel

    def reach(self, voxel: float) -> float:
        """Largest range in metres that is used."""
        return float(np.max(self.depth.ranges[self.used(voxel)], initial=0.0))


@dataclass(frozen=True, eq=False)
class Cube(ReadOnly):
    """Voxels (66, 66, 66) along x, y, z; voxel (0, 0, 0) is `APRON` before `index` * `SIDE`."""

    index: tuple[int, int, int]
    distance: F32  # metres, positive before surfaces; 0 where unseen
    weight: F32  # 1/m^2
    views: F32  # keyframes that saw it
    grey: F32  # grey levels


def touched(seen: Seen, voxel: float) -> set[tuple[int, int, int]]:
    """The cubes in which a depth image has surfaces."""
    points = seen.depth.points()[seen.used(voxel)].astype(np.float64)
    at = np.floor(se3.transform(seen.floor_T_cam, points) / (SIDE * voxel)).astype(np.int64)
    return {(int(x), int(y), int(z)) for x, y, z in np.unique(at, axis=0)}


def contributes(seen_from: F64, reach: F64, index: tuple[int, int, int], voxel: float) -> Bool:
    """(N,) whether cameras at `seen_from` (N, 3) that see as far as `reach` (N,) can say anything about a cube."""
    centre = (np.array(index) + 0.5) * SIDE * voxel
    radius = 0.5 * math.sqrt(3) * (SIDE + 2 * APRON) * voxel + TRUNCATION * voxel
    return np.linalg.norm(centre - seen_from, axis=1) <= reach + radius


def fuse(index: tuple[int, int, int], images: Sequence[Seen], voxel: float) -> Cube:
    """A cube from depth images, in the order given; sessions from the newest to the oldest."""
    n = SIDE + 2 * APRON
    corner = (np.array(index) * SIDE - APRON) * voxel
    total = [np.zeros((n, n, n), np.float32) for _ in range(4)]
    sessions = np.zeros((n, n, n), np.uint8)
    for session in sorted({s.session for s in images}, reverse=True):
        own = [np.zeros((n, n, n), np.float32) for _ in range(4)]
        for seen in images:
            if seen.session == session:
                _add(own, seen, corner, voxel)
        counts = (own[1] > 0) & (sessions < SESSIONS)
        sessions[counts] += 1
        for whole, part in zip(total, own, strict=True):
            whole[counts] += part[counts]
    distance, weight, views, grey = total
    weighed = np.maximum(weight, np.float32(1e-20))
    return Cube(index, (distance / weighed).astype(np.float32), weight, views, (grey / weighed).astype(np.float32))


def _add(sums: list[F32], seen: Seen, corner: F64, voxel: float) -> None:
    depth = seen.depth
    view_T_floor = se3.inverse(seen.floor_T_cam @ se3.from_rotation_translation(depth.cam_R_view, np.zeros(3)))
    camera = depth.camera
    _integrate(
        sums[0], sums[1], sums[2], sums[3], depth.ranges, depth.sigmas, depth.grey, _coarse(depth.ranges),
        camera.model_id, camera.params, view_T_floor[:3, :3].copy(), view_T_floor[:3, 3].copy(), corner, voxel,
    )  # fmt: skip


def _coarse(ranges: F32) -> F32:
    """Largest range of each tile and its eight neighbours; 0 where there is none."""
    import cv2

    h, w = (-(-n // TILE) for n in ranges.shape)
    padded = np.zeros((h * TILE, w * TILE), np.float32)
    padded[: ranges.shape[0], : ranges.shape[1]] = np.nan_to_num(ranges)
    most = padded.reshape(h, TILE, w, TILE).max(axis=(1, 3))
    return np.asarray(cv2.dilate(most, np.ones((3, 3), np.uint8)), np.float32)


@njit
def _integrate(distance, weight, views, grey, ranges, sigmas, image, coarse, model, params, turn, shift, corner, voxel):
    n = distance.shape[0]
    h, w = ranges.shape
    cut = TRUNCATION * voxel
    radius = 0.5 * math.sqrt(3.0) * BLOCK * voxel
    for bx in range(0, n, BLOCK):
        for by in range(0, n, BLOCK):
            for bz in range(0, n, BLOCK):
                x = corner[0] + (bx + 0.5 * (BLOCK - 1)) * voxel
                y = corner[1] + (by + 0.5 * (BLOCK - 1)) * voxel
                z = corner[2] + (bz + 0.5 * (BLOCK - 1)) * voxel
                px = turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] * z + shift[0]
                py = turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] * z + shift[1]
                pz = turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] * z + shift[2]
                away = math.sqrt(px * px + py * py + pz * pz)
                if away > radius and 1.5 * params[0] * radius < TILE * (away - radius):
                    found = project_one(model, params, px, py, pz)
                    u, v = found[0], found[1]
                    if not (-TILE <= u < w + TILE and -TILE <= v < h + TILE):
                        continue  # outside the view, as the block is smaller than a tile there
                    if 0 <= u < w and 0 <= v < h and away - radius > coarse[int(v) // TILE, int(u) // TILE] + cut:
                        continue  # behind everything around, or nothing was measured
                for i in range(bx, bx + BLOCK):
                    for j in range(by, by + BLOCK):
                        for k in range(bz, bz + BLOCK):
                            x, y, z = corner[0] + i * voxel, corner[1] + j * voxel, corner[2] + k * voxel
                            px = turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] * z + shift[0]
                            py = turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] * z + shift[1]
                            pz = turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] * z + shift[2]
                            found = project_one(model, params, px, py, pz)
                            u, v = found[0], found[1]
                            if not (0 <= u <= w - 1 and 0 <= v <= h - 1):
                                continue
                            r, c = int(v + 0.5), int(u + 0.5)
                            sigma = sigmas[r, c]
                            if not sigma <= cut:  # nothing measured, or not where
                                continue
                            d = ranges[r, c] - math.sqrt(px * px + py * py + pz * pz)
                            if d < -cut:
                                continue
                            one = 1.0 / (sigma * sigma + 0.25 * voxel * voxel)
                            distance[i, j, k] += one * min(d, cut)
                            weight[i, j, k] += one
                            views[i, j, k] += 1.0
                            grey[i, j, k] += one * float(image[r, c])


def voxel_places(index: tuple[int, int, int]) -> I64:
    """(3,) number of the first voxel of a cube, apron included, along each axis."""
    return np.array(index, np.int64) * SIDE - APRON
