"""Compiled shading of a hit: which texture lies there, light of the lamps, shadow inside the shelves."""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false, reportPrivateUsage=false
# pyright: reportConstantRedefinition=false, reportMissingTypeArgument=false

from __future__ import annotations

import math

from stereo_sfm.drivers.sim import kernels
from stereo_sfm.drivers.sim.kernels import (
    BACK,
    BLOCK,
    BOARD,
    END,
    FACING,
    FRONT,
    HUNG,
    PERSON,
    RAIL,
    ROOM,
    ROUND,
    SIDE,
    SOLID,
    njit_finite,
    to_shelf,
)
from stereo_sfm.drivers.sim.sampling import over_plane, sample


@njit_finite
def _lamps(x, y):
    """Light from the rows of lamps, a smooth periodic pattern about 1."""
    a, b = x * (1 / 2.4), y * (1 / 2.4)
    a -= math.floor(a) + 0.5
    b -= math.floor(b) + 0.5
    return 1 + 0.7 * (1 / 12 - a * a) + 0.5 * (1 / 12 - b * b)


@njit_finite
def _cave(w):
    """Light that reaches depth w inside a shelf."""
    return 1 / (1 + 14 * w * w)


@njit_finite
def _room(w, face, x, y, z, dx, dy, dz, size):
    if face == 0:
        value = over_plane(w, w.surfaces[0], x, y, dx, dy, dz, size)
        wear = over_plane(w, w.surfaces[1], x, y, dx, dy, dz, size)
        return value * wear * (0.92 / 200) * _lamps(x, y)
    if face == 1:
        return over_plane(w, w.surfaces[2], x, y, dx, dy, dz, size)
    if face <= 3:
        return over_plane(w, w.surfaces[3], y, -z, dy, dz, dx, size) * (0.6 + 0.1 * z)
    return over_plane(w, w.surfaces[3], x, -z, dx, dz, dy, size) * (0.6 + 0.1 * z)


@njit_finite
def _solid(w, b, face, x, y, z, dx, dy, dz, size):
    k = w.blocks_i[b, 4 + face]
    if face >= 4:
        s, t, ds, dt, cos = x - w.blocks[b, 0], y - w.blocks[b, 1], dx, dy, dz
        wide, high = w.blocks[b, 3] - w.blocks[b, 0], w.blocks[b, 4] - w.blocks[b, 1]
        light = 0.95 if face == 5 else 0.4
    else:
        t, dt = w.blocks[b, 5] - z, dz
        high = w.blocks[b, 5] - w.blocks[b, 2]
        if face < 2:
            s, ds, cos, wide = (
                y - w.blocks[b, 1],
                dy,
                dx,
                w.blocks[b, 4] - w.blocks[b, 1],
            )
            if face == 0:
                s = wide - s
        else:
            s, ds, cos, wide = (
                x - w.blocks[b, 0],
                dx,
                dy,
                w.blocks[b, 3] - w.blocks[b, 0],
            )
            if face == 3:
                s = wide - s
        light = 0.68 + 0.1 * z
    if w.texture_sizes[k, 0] > 0:
        return over_plane(w, k, s, t, ds, dt, cos, size) * light
    ic2 = 1 / max(cos * cos, 1e-4)
    fs, ft = size * math.sqrt(1 + ds * ds * ic2), size * math.sqrt(1 + dt * dt * ic2)
    return sample(w, k, s / wide, t / high, fs / wide, ft / high) * light


@njit_finite
def _shelf_part(w, b, part, face, x, y, z, dx, dy, dz, size):
    facing = w.blocks_i[b, 1]
    u, deep = to_shelf(w.blocks, b, facing, x, y)
    du, dw = kernels.turn_to_shelf(facing, dx, dy)
    k = w.blocks_i[b, 4 + face]
    if face == RAIL and w.levels[w.blocks_i[b, 2] + part, 1] - w.levels[w.blocks_i[b, 2] + part, 0] > 0.06:
        return over_plane(w, w.blocks_i[b, 4 + END], u, z, du, dz, dw, size) * 0.45  # kick plate
    if face == RAIL:
        return over_plane(w, k, u + 0.37 * b + 3.1 * z, -z, du, dz, dw, size) * (0.7 + 0.12 * z)
    if face == BOARD:
        return over_plane(w, k, u, deep, du, dw, dz, size) * _cave(deep) * 0.9
    if face == BACK:
        return over_plane(w, k, u, z, du, dz, dw, size) * _cave(deep) * 0.9
    if face == END:
        return over_plane(w, k, deep, z, dw, dz, du, size) * (0.6 + 0.1 * z)
    return over_plane(w, k, deep, z, dw, dz, du, size) * 0.4 * _cave(deep)


