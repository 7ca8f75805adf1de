"""Compiled second rays: what glossy surfaces and panes of glass mirror, and what clear goods let through.

Every ray has at most three: through a clear product, mirrored by the surface it hits, mirrored by a pane of glass in
front of it. What they hit is shaded as it is, without rays of its own. Depth and surface of a pixel remain those of the
first surface that is not a pane.
"""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false, reportPrivateUsage=false
# pyright: reportConstantRedefinition=false, reportMissingTypeArgument=false

from __future__ import annotations

import math

from stereo_sfm.drivers.sim import kernels
from stereo_sfm.drivers.sim.kernels import BOTTLE, FACING, FRONT, ROOM, ROUND, SIDE, njit_finite
from stereo_sfm.drivers.sim.shading import shade
from stereo_sfm.kernel_cache import jit

FLOOR, MATT, GLOSSY, FOIL, CLEAR, GLASS = 0, 1, 2, 3, 4, 5  # rows of Tables.materials
STRAIGHT, POLISH, ROUGH, RIPPLE, PASSES = 0, 1, 2, 3, 4  # its columns
THROUGH, MIRRORED, PANE = 0, 1, 2  # second rays
OFF = 1e-4  # metres from a surface at which a second ray begins
LEAST = 0.004  # weight of a second ray that is worth tracing
LAMP, LAMPS = 180.0, 40.0  # grey level above which the ceiling is a lamp, and how much brighter than its image it is
LABEL = 0.3, 0.7  # heights between which a label covers a clear product, as fractions of its height


@njit_finite
def fresnel(straight, cos):
    """Reflectance at an angle of incidence by that at 0 (Schlick 1994)."""
    c = 1 - min(abs(cos), 1.0)
    return straight + (1 - straight) * c * c * c * c * c


@njit_finite
def _normal(w, hit, x, y, z):
    """Outward normal of a product's surface, and its curvature in 1 / m -> (nx, ny, nz, curvature)."""
    c, face = hit >> 12, hit & 15
    b = w.facings_i[c, 3]
    facing, side = w.blocks_i[b, 1], face & 3
    u, deep = kernels.to_shelf(w.blocks, b, facing, x, y)
    nu, nw, nz, bend = 0.0, 0.0, 0.0, 0.0
    if side == ROUND:
        pu, pw = kernels.from_axis(w, c, face, u, deep)
        r = math.sqrt(pu * pu + pw * pw) + 1e-9
        nu, nw, bend = pu / r, pw / r, 1 / r
        if w.facings_i[c, 5] == BOTTLE:
            low, high = w.levels[w.facings_i[c, 4], 1], w.facings[c, 5]
            rise = (z - low) / (high - low)
            if kernels.SHOULDER <= rise < kernels.NECK:
                radius = 0.5 * (w.facings[c, 3] - w.facings[c, 2])
                slope = (1 - kernels.NARROW) * radius / ((kernels.NECK - kernels.SHOULDER) * (high - low))
                norm = 1 / math.sqrt(1 + slope * slope)
                nu, nw, nz = nu * norm, nw * norm, slope * norm
    elif side == FRONT:
        nw = -1.0
    elif side == SIDE:
        nu = -1.0 if u < 0.5 * (w.facings[c, 2] + w.facings[c, 3]) else 1.0
    else:
        nz = 1.0
    nx, ny = kernels.turn_from_shelf(facing, nu, nw)
    return nx, ny, nz, bend


@njit_finite
def _rippled(nx, ny, nz, ripple, c, x, y, z):
    """A normal bent by creases a few centimetres wide, other ones for every facing c."""
    a, b = x + y + 0.37 * c, z + 0.61 * c
    s = ripple * (math.sin(83 * a + 41 * b) + 0.6 * math.sin(173 * b - 67 * a + 1.3))
    t = ripple * (math.sin(97 * b - 29 * a) + 0.6 * math.sin(151 * a + 89 * b + 0.7))
    nx, ny, nz = nx + s * (1 - abs(nx)), ny + s * (1 - abs(ny)), nz + t * (1 - abs(nz))
    n = 1 / math.sqrt(nx * nx + ny * ny + nz * nz)
    return nx * n, ny * n, nz * n


@njit_finite
def _material(w, hit):
    """Row of `materials` of what was hit."""
    if (hit >> 4) & 7 == FACING:
        return w.facings_i[hit >> 12, 6]
    return FLOOR if hit == kernels.pack(ROOM, 0, 0, 0) else MATT


@njit_finite
def _labelled(w, hit, z):
    """Whether a label covers a clear product at height z."""
    c = hit >> 12
    rise = (z - w.levels[w.facings_i[c, 4], 1]) * w.facings[c, 8]
    rise -= math.floor(rise)
    return LABEL[0] < rise < LABEL[1]


