"""Moving objects: points that have been static for long determine the camera's motion, others are marked as moving.

While most points agree, all of them have the same say. When points in company disagree, or many are gone, a second
motion is looked for among them, and the camera's is the one that the longest followed points agree with, within what
its motion until now makes likely. What follows another motion, or keeps disagreeing in company, is marked as moving.
Marked points are followed on, so that nothing new is begun on what moves, but count for nothing until they have stood
still for a while.
"""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false, reportMissingTypeArgument=false

from __future__ import annotations

import math

import numpy as np

from stereo_sfm.geometry.kernels import njit
from stereo_sfm.tracking.flow.pose_solver import row_residuals
from stereo_sfm.tracking.flow.tracks import Tracks
from stereo_sfm.types import F64, Bool, Corners

FEW = 8  # points in company, fewer are no motion of their own
LEFT = 0.65  # share of the points that were looked for from which another motion is, if fewer agree
SETTLED_S = 0.3  # a point that was followed for so long has its full say ...
LEAST_SAY = 0.1  # ... and a new one this
EVIDENCE = 0.2  # of the points that agree in an open view; with fewer the camera counts as covered
MORE = 1.05  # times the say that all together have, so that others decide
ALERT_S = 1.0  # after that, or while points are marked as moving
COMPANY, NEIGHBOURS = 3, 6  # a point moves if so many of its nearest neighbours disagree as well
SAME_DEPTH = 0.3  # logarithm of the ratio of two distances
PROOF = 4  # successive frames in which a moving point must agree to be used again


def after_frame(tracks: Tracks, inlier: Bool, moving: Bool, misses_allowed: int, alert: bool) -> tuple[Tracks, Bool]:
    """Tracks with `misses` and `moving` brought up to date; what disagrees for long is dropped, in company marked.

    Args:
        inlier: (N,) which points agree with the pose. moving: (N,) which have been seen to move in company; (0,): none.
        misses_allowed: successive frames of disagreement.
        alert: whether something may move; if not, nothing is marked.

    Returns:
        The remaining tracks, and their rows as a mask (N,).
    """
    still = ~tracks.moving
    misses = np.where(inlier, 0, tracks.misses + 1)
    proof = np.where(inlier, tracks.misses - 1, PROOF)
    tracks.misses = np.where(still, misses, proof).astype(np.int32)
    out = still & (tracks.misses >= misses_allowed)
    disagree = tracks.moving | (tracks.misses > 0)
    joins = np.zeros(len(tracks), bool)
    rows = np.flatnonzero(out) if alert else np.zeros(0, np.int64)
    joins[rows] = _company(tracks.uv[rows], tracks.rho[rows], tracks.uv, tracks.rho, disagree) > COMPANY
    if len(moving):
        joins |= moving & still
    tracks.misses[joins] = PROOF
    tracks.moving = (tracks.moving | joins) & (tracks.misses > 0)
    kept = ~out | joins
    return tracks.keep(kept), kept


def among_moving(uv: F64, rho: F64, tracks: Tracks) -> Bool:
    """(M,) which new points, (M, 2) px and (M,) 1/m, are on moving objects."""
    return _company(uv, rho, tracks.uv, tracks.rho, tracks.moving) >= COMPANY


def _company(uv: F64, rho: F64, among_uv: F64, among_rho: F64, marked: Bool) -> F64:
    """(M,) number of the nearest NEIGHBOURS in the image that are marked (N,) and at about the same distance."""
    if not len(uv) or not marked.any():
        return np.zeros(len(uv))
    squared = np.square(uv[:, :1] - among_uv[:, 0]) + np.square(uv[:, 1:] - among_uv[:, 1])
    nearest = squared.argpartition(min(NEIGHBOURS, len(among_uv)) - 1, axis=1)[:, :NEIGHBOURS]
    same_depth = np.abs(np.log(among_rho[nearest] / rho[:, None])) < SAME_DEPTH
    return (marked[nearest] & same_depth).sum(1)


def in_company(tracks: Tracks, points: Bool) -> Bool:
    """(N,) which of some points, (N,), have such points around them at their own distance."""
    rows, out = np.flatnonzero(points), np.zeros(len(points), bool)
    if len(rows) >= FEW:
        out[rows] = _company(tracks.uv[rows], tracks.rho[rows], tracks.uv, tracks.rho, points) > COMPANY
    return out


def without_moving(corners: Corners, tracks: Tracks) -> Corners:
    """The corners that are not on moving objects."""
    if not tracks.moving.any():
        return corners
    distance = np.linalg.norm(corners.points_cam, axis=1).astype(np.float64)
    still = ~among_moving(corners.uv_left.astype(np.float64), 1.0 / np.maximum(distance, 1e-6), tracks)
    return Corners(
        corners.uv_left[still], corners.uv_right[still], corners.points_cam[still], corners.descriptors[still]
    )


@njit
def errors_at(
    pose, velocity, row_s, origin, direction, rho, variance, uv_l, uv_r, cams, right_T_left, sigma
):  # fmt: skip
    """(N,) whitened errors of points at a pose, as from `pose_solver.optimise_pose`, with its arguments."""
    error = np.full(len(rho), np.inf)
    res, jac, ray = np.zeros(4), np.zeros((4, 6)), np.zeros(4)
    row, step = pose.copy(), np.zeros((4, 4))
    for k in range(len(rho)):
        rows = row_residuals(
            k, pose, velocity, row_s, origin, direction, rho, uv_l, uv_r, cams, right_T_left, row, step, res, jac, ray
        )
        if rows == 0:
            continue
        rr, gr, gg = 0.0, 0.0, 0.0
        for i in range(rows):
            rr += res[i] * res[i]
            gr += ray[i] * res[i]
            gg += ray[i] * ray[i]
        c = variance[k] / (sigma * sigma + variance[k] * gg)
        error[k] = math.sqrt(max(rr - c * gr * gr, 0.0) / rows) / sigma
    return error
