"""Compiled ray casting of the store: a room, groups of boxes, shelves with products in their slots, people, targets.

A shelf block is an axis-aligned box seen from its front: u runs to the viewer's right, w goes into the shelf, z up. Its
levels are open slots between boards; each slot is a row of facings, traversed like a one-dimensional grid.

A facing holds a row of cartons, one behind the other as one box; or bodies of revolution; or bags that hang from above.

A hit is (t, id); `id` packs index << 12 | part << 7 | kind << 4 | face, so that two pixels show the same flat surface
exactly when their ids agree. The tables that all kernels take are described in tables.Tables.
"""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false, reportPrivateUsage=false
# pyright: reportConstantRedefinition=false, reportMissingTypeArgument=false

from __future__ import annotations

import math
from typing import Any

from stereo_sfm.kernel_cache import jit

SHELF, SOLID = 0, 1  # kinds of block
BIN = 0.05  # metres of a level per lookup bin
ROOM, BLOCK, FACING, PERSON, TARGET = 0, 1, 2, 3, 4  # kinds of hit
RAIL, BOARD, BACK, END, UNDER, INNER_END = 0, 1, 2, 3, 4, 5  # faces of a shelf
FRONT, SIDE, LID, ROUND, UPPER = 0, 1, 2, 3, 4  # faces of a product; the upper box adds 4
CARTON, CAN, BOTTLE, HUNG = 0, 1, 2, 3  # forms of products
# A bottle's body ends at the first height, its shoulder at the second; and the neck's radius: fractions of its own.
SHOULDER, NECK, NARROW = 0.6, 0.78, 0.35
FAR = 1e30

# Inlined by force and without reference counts: passing the world's many arrays through calls costs five times as much.
_OPTIONS: dict[str, Any] = {
    "nogil": True,
    "error_model": "numpy",
    "_nrt": False,
    "forceinline": True,
}
njit: Any = jit(**_OPTIONS)
# For kernels that never see NaN: comparisons get shorter, no sum changes its order, so the bits stay the same anywhere.
njit_finite: Any = jit(**_OPTIONS, fastmath={"nnan", "nsz"})


@njit_finite
def pack(kind, index, part, face):
    """One integer for a flat surface."""
    return (index << 12) | ((part & 31) << 7) | (kind << 4) | face


@njit_finite
def inverse(d):
    """1 / d, huge for 0."""
    return 1.0 / d if d != 0 else FAR  # with the sign of +0: a parallel ray misses or is inside a slab either way


@njit_finite
def ray(r, grid, du, dv, p, x, y):
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
def slab(lo0, lo1, lo2, hi0, hi1, hi2, o0, o1, o2, i0, i1, i2):
    """Ray (origin, inverse direction) against a box -> (t_in, t_out, axis of entry)."""
    a, b = (lo0 - o0) * i0, (hi0 - o0) * i0
    t0, t1, axis = min(a, b), max(a, b), 0
    a, b = (lo1 - o1) * i1, (hi1 - o1) * i1
    near = min(a, b)
    if near > t0:
        t0, axis = near, 1
    t1 = min(t1, max(a, b))
    a, b = (lo2 - o2) * i2, (hi2 - o2) * i2
    near = min(a, b)
    if near > t0:
        t0, axis = near, 2
    t1 = min(t1, max(a, b))
    return t0, t1, axis


@njit_finite
def profile(form, part, low, high, radius):
    """Part of a can (0) or a bottle (0 body, 1 shoulder, 2 neck) -> (z from, z to, radius at from, radius at to)."""
    if form == CAN:
        return low, high, radius, radius
    first, second = low + SHOULDER * (high - low), low + NECK * (high - low)
    if part == 0:
        return low, first, radius, radius
    if part == 1:
        return first, second, radius, NARROW * radius
    return second, high, NARROW * radius, NARROW * radius


@njit_finite
def _frustum(pu, pw, oz, du, dw, dz, low, high, a, b):
    """Where a ray enters a cone about z, radius a at `low` and b at `high`, from its side -> t, FAR for nowhere.

    (pu, pw): the ray's origin from the axis.
    """
    slope = (b - a) / (high - low)
    r, s = a + slope * (oz - low), slope * dz
    qa, qb, qc = du * du + dw * dw - s * s, pu * du + pw * dw - r * s, pu * pu + pw * pw - r * r
    root = qb * qb - qa * qc
    if root <= 0:
        return FAR
    root = math.sqrt(root)
    t = qc / (root - qb) if qb < 0 else (-(qb + root) / qa if qa != 0 else FAR)
    z = oz + t * dz
    return t if t > 0 and low <= z < high else FAR


