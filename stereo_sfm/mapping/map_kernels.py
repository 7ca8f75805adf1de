"""Compiled walks over the observation lists of a map's points (mapping/map.py)."""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false

from __future__ import annotations

import numpy as np

from stereo_sfm.geometry.hamming import BITS, hamming
from stereo_sfm.geometry.kernels import njit


@njit
def link(first, head, following, obs_pt):
    """Puts the observations from row `first` on at the head of their points' lists."""
    for o in range(first, obs_pt.shape[0]):
        p = obs_pt[o]
        following[o] = head[p]
        head[p] = o


@njit
def count_listed(points, head, following):
    """How many observations these points have together."""
    total = 0
    for i in range(points.shape[0]):
        o = head[points[i]]
        while o >= 0:
            total += 1
            o = following[o]
    return total


@njit
def list_observations(points, head, following, out):
    """Fills out with the observations of points, point after point, newest first."""
    n = 0
    for i in range(points.shape[0]):
        o = head[points[i]]
        while o >= 0:
            out[n] = o
            n += 1
            o = following[o]


@njit
def count_by_keyframe(points, head, following, obs_kf, counts):
    """Adds to counts (K,) how many of these points every keyframe sees."""
    for i in range(points.shape[0]):
        o = head[points[i]]
        while o >= 0:
            counts[obs_kf[o]] += 1
            o = following[o]


@njit
def list_sightings(points, head, following, obs_kf, kf_index, obs, pt):
    """Fills obs and pt with the observations of points by the keyframes whose kf_index is not negative.

    Point after point, newest first; pt is the index into points. Returns how many there are.
    """
    n = 0
    for i in range(points.shape[0]):
        o = head[points[i]]
        while o >= 0:
            if kf_index[obs_kf[o]] >= 0:
                obs[n], pt[n] = o, i
                n += 1
            o = following[o]
    return n


@njit
def unlink(rows, head, following, obs_pt, obs_kf, pairs):
    """Takes observations out of their points' lists, one by one.

    Fills pairs (2, N) with (its keyframe, another keyframe that still saw the point) and returns how many there are; N
    is at most the sum of the lengths of the lists.
    """
    n = 0
    for i in range(rows.shape[0]):
        row = rows[i]
        p = obs_pt[row]
        before = -1
        o = head[p]
        while o >= 0:
            if o == row:
                if before < 0:
                    head[p] = following[o]
                else:
                    following[before] = following[o]
            else:
                pairs[0, n], pairs[1, n] = obs_kf[row], obs_kf[o]
                n += 1
                before = o
            o = following[o]
        obs_pt[row] = -1
    return n


@njit
def follow(rows, fused_into):
    """The living row that each row was fused into, in place; -1 stays."""
    for i in range(rows.shape[0]):
        r = rows[i]
        while r >= 0 and fused_into[r] >= 0:
            r = fused_into[r]
        rows[i] = r


@njit
def match_near(uv, uv_right, words, predicted, predicted_right, candidate_words, radius, limit, ratio):
    """Best candidate of each row, or -1: within `radius` px in both eyes, at most `limit` bits, mutual, distinct.

    Args:
        uv, uv_right: (N, 2) px observed, the right one NaN where unseen. words: (N, 4) uint64 descriptors, 0: none.
        predicted, predicted_right, candidate_words: the same of (C,) candidates.
        ratio: the best distance must be below `ratio` times the second best.
    """
    n, c = uv.shape[0], predicted.shape[0]
    best = np.full(n, -1)
    best_bits = np.full(n, BITS + 1)
    second_bits = np.full(n, BITS + 1)
    owner = np.full(c, -1)
    owner_bits = np.full(c, BITS + 1)
    for i in range(n):
        if words[i, 0] == 0 and words[i, 1] == 0:
            continue
        for j in range(c):
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
