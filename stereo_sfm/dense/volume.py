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
from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from itertools import groupby

import numpy as np

from stereo_sfm.dense.depth import DepthImage
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.kernels import PINHOLE, inner, njit, project_one
from stereo_sfm.types import F32, F64, I64, Bool, ReadOnly

SIDE = 64  # voxels
APRON = 1  # voxels around a cube, from which its surface at the border follows
TRUNCATION = 4  # voxels before and behind a surface
SESSIONS = 3  # newest ones that count
TILE = 8  # px, of the coarse image of largest ranges
BLOCK = 11  # voxels a side that are left out or projected together; 66 is a multiple
CACHED = 256  # depth images in memory of a process, less than 1 MB each: those that see one cube are 70 to 90
BENT_PX = 2.0  # second differences of projections over a block: up to here parabolas are right to a tenth of a pixel


@dataclass(frozen=True, eq=False)
class Seen(ReadOnly):
    """A depth image with its place in the volume."""

    depth: DepthImage
    floor_T_cam: F64  # (4, 4)
    session: int

    def used(self, voxel: float) -> Bool:
        """(H, W) pixels whose range is known well enough to say where in the field a surface is."""
        return _used(self.depth, voxel)

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
    low = at.min(axis=0, initial=0)
    shape = (at.max(axis=0, initial=0) - low + 1).tolist()
    cubes = np.unravel_index(np.unique(np.ravel_multi_index((at - low).T, shape)), shape)
    return set(map(tuple, (np.stack(cubes, axis=1) + low).tolist()))


def contributes(seen_from: F64, reach: F64, index: tuple[int, int, int], voxel: float) -> Bool:
    """(N,) whether cameras at `seen_from` (N, 3) that see as far as `reach` (N,) can say anything about a cube."""
    centre = (np.array(index) + 0.5) * SIDE * voxel
    radius = 0.5 * math.sqrt(3) * (SIDE + 2 * APRON) * voxel + TRUNCATION * voxel
    return np.linalg.norm(centre - seen_from, axis=1) <= reach + radius


def fuse(index: tuple[int, int, int], images: Iterable[Seen], voxel: float) -> Cube:
    """A cube from depth images, one at a time in memory; those of the newest session come first."""
    n = SIDE + 2 * APRON
    corner = (np.array(index) * SIDE - APRON) * voxel
    total = [np.zeros((n, n, n), np.float32) for _ in range(4)]
    sessions = np.zeros((n, n, n), np.uint8)
    for _, visit in groupby(images, lambda seen: seen.session):
        own = [np.zeros((n, n, n), np.float32) for _ in range(4)]
        for seen in visit:
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
        sums[0], sums[1], sums[2], sums[3], depth.ranges, depth.sigmas, depth.grey, _farthest_of_tiles(depth, voxel),
        camera.model_id, camera.params, view_T_floor[:3, :3].copy(), view_T_floor[:3, 3].copy(), corner, voxel,
    )  # fmt: skip


def _used(depth: DepthImage, voxel: float) -> Bool:
    """`Seen.used`, wherever the image is."""
    return depth.sigmas <= TRUNCATION * voxel