@njit_finite
def _round(form, pu, pw, oz, du, dw, dz, iz, low, high, radius, limit):
    """One can or bottle -> (t, face), face -1 for none."""
    best, face = limit, -1
    for part in range(3 if form == BOTTLE else 1):
        z0, z1, a, b = profile(form, part, low, high, radius)
        t = _frustum(pu, pw, oz, du, dw, dz, z0, z1, a, b)
        if t < best:
            best, face = t, ROUND
    edge = radius if dz > 0 or form == CAN else NARROW * radius  # of its bottom, or its lid
    t = ((low if dz > 0 else high) - oz) * iz
    if 0 < t < best and (pu + t * du) ** 2 + (pw + t * dw) ** 2 < edge * edge:
        best, face = t, LID
    return best, face


@njit_finite
def _rounds(form, u0, u1, front, low, high, ou, ow, oz, du, dw, dz, iu, iw, iz, depth, limit):
    """A row of cans or bottles, one behind the other -> (t, face), face -1 for none."""
    t0, t1, _axis = slab(u0, front, low, u1, depth, high, ou, ow, oz, iu, iw, iz)
    best, face = limit, -1
    if t0 >= t1 or t1 <= 0 or t0 >= limit:
        return best, face
    radius = 0.5 * (u1 - u0)
    for k in range(max(1, int((depth - front) / (u1 - u0)))):
        pu, pw = ou - u0 - radius, ow - front - (2 * k + 1) * radius
        t, found = _round(form, pu, pw, oz, du, dw, dz, iz, low, high, radius, best)
        if found >= 0:
            best, face = t, found
    return best, face


@njit_finite
def _product(facings, facings_i, c, base, ou, ow, oz, du, dw, dz, iu, iw, iz, depth, limit):
    """Nearest hit of the lower and the upper box of facing c -> (t, face), face -1 for none."""
    best, face, form = limit, -1, facings_i[c, 5]
    u0, u1, low, high = facings[c, 2], facings[c, 3], facings[c, 5], facings[c, 7]
    if form in (CAN, BOTTLE):
        if low > base:
            best, face = _rounds(
                form, u0, u1, facings[c, 4], base, low, ou, ow, oz, du, dw, dz, iu, iw, iz, depth, best
            )
        if high > low:
            t, found = _rounds(form, u0, u1, facings[c, 6], low, high, ou, ow, oz, du, dw, dz, iu, iw, iz, depth, best)
            if found >= 0:
                best, face = t, UPPER + found
        return best, face
    if low > base:
        t0, t1, axis = slab(u0, facings[c, 4], base, u1, depth, low, ou, ow, oz, iu, iw, iz)
        if t0 < t1 and 0 < t0 < best:
            best, face = t0, SIDE if axis == 0 else (FRONT if axis == 1 else LID)
    if high > low:
        t0, t1, axis = slab(u0, facings[c, 6], low, u1, depth, high, ou, ow, oz, iu, iw, iz)
        if t0 < t1 and 0 < t0 < best:
            best, face = (
                t0,
                UPPER + (SIDE if axis == 0 else (FRONT if axis == 1 else LID)),
            )
    return best, face


@njit_finite
def _slot(levels_i, facings, facings_i, bins, k, base, ou, ow, oz, du, dw, dz, iu, iw, iz, t_in, t_out, depth):
    """Traverse the facings of level k from t_in to t_out -> (t, facing, face), facing -1 for none."""
    first, last, offset = levels_i[k, 0], levels_i[k, 1], levels_i[k, 2]
    if last <= first:
        return t_out, -1, -1
    u = ou + t_in * du
    c = bins[offset + min(max(int(u / BIN), 0), levels_i[k, 4] - 1)]
    while c < last - 1 and facings[c, 1] <= u:
        c += 1
    while c > first and facings[c, 0] > u:
        c -= 1
    while True:
        t, face = _product(facings, facings_i, c, base, ou, ow, oz, du, dw, dz, iu, iw, iz, depth, t_out)
        if face >= 0:
            return t, c, face
        if du > 0:
            if (facings[c, 1] - ou) * iu >= t_out or c + 1 >= last:
                return t_out, -1, -1
            c += 1
        else:
            if du == 0 or (facings[c, 0] - ou) * iu >= t_out or c <= first:
                return t_out, -1, -1
            c -= 1


@njit_finite
def to_shelf(blocks, b, facing, x, y):
    """Horizontal point of the world -> (u, w) of shelf block b."""
    if facing == 0:  # its front faces -y
        return x - blocks[b, 0], y - blocks[b, 1]
    if facing == 1:  # +y
        return blocks[b, 3] - x, blocks[b, 4] - y
    if facing == 2:  # -x
        return blocks[b, 4] - y, x - blocks[b, 0]
    return y - blocks[b, 1], blocks[b, 3] - x


