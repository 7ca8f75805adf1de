"""Compiled walks over the observation lists of a map's points (mapping/map.py)."""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false

from __future__ import annotations

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