@njit_finite
def _product(w, c, face, part, x, y, z, dx, dy, dz, size):
    b, k = w.facings_i[c, 3], w.facings_i[c, 4]
    facing = w.blocks_i[b, 1]
    u, deep = to_shelf(w.blocks, b, facing, x, y)
    du, dw = kernels.turn_to_shelf(facing, dx, dy)
    base, roof = w.levels[k, 1], w.levels[k, 2]
    across = (u - w.facings[c, 2]) * w.facings[c, 10]
    per_u, per_z, per_w = w.facings[c, 10], w.facings[c, 8], w.facings[c, 9]
    if w.facings_i[c, 5] == HUNG:
        base = w.facings[c, 5]
    row = (z - base) * per_z
    row = 1 - (row - math.floor(row))
    column = deep * per_w
    column -= math.floor(column)
    under = roof - z
    light = _cave(deep) * (1 - 0.5 / (1 + 300 * under * under) * min(1.0, 12 * deep)) * (0.78 + 0.12 * z)
    side = face & 3
    if side == FRONT:
        k, s, t, ds, dt, cos, per_s, per_t = (
            w.facings_i[c, 0],
            across,
            row,
            du,
            dz,
            dw,
            per_u,
            per_z,
        )
    elif side == SIDE:
        k, s, t, ds, dt, cos, per_s, per_t = (
            w.facings_i[c, 1],
            column,
            row,
            dw,
            dz,
            du,
            per_w,
            per_z,
        )
        if du > 0:
            s = 1 - s
        light *= 0.6
    elif side == ROUND:
        pu, pw = kernels.from_axis(w, c, face, u, deep)
        angle, radius = math.atan2(pu, -pw), math.sqrt(pu * pu + pw * pw) + 1e-9
        s, per_s = 0.5 + angle / math.pi, 1 / (math.pi * radius)
        s = 2 - s if s > 1 else abs(s)  # the label once more, mirrored, on the back
        k, t, dt, per_t = w.facings_i[c, 0], row, dz, per_z
        ds, cos = (-du * pw + dw * pu) / radius, (du * pu + dw * pw) / radius
        light *= 0.7 - 0.3 * pw / radius
    else:
        k, s, t, ds, dt, cos, per_s, per_t = (
            w.facings_i[c, 2],
            across,
            column,
            du,
            dw,
            dz,
            per_u,
            per_w,
        )
    ic2 = 1 / max(cos * cos, 1e-4)
    fs, ft = size * math.sqrt(1 + ds * ds * ic2), size * math.sqrt(1 + dt * dt * ic2)
    return sample(w, k, s, t, fs * per_s, ft * per_t) * light * _lamps(x, y)


@njit_finite
def _person(w, moving, e, x, y, z, dx, dy, dz, size):
    ell = moving.ellipsoids
    px, py, pz = x - ell[e, 0], y - ell[e, 1], z - ell[e, 2]
    a0 = ell[e, 3] * px + ell[e, 4] * py + ell[e, 5] * pz
    a1 = ell[e, 6] * px + ell[e, 7] * py + ell[e, 8] * pz
    a2 = ell[e, 9] * px + ell[e, 10] * py + ell[e, 11] * pz
    # The normal is A^T a; its upward part decides the light.
    nx = ell[e, 3] * a0 + ell[e, 6] * a1 + ell[e, 9] * a2
    ny = ell[e, 4] * a0 + ell[e, 7] * a1 + ell[e, 10] * a2
    nz = ell[e, 5] * a0 + ell[e, 8] * a1 + ell[e, 11] * a2
    norm = math.sqrt(nx * nx + ny * ny + nz * nz)
    cos = abs(nx * dx + ny * dy + nz * dz) / norm
    angle = math.atan2(a1, a0) / (2 * math.pi)
    k = moving.ellipsoids_i[e]
    wide = w.texture_sizes[k, 0]
    footprint = size / max(cos, 0.1) / wide
    around = 2 * math.pi * ell[e, 12] / wide
    return sample(
        w,
        k,
        angle * max(round(around), 1.0),
        a2 * ell[e, 13] / wide,
        footprint,
        footprint,
    ) * (0.65 + 0.3 * nz / norm)


@njit_finite
def _target(w, moving, k, x, y, z, dx, dy, dz, size):
    f = moving.targets
    px, py, pz = x - f[k, 9], y - f[k, 10], z - f[k, 11]
    s, v = (
        f[k, 0] * px + f[k, 3] * py + f[k, 6] * pz,
        f[k, 1] * px + f[k, 4] * py + f[k, 7] * pz,
    )
    ds, dv = (
        f[k, 0] * dx + f[k, 3] * dy + f[k, 6] * dz,
        f[k, 1] * dx + f[k, 4] * dy + f[k, 7] * dz,
    )
    down = f[k, 2] * dx + f[k, 5] * dy + f[k, 8] * dz
    ic2 = 1 / max(down * down, 1e-4)
    fs, ft = (
        size * math.sqrt(1 + ds * ds * ic2) / f[k, 12],
        size * math.sqrt(1 + dv * dv * ic2) / f[k, 13],
    )
    return 0.8 * sample(w, moving.targets_i[k], s / f[k, 12], v / f[k, 13], fs, ft)


@njit_finite
def shade(w, moving, t, hit, ox, oy, oz, dx, dy, dz, angle):
    """Brightness (0..255, may exceed) of a hit seen along a ray, filtered over `angle` radians."""
    x, y, z, size = ox + t * dx, oy + t * dy, oz + t * dz, t * angle
    kind, face, part, index = (hit >> 4) & 7, hit & 15, (hit >> 7) & 31, hit >> 12
    if kind == FACING:
        return _product(w, index, face, part, x, y, z, dx, dy, dz, size)
    if kind == ROOM:
        return _room(w, face, x, y, z, dx, dy, dz, size)
    if kind == BLOCK:
        if w.blocks_i[index, 0] == SOLID:
            return _solid(w, index, face, x, y, z, dx, dy, dz, size)
        return _shelf_part(w, index, part, face, x, y, z, dx, dy, dz, size)
    if kind == PERSON:
        return _person(w, moving, index, x, y, z, dx, dy, dz, size)
    return _target(w, moving, index, x, y, z, dx, dy, dz, size)