@njit_finite
def _first_pane(panes, ox, oy, oz, dx, dy, dz, limit):
    """Nearest pane that a ray crosses -> (t, axis), axis -1 for none."""
    best, which = limit, -1
    ix, iy, iz = kernels.inverse(dx), kernels.inverse(dy), kernels.inverse(dz)
    for p in range(panes.shape[0]):
        t0, t1, axis = kernels.slab(
            panes[p, 0], panes[p, 1], panes[p, 2], panes[p, 3], panes[p, 4], panes[p, 5], ox, oy, oz, ix, iy, iz
        )
        if t0 <= t1 and 0 < t0 < best:
            best, which = t0, axis
    return best, which


@njit_finite
def _mirrored(nx, ny, nz, dx, dy, dz):
    """Direction of a mirrored ray."""
    twice = 2 * (nx * dx + ny * dy + nz * dz)
    return dx - twice * nx, dy - twice * ny, dz - twice * nz


@njit_finite
def _second_ray(w, kind, t, hit, ox, oy, oz, dx, dy, dz):
    """A second ray -> (weight, share of the first that is left, t at its begin, origin, direction, spread in 1 / m,
    roughness in radians); weight 0: none.
    """
    m = w.materials
    x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
    if kind == PANE:
        t, axis = _first_pane(w.panes, ox, oy, oz, dx, dy, dz, t)
        if axis < 0 or axis == 2:
            return 0.0, 1.0, t, x, y, z, dx, dy, dz, 0.0, 0.0
        x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
        nx, ny = (1.0, 0.0) if axis == 0 else (0.0, 1.0)
        weight = fresnel(m[GLASS, STRAIGHT], nx * dx + ny * dy)
        dx, dy = (-dx, dy) if axis == 0 else (dx, -dy)
        return weight, (1 - weight) * m[GLASS, PASSES], t, x, y, z, dx, dy, dz, 0.0, m[GLASS, ROUGH]
    k = _material(w, hit)
    if kind == THROUGH:
        weight = m[k, PASSES]
        if weight > 0 and _labelled(w, hit, z):
            weight = 0.0
        return weight, 1 - weight, t, x + OFF * dx, y + OFF * dy, z + OFF * dz, dx, dy, dz, 0.0, m[k, ROUGH]
    if m[k, POLISH] == 0:
        return 0.0, 1.0, t, x, y, z, dx, dy, dz, 0.0, 0.0
    nx, ny, nz, bend = 0.0, 0.0, 1.0, 0.0
    if k != FLOOR:
        nx, ny, nz, bend = _normal(w, hit, x, y, z)
        if m[k, RIPPLE] > 0:
            nx, ny, nz = _rippled(nx, ny, nz, m[k, RIPPLE], hit >> 12, x, y, z)
            bend += 100 * m[k, RIPPLE]
    cos = nx * dx + ny * dy + nz * dz
    if cos >= 0:
        return 0.0, 1.0, t, x, y, z, dx, dy, dz, 0.0, 0.0
    weight = m[k, POLISH] * fresnel(m[k, STRAIGHT], cos)
    dx, dy, dz = _mirrored(nx, ny, nz, dx, dy, dz)
    return weight, 1 - weight, t, x + OFF * nx, y + OFF * ny, z + OFF * nz, dx, dy, dz, 2 * bend, m[k, ROUGH]


_loop = jit(nogil=True, error_model="numpy", _nrt=False, fastmath={"nnan", "nsz"})  # called once for many rays


@_loop
def add_second_rays(
    w, moving, near, world_T_cam, pixels, first, count, offsets, grid, du, dv, angles, narrow, ts, hits, values, marks
):
    """Add what is mirrored and seen through to the brightness of rays.

    Args: as of casting.cast.
        first, count: pixels of this batch. narrow: factor of `angles`.
        ts, hits: (N,) of the first rays. values: (N,) their brightness, changed. marks: (N,) written: numbers that
            differ where a ray and its second rays hit other surfaces.
    """
    ox, oy, oz = world_T_cam[0, 3], world_T_cam[1, 3], world_T_cam[2, 3]
    rays = offsets.shape[0]
    for i in range(count * rays):
        p = pixels[first + i // rays]
        dx, dy, dz = kernels.ray(world_T_cam, grid, du, dv, p, offsets[i % rays, 0], offsets[i % rays, 1])
        mark = hits[i]
        for kind in range(3):
            weight, left, begin, x, y, z, a, b, c, spread, rough = _second_ray(
                w, kind, ts[i], hits[i], ox, oy, oz, dx, dy, dz
            )
            if weight < LEAST:
                values[i] *= left
                continue
            t, hit = kernels.trace(w, near, moving, begin, x, y, z, a, b, c)
            # The ray's cone goes on, wider by what the surface's bend and roughness scatter.
            angle = angles[p] * narrow
            angle = angle * (begin + t) / max(t, 1e-6) + angle * begin * spread + rough
            seen = shade(w, moving, t, hit, x, y, z, a, b, c, angle)
            if hit == kernels.pack(ROOM, 0, 0, 1):
                seen += LAMPS * max(seen - LAMP, 0.0)
            values[i] = left * values[i] + weight * seen
            mark = 31 * mark + hit
        marks[i] = mark
