"""Compiled image loops: rays through pixels, and pixels in which surfaces meet."""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false, reportPrivateUsage=false
# pyright: reportConstantRedefinition=false, reportMissingTypeArgument=false

from __future__ import annotations

import math

from stereo_sfm.drivers.sim import kernels
from stereo_sfm.drivers.sim.kernels import njit_finite
from stereo_sfm.drivers.sim.optics import add_second_rays
from stereo_sfm.drivers.sim.shading import shade


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
    marks,
    ts,
    hits,
    values,
    seen,
):
    """Render pixels: each the mean over one ray per offset and `keep` times the old value.

    Args:
        near: groups and blocks by distance (render.Near). world_T_cam: (4, 4).
        pixels: (M,) flat indices. offsets: (K, 2) px inside a pixel; one row for its centre alone.
        grid, du, dv: (H * W, 3) bearings and their change per pixel. angles: (H * W,) radians a pixel gathers.
        image, depth, ids: (H * W,) written: brightness; and with one offset distance along the ray (m), surface.
        marks: (H * W,) written where second rays are traced: numbers that differ where other surfaces are seen.
        ts, hits, values, seen: (N,) scratch; so many rays are traced, then shaded, which is faster than one by one.
    """
    ox, oy, oz = world_T_cam[0, 3], world_T_cam[1, 3], world_T_cam[2, 3]
    rays = offsets.shape[0]
    block = ts.shape[0] // rays
    narrow = 1 / math.sqrt(rays + keep)
    shines = w.materials.shape[0] > 0
    for first in range(0, pixels.shape[0], block):
        count = min(block, pixels.shape[0] - first)
        for i in range(count * rays):
            q = i % rays
            p = pixels[first + i // rays]
            dx, dy, dz = kernels.ray(world_T_cam, grid, du, dv, p, offsets[q, 0], offsets[q, 1])
            ts[i], hits[i] = kernels.trace(w, near, moving, 0.0, ox, oy, oz, dx, dy, dz)
        for i in range(count * rays):
            q = i % rays
            p = pixels[first + i // rays]
            dx, dy, dz = kernels.ray(world_T_cam, grid, du, dv, p, offsets[q, 0], offsets[q, 1])
            values[i] = shade(w, moving, ts[i], hits[i], ox, oy, oz, dx, dy, dz, angles[p] * narrow)
        if shines:
            add_second_rays(
                w, moving, near, world_T_cam, pixels, first, count, offsets, grid, du, dv, angles, narrow,
                ts, hits, values, seen,
            )  # fmt: skip
        for i in range(count):
            p = pixels[first + i]
            total = 0.0
            for q in range(rays):
                total += values[i * rays + q]
            image[p] = (total + keep * image[p]) / (rays + keep)
            if rays == 1:
                depth[p], ids[p] = ts[i], hits[i]
                if shines:
                    marks[p] = seen[i]


@njit_finite
def find_edges(image, ids, inner, contrast, out):
    """Flat indices of `inner` pixels at which another id and brightness, different by `contrast`, begin -> count."""
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
