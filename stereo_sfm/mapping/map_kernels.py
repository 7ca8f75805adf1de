"""Compiled loops over the observation lists of a map's points (mapping/map.py)."""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false

from __future__ import annotations

import math

import numpy as np

from stereo_sfm.geometry.hamming import BITS, hamming
from stereo_sfm.geometry.kernels import njit, project_one
from stereo_sfm.geometry.pixel_grid import cells_near, make_grid


@njit
def list_observations(points, head, following, out):
    """Fills out with the observations of points, point after point, newest first.

    Args:
        head: (P,) newest observation of every point, -1: none. following: (M,) next older one of the same point.
    """
    n = 0
    for i in range(points.shape[0]):
        o = head[points[i]]
        while o >= 0:
            out[n] = o
            n += 1
            o = following[o]


@njit
def follow(rows, fused_into):
    """The living row that each row was fused into, in place; -1 stays."""
    for i in range(rows.shape[0]):
        r = rows[i]
        while r >= 0 and fused_into[r] >= 0:
            r = fused_into[r]
        rows[i] = r


@njit
def judge_points(points, head, following, obs_kf, uv_left, uv_right, sigma, rot, pos, xyz, cam, params, base, out):
    """Fills out (N, 2): root mean squared error of the left images in sigmas, largest angle of a ray to the oldest's.

    Args:
        rot, pos: (K, 3, 3), (K, 3) of map_T_kf. xyz: (P, 3). cam, params: the left camera.
        base: metres between the cameras, whose rays count where both see the point.
    """
    for i in range(points.shape[0]):
        p = points[i]
        oldest = o = head[p]
        while o >= 0:
            oldest = min(oldest, o)
            o = following[o]
        squared, chord, widest, n = 0.0, 0.0, 0.0, 0
        f0 = f1 = f2 = 0.0
        o = oldest
        first = True
        while o >= 0:
            k = obs_kf[o]
            d0, d1, d2 = xyz[p, 0] - pos[k, 0], xyz[p, 1] - pos[k, 1], xyz[p, 2] - pos[k, 2]
            distance = max(math.sqrt(d0 * d0 + d1 * d1 + d2 * d2), 1e-9)
            u0, u1, u2 = d0 / distance, d1 / distance, d2 / distance
            if first:  # the oldest ray, before the list is traversed from its head
                f0, f1, f2 = u0, u1, u2
                first = False
                o = head[p]
                continue
            x = rot[k, 0, 0] * d0 + rot[k, 1, 0] * d1 + rot[k, 2, 0] * d2
            y = rot[k, 0, 1] * d0 + rot[k, 1, 1] * d1 + rot[k, 2, 1] * d2
            z = rot[k, 0, 2] * d0 + rot[k, 1, 2] * d1 + rot[k, 2, 2] * d2
            u, v, _, _, _, _, _, _ = project_one(cam, params, x, y, z)
            off = (u - uv_left[o, 0]) ** 2 + (v - uv_left[o, 1]) ** 2
            squared += (off if math.isfinite(off) else 1e6) / (2 * sigma[o] * sigma[o])
            chord = max(chord, (u0 - f0) ** 2 + (u1 - f1) ** 2 + (u2 - f2) ** 2)
            if math.isfinite(uv_right[o, 0]):
                widest = max(widest, base / distance)
            n += 1
            o = following[o]
        out[i, 0] = math.sqrt(squared / max(n, 1))
        out[i, 1] = max(2.0 * math.asin(min(math.sqrt(chord) / 2.0, 1.0)), widest)


@njit
def match_near(uv, uv_right, words, predicted, predicted_right, candidate_words, radius, limit, ratio):
    """Best candidate of each row, or -1: within `radius` px in both images, at most `limit` bits, mutual, distinct.

    Args:
        uv, uv_right: (N, 2) px observed, the right one NaN where unseen. words: (N, 4) uint64 descriptors, 0: none.
        predicted, predicted_right, candidate_words: the corresponding ones of (C,) candidates.
        ratio: the best distance must be below `ratio` times the second best.
    """
    n, c = uv.shape[0], predicted.shape[0]
    best = np.full(n, -1)
    best_bits = np.full(n, BITS + 1)
    second_bits = np.full(n, BITS + 1)
    owner = np.full(c, -1)
    owner_bits = np.full(c, BITS + 1)
    frame, shape, starts, members = make_grid(predicted, radius)
    for i in range(n):
        if not math.isfinite(uv[i, 0]) or (words[i, 0] == 0 and words[i, 1] == 0):
            continue
        left, right, top, bottom = cells_near(uv[i, 0], uv[i, 1], frame, shape)
        for r in range(top, bottom if left < right else top):
            for m in range(starts[r * shape[0] + left], starts[r * shape[0] + right]):
                j = members[m]
                du, dv = uv[i, 0] - predicted[j, 0], uv[i, 1] - predicted[j, 1]
                if not du * du + dv * dv <= radius * radius:
                    continue
                if candidate_words[j, 0] == 0 and candidate_words[j, 1] == 0:
                    continue
                ru, rv = uv_right[i, 0] - predicted_right[j, 0], uv_right[i, 1] - predicted_right[j, 1]
                if ru * ru + rv * rv > radius * radius:  # False where either is NaN
                    continue
                bits = hamming(words, i, candidate_words, j)
                if bits < best_bits[i]:
                    second_bits[i] = best_bits[i]
                    best_bits[i], best[i] = bits, j
                elif bits < second_bits[i]:
                    second_bits[i] = bits
        if best[i] >= 0 and (best_bits[i] > limit or best_bits[i] >= ratio * second_bits[i]):
            best[i] = -1
        j = best[i]
        if j >= 0 and best_bits[i] < owner_bits[j]:
            if owner[j] >= 0:
                best[owner[j]] = -1
            owner[j], owner_bits[j] = i, best_bits[i]
        elif j >= 0:
            best[i] = -1
    return best