@lru_cache(CACHED)
def _farthest_of_tiles(depth: DepthImage, voxel: float) -> F32:
    """Largest range of each tile that is used, 0 where there is none."""
    height, width = depth.ranges.shape
    h, w = -(-height // TILE), -(-width // TILE)
    padded = np.zeros((h * TILE, w * TILE), np.float32)
    padded[:height, :width] = np.where(_used(depth, voxel), depth.ranges, 0)
    return padded.reshape(h, TILE, w, TILE).max(axis=(1, 3))


@inner
def _farthest(tiles, left, right, top, bottom):
    """Largest range of the tiles that pixels from `left` to `right` and `top` to `bottom` touch; -inf outside all."""
    h, w = tiles.shape
    most = -math.inf
    if not (right >= 0 and bottom >= 0 and left < w * TILE and top < h * TILE):
        return most
    for r in range(int(max(top, 0.0)) // TILE, int(min(bottom, h * TILE - 1.0)) // TILE + 1):
        for c in range(int(max(left, 0.0)) // TILE, int(min(right, w * TILE - 1.0)) // TILE + 1):
            most = max(most, tiles[r, c])
    return most


@inner
def _project_block(model, params, x, y, z, step, u, v):
    """Pixels (3, 3, 3) of corners and middles of a block from (x, y, z) on; whether others are on parabolas."""
    half = BLOCK // 2
    for i in range(3):
        for j in range(3):
            for k in range(3):
                a, b, c = half * i, half * j, half * k
                found = project_one(
                    model, params,
                    x + a * step[0, 0] + b * step[0, 1] + c * step[0, 2],
                    y + a * step[1, 0] + b * step[1, 1] + c * step[1, 2],
                    z + a * step[2, 0] + b * step[2, 1] + c * step[2, 2],
                )  # fmt: skip
                u[i, j, k], v[i, j, k] = found[0], found[1]
    even = True
    for i in range(3):
        for j in range(3):
            for p in (u, v):
                even &= abs(p[0, i, j] - 2 * p[1, i, j] + p[2, i, j]) <= BENT_PX  # not of NaN
                even &= abs(p[i, 0, j] - 2 * p[i, 1, j] + p[i, 2, j]) <= BENT_PX
                even &= abs(p[i, j, 0] - 2 * p[i, j, 1] + p[i, j, 2]) <= BENT_PX
    return even


@njit
def _integrate(distance, weight, views, grey, ranges, sigmas, image, tiles, model, params, turn, shift, corner, voxel):
    n = distance.shape[0]
    h, w = ranges.shape
    cut = TRUNCATION * voxel
    radius = 0.5 * math.sqrt(3.0) * BLOCK * voxel
    step = voxel * turn
    us, vs = np.empty((3, 3, 3)), np.empty((3, 3, 3))
    u3, v3 = np.empty(3), np.empty(3)
    share = np.empty((BLOCK, 3))  # of three values on a parabola, at each voxel
    for k in range(BLOCK):
        t = 2.0 * k / (BLOCK - 1) - 1.0
        share[k] = 0.5 * t * (t - 1), 1 - t * t, 0.5 * t * (t + 1)
    for bx in range(0, n, BLOCK):
        for by in range(0, n, BLOCK):
            for bz in range(0, n, BLOCK):
                x, y, z = corner[0] + bx * voxel, corner[1] + by * voxel, corner[2] + bz * voxel
                x0 = turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] * z + shift[0]
                y0 = turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] * z + shift[1]
                z0 = turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] * z + shift[2]
                half = 0.5 * (BLOCK - 1)
                px = x0 + half * (step[0, 0] + step[0, 1] + step[0, 2])
                py = y0 + half * (step[1, 0] + step[1, 1] + step[1, 2])
                pz = z0 + half * (step[2, 0] + step[2, 1] + step[2, 2])
                near = math.sqrt(px * px + py * py + pz * pz) - radius
                if near > 0 and 1.5 * params[0] * radius < TILE * near:
                    found = project_one(model, params, px, py, pz)  # a block smaller than a tile
                    u, v = found[0], found[1]
                    if not near <= _farthest(tiles, u - TILE, u + TILE, v - TILE, v + TILE) + cut:
                        continue  # outside the view, behind everything around, or nothing was measured
                even = _project_block(model, params, x0, y0, z0, step, us, vs)
                ahead = np.isfinite(us).sum()
                if ahead == 0:
                    continue
                hull = even or (model == PINHOLE and ahead == us.size)  # straight lines stay straight
                if hull and near > _farthest(tiles, us.min() - 2, us.max() + 2, vs.min() - 2, vs.max() + 2) + cut:
                    continue
                for i in range(BLOCK):
                    for j in range(BLOCK):
                        if even:
                            for c in range(3):
                                u3[c] = v3[c] = 0.0
                                for a in range(3):
                                    for b in range(3):
                                        s = share[i, a] * share[j, b]
                                        u3[c] += s * us[a, b, c]
                                        v3[c] += s * vs[a, b, c]
                        x1 = x0 + i * step[0, 0] + j * step[0, 1]
                        y1 = y0 + i * step[1, 0] + j * step[1, 1]
                        z1 = z0 + i * step[2, 0] + j * step[2, 1]
                        for k in range(BLOCK):
                            px, py, pz = x1 + k * step[0, 2], y1 + k * step[1, 2], z1 + k * step[2, 2]
                            if even:
                                u = share[k, 0] * u3[0] + share[k, 1] * u3[1] + share[k, 2] * u3[2]
                                v = share[k, 0] * v3[0] + share[k, 1] * v3[1] + share[k, 2] * v3[2]
                            else:
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
                            distance[bx + i, by + j, bz + k] += one * min(d, cut)
                            weight[bx + i, by + j, bz + k] += one
                            views[bx + i, by + j, bz + k] += 1.0
                            grey[bx + i, by + j, bz + k] += one * float(image[r, c])


def voxel_places(index: tuple[int, int, int]) -> I64:
    """(3,) number of the first voxel of a cube, apron included, along each axis."""
    return np.array(index, np.int64) * SIDE - APRON