@njit_finite
def turn_to_shelf(facing, dx, dy):
    """Horizontal direction of the world -> (u, w)."""
    if facing == 0:
        return dx, dy
    if facing == 1:
        return -dx, -dy
    if facing == 2:
        return -dy, dx
    return dy, -dx


@njit_finite
def turn_from_shelf(facing, du, dw):
    """(u, w) -> horizontal direction of the world."""
    if facing == 0:
        return du, dw
    if facing == 1:
        return -du, -dw
    if facing == 2:
        return dw, -du
    return -dw, du


@njit_finite
def from_axis(w, c, face, u, deep):
    """Position (u, w) from the axis of the can or bottle of facing c that has a point."""
    f = w.facings
    radius, front = 0.5 * (f[c, 3] - f[c, 2]), f[c, 6 if face & UPPER else 4]
    k = math.floor((deep - front) / (2 * radius))
    return u - f[c, 2] - radius, deep - front - (2 * k + 1) * radius


@njit_finite
def _shelf(w, b, ox, oy, oz, dx, dy, dz, ix, iy, iz, t_in, axis, limit):
    """Inside of shelf block b, entered at t_in through `axis` -> (t, id), id -1 when the ray leaves it again."""
    blocks, blocks_i, levels, levels_i = w.blocks, w.blocks_i, w.levels, w.levels_i
    facing = blocks_i[b, 1]
    ou, ow = to_shelf(blocks, b, facing, ox, oy)
    du, dw = turn_to_shelf(facing, dx, dy)
    iu, iw = turn_to_shelf(facing, ix, iy)
    wide, deep = blocks[b, 3] - blocks[b, 0], blocks[b, 4] - blocks[b, 1]
    if facing >= 2:
        wide, deep = deep, wide
    if t_in > 0:
        if axis == 2:
            if dz > 0:
                return t_in, pack(BLOCK, b, 0, UNDER)
        elif (axis == 0) == (facing < 2):
            return t_in, pack(BLOCK, b, 0, END)
        elif dw < 0:
            return t_in, pack(BLOCK, b, 0, BACK)
    else:
        t_in = 0.0
    z = oz + t_in * dz
    first, last = blocks_i[b, 2], blocks_i[b, 3]
    k = first
    while k < last - 1 and z >= levels[k + 1, 0]:
        k += 1
    if z < levels[k, 1] and axis != 2:
        return t_in, pack(BLOCK, b, k - first, RAIL)
    # How the ray leaves the slot: through an end, the back or the front, the boards or the open top.
    t_out = ((wide if du > 0 else 0.0) - ou) * iu if du != 0 else FAR
    face = INNER_END
    t = ((deep if dw > 0 else 0.0) - ow) * iw if dw != 0 else FAR
    if t < t_out:
        t_out, face = t, (BACK if dw > 0 else -1)
    t = ((levels[k, 2] if dz > 0 else levels[k, 1]) - oz) * iz if dz != 0 else FAR
    if t < t_out:
        t_out, face = t, (BOARD if dz < 0 else (-1 if levels_i[k, 3] else UNDER))
    end = min(t_out, limit)
    t, c, side = _slot(
        levels_i,
        w.facings,
        w.facings_i,
        w.bins,
        k,
        levels[k, 1],
        ou,
        ow,
        oz,
        du,
        dw,
        dz,
        iu,
        iw,
        iz,
        t_in,
        end,
        deep,
    )
    if c >= 0:
        part = 0
        if side & 3 == SIDE or side & 3 == LID:
            part = int((ow + t * dw) * w.facings[c, 9])
        elif side & 3 == ROUND:
            behind = int((ow + t * dw - w.facings[c, 6 if side & UPPER else 4]) * w.facings[c, 9])
            part = 5 * behind + int((oz + t * dz - levels[k, 1]) * w.facings[c, 8])
        else:
            part = int((oz + t * dz - levels[k, 1]) * w.facings[c, 8])
        return t, pack(FACING, c, part, side)
    if face < 0 or t_out >= limit:
        return limit, -1
    return t_out, pack(BLOCK, b, k - first, face)


