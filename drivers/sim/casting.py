"""Compiled image loops: rays through pixels, and pixels in which surfaces meet."""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false, reportPrivateUsage=false
# pyright: reportConstantRedefinition=false, reportMissingTypeArgument=false

from __future__ import annotations

import math

from stereo_sfm.drivers.sim import kernels
from stereo_sfm.drivers.sim.kernels import njit_finite
from stereo_sfm.drivers.sim.shading import shade


@njit_finite
def _ray(r, grid, du, dv, p, x, y):
    """Direction in the world of the ray (x, y) px from the centre of pixel p."""
    a, b, c = grid[p, 0], grid[p, 1], grid[p, 2]
    if x != 0 or y != 0:
        a += x * du[p, 0] + y * dv[p, 0]
        b += x * du[p, 1] + y * dv[p, 1]
        c += x * du[p, 2] + y * dv[p, 2]
    return (
        r[0, 0] * a + r[0, 1] * b + r[0, 2] * c,
        r[1, 0] * a + r[1, 1] * b + r[1, 2] * c,
        r[2, 0] * a + r[2, 1] * b + r[2, 2] * c,
    )


@njit_finite
def cast(
    w,
    moving,
    near,
    world_T_cam,
    pixels,
    offsets,
    keep,
    grid,
    du,
    dv,
    angles,
    image,
    depth,
    ids,
    ts,
    hits,
):
    """Render pixels: each the mean over one ray per offset and `keep` times the old value.

    Args:
        near: groups and blocks by distance (render.Near). world_T_cam: (4, 4).
        pixels: (M,) flat indices. offsets: (K, 2) px inside a pixel; one row for its centre alone.
        grid, du, dv: (H * W, 3) bearings and their change per pixel. angles: (H * W,) radians a pixel gathers.
        image, depth, ids: (H * W,) written: brightness; and with one offset distance along the ray (m), surface.
        ts, hits: (N,) scratch; so many rays are traced, then shaded, which is faster than one by one.
    """
    r, ox, oy, oz = world_T_cam, world_T_cam[0, 3], world_T_cam[1, 3], world_T_cam[2, 3]
    rays = offsets.shape[0]
    block = ts.shape[0] // rays
    narrow = 1 / math.sqrt(rays + keep)
    for first in range(0, pixels.shape[0], block):
        count = min(block, pixels.shape[0] - first)
        for i in range(count * rays):
            q = i % rays
            dx, dy, dz = _ray(r, grid, du, dv, pixels[first + i // rays], offsets[q, 0], offsets[q, 1])
            ts[i], hits[i] = kernels.trace(w, near, moving, ox, oy, oz, dx, dy, dz)
        for i in range(count):
            p = pixels[first + i]
            total = 0.0
            for q in range(rays):
                k = i * rays + q
                dx, dy, dz = _ray(r, grid, du, dv, p, offsets[q, 0], offsets[q, 1])
                total += shade(
                    w,
                    moving,
                    ts[k],
                    hits[k],
                    ox,
                    oy,
                    oz,
                    dx,
                    dy,
                    dz,
                    angles[p] * narrow,
                )
            image[p] = (total + keep * image[p]) / (rays + keep)
            if rays == 1:
                depth[p], ids[p] = ts[i], hits[i]


@njit_finite
def find_edges(image, ids, inner, contrast, out):
    """Flat indices of `inner` pixels at which another surface, brighter or darker by `contrast`, begins -> count."""
    h, wide, n = image.shape[0], image.shape[1], 0
    for v in range(1, h - 1):
        for u in range(1, wide - 1):
            here, value = ids[v, u], image[v, u]
            if inner[v, u] and (
                (ids[v, u - 1] != here and abs(image[v, u - 1] - value) > contrast)
                or (ids[v, u + 1] != here and abs(image[v, u + 1] - value) > contrast)
                or (ids[v - 1, u] != here and abs(image[v - 1, u] - value) > contrast)
                or (ids[v + 1, u] != here and abs(image[v + 1, u] - value) > contrast)
            ):
                out[n] = v * wide + u
                n += 1
    return n