@njit_finite
def _person(persons_i, ellipsoids, q, ox, oy, oz, dx, dy, dz, limit):
    """Nearest ellipsoid of person q -> (t, ellipsoid), -1 for none."""
    best, which = limit, -1
    for e in range(persons_i[q, 0], persons_i[q, 1]):
        px, py, pz = ox - ellipsoids[e, 0], oy - ellipsoids[e, 1], oz - ellipsoids[e, 2]
        a0 = ellipsoids[e, 3] * px + ellipsoids[e, 4] * py + ellipsoids[e, 5] * pz
        a1 = ellipsoids[e, 6] * px + ellipsoids[e, 7] * py + ellipsoids[e, 8] * pz
        a2 = ellipsoids[e, 9] * px + ellipsoids[e, 10] * py + ellipsoids[e, 11] * pz
        b0 = ellipsoids[e, 3] * dx + ellipsoids[e, 4] * dy + ellipsoids[e, 5] * dz
        b1 = ellipsoids[e, 6] * dx + ellipsoids[e, 7] * dy + ellipsoids[e, 8] * dz
        b2 = ellipsoids[e, 9] * dx + ellipsoids[e, 10] * dy + ellipsoids[e, 11] * dz
        qa = b0 * b0 + b1 * b1 + b2 * b2
        qb = a0 * b0 + a1 * b1 + a2 * b2
        qc = a0 * a0 + a1 * a1 + a2 * a2 - 1
        root = qb * qb - qa * qc
        if root > 0:
            t = (-qb - math.sqrt(root)) / qa
            if 0 < t < best:
                best, which = t, e
    return best, which


@njit_finite
def trace(w, near, moving, gone, ox, oy, oz, dx, dy, dz):
    """Nearest surface along a ray -> (t, id); `gone`: metres at most from where `near` was made to the ray's origin."""
    room, groups, groups_i, blocks, blocks_i = (
        w.room,
        w.groups,
        w.groups_i,
        w.blocks,
        w.blocks_i,
    )
    ix, iy, iz = inverse(dx), inverse(dy), inverse(dz)
    best = ((room[2] if dz > 0 else 0.0) - oz) * iz if dz != 0 else FAR
    hit = pack(ROOM, 0, 0, 1 if dz > 0 else 0)
    t = ((room[0] if dx > 0 else 0.0) - ox) * ix if dx != 0 else FAR
    if t < best:
        best, hit = t, pack(ROOM, 0, 0, 3 if dx > 0 else 2)
    t = ((room[1] if dy > 0 else 0.0) - oy) * iy if dy != 0 else FAR
    if t < best:
        best, hit = t, pack(ROOM, 0, 0, 5 if dy > 0 else 4)
    for n in range(near.groups.shape[0]):
        g = near.groups[n]
        if near.group_gaps[n] - gone >= best:
            break
        t0, t1, axis = slab(
            groups[g, 0],
            groups[g, 1],
            groups[g, 2],
            groups[g, 3],
            groups[g, 4],
            groups[g, 5],
            ox,
            oy,
            oz,
            ix,
            iy,
            iz,
        )
        if t0 >= t1 or t1 <= 0 or t0 >= best:
            continue
        for m in range(groups_i[g, 0], groups_i[g, 1]):
            if near.block_gaps[m] - gone >= best:
                break
            b = near.blocks[m]
            t0, t1, axis = slab(
                blocks[b, 0], blocks[b, 1], blocks[b, 2], blocks[b, 3], blocks[b, 4], blocks[b, 5],
                ox, oy, oz, ix, iy, iz,
            )  # fmt: skip
            if t0 >= t1 or t1 <= 0 or t0 >= best:
                continue
            if blocks_i[b, 0] == SHELF:
                t, found = _shelf(w, b, ox, oy, oz, dx, dy, dz, ix, iy, iz, t0, axis, best)
                if found >= 0:
                    best, hit = t, found
            elif t0 > 0:
                face = axis * 2 + (1 if (dx if axis == 0 else (dy if axis == 1 else dz)) < 0 else 0)
                best, hit = t0, pack(BLOCK, b, 0, face)
    persons = moving.persons
    for q in range(persons.shape[0]):
        t0, t1, axis = slab(
            persons[q, 0], persons[q, 1], persons[q, 2], persons[q, 3], persons[q, 4], persons[q, 5],
            ox, oy, oz, ix, iy, iz,
        )  # fmt: skip
        if t0 < t1 and t1 > 0 and t0 < best:
            t, e = _person(moving.persons_i, moving.ellipsoids, q, ox, oy, oz, dx, dy, dz, best)
            if e >= 0:
                best, hit = t, pack(PERSON, e, 0, 0)
    targets = moving.targets
    for k in range(targets.shape[0]):
        px, py, pz = ox - targets[k, 9], oy - targets[k, 10], oz - targets[k, 11]
        down = targets[k, 2] * dx + targets[k, 5] * dy + targets[k, 8] * dz
        t = -(targets[k, 2] * px + targets[k, 5] * py + targets[k, 8] * pz) * inverse(down)
        if 0 < t < best:
            px, py, pz = px + t * dx, py + t * dy, pz + t * dz
            s = targets[k, 0] * px + targets[k, 3] * py + targets[k, 6] * pz
            v = targets[k, 1] * px + targets[k, 4] * py + targets[k, 7] * pz
            if 0 <= s <= targets[k, 12] and 0 <= v <= targets[k, 13]:
                best, hit = t, pack(TARGET, k, 0, 0)
    return best, hit
