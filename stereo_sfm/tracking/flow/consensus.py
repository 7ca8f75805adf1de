"""Moving objects: points that have been static for long determine the camera's motion, others are marked as moving.

While most points agree, all have the same weight. When a group of neighbouring points disagrees, or many points are
lost, a second motion is estimated from the points that disagree. The camera's motion is the one that is supported by
the points tracked longest, among those that are plausible after its recent motion; until points have been tracked for
long, the motion of the farther half is one of them. Points that support another motion, or that disagree repeatedly as
a group, are marked as moving. They are tracked further, so that no new points are added on a moving object, but they do
not contribute to the pose until they have been static for a second: somebody who sways stands still for a moment, too.
A mark is evidence that moves both ways: agreement takes from it, disagreement adds to it. New points beside marked ones
that disagreed themselves start with as much as these have, never with more: marks in a still room fade, and do not
spread with the view of a camera that turns.
"""

from __future__ import annotations

import numpy as np

from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Camera
from stereo_sfm.tracking.flow.tracks import Tracks
from stereo_sfm.types import F64, I32, I64, Bool, Corners

MIN_GROUP = 8  # points of a group; fewer do not define a motion
AGREEING_SHARE = 0.65  # of the points that were tracked; if fewer agree, another motion is searched for
# Of the points that are followed, and of those that agree in an open view: with so many a pose is beyond doubt.
TRUSTED_SHARE, TRUSTED_OPEN = 0.8, 0.3
SURE_S = 0.3  # a point that was tracked for so long has its full weight ...
MIN_WEIGHT = 0.1  # ... and a new one this
MIN_OPEN_SHARE = 0.2  # of the inliers in an unobstructed view; with fewer the camera counts as covered
WEIGHT_RATIO = 1.05  # by which another motion must outweigh the one that all points give
NEIGHBOURS = 6  # nearest ones of a point, which moves if half of them disagree as well
SAME_DEPTH = 0.3  # logarithm of the ratio of two distances
# For which a moving point must agree before it is used, and other motions are searched for after one was seen.
STATIC_S, MIN_STATIC_FRAMES = 1.0, 4
DISAGREES = 2  # frames of agreement that one of disagreement outweighs


def static_frames(seconds: float) -> int:
    """Successive frames in which a moving point must agree before it is used, at `seconds` between them."""
    return max(round(STATIC_S / seconds), MIN_STATIC_FRAMES) if seconds > 0 else MIN_STATIC_FRAMES


def after_frame(
    tracks: Tracks, inlier: Bool, moving: Bool, misses_allowed: int, alert: bool, static: int
) -> tuple[Tracks, Bool]:
    """Tracks with updated `misses` and `moving`: points that disagree for long are dropped, groups of them marked.

    Args:
        inlier: (N,) which points agree with the pose. moving: (N,) which support another motion.
        misses_allowed: successive frames of disagreement.
        alert: whether an object may be moving; if not, nothing is marked.
        static: frames in which a moving point must agree before it is used again.

    Returns:
        The remaining tracks, and their rows as a mask (N,).
    """
    misses = np.where(inlier, 0, tracks.misses + 1)
    remaining = np.where(inlier, tracks.misses - 1, np.minimum(tracks.misses + DISAGREES, static))
    tracks.misses = np.where(tracks.moving, remaining, misses).astype(np.int32)
    out = ~tracks.moving & (tracks.misses >= misses_allowed)
    disagree = tracks.moving | (tracks.misses > 0)
    group = out & alert & (_marked_neighbours(tracks, out & alert, disagree) > NEIGHBOURS // 2)
    group |= moving & ~tracks.moving
    tracks.misses[group] = static
    tracks.disagreed = (tracks.disagreed | (tracks.moving & ~inlier) | group) & (tracks.misses > 0)
    tracks.moving = (tracks.moving | group) & (tracks.misses > 0)
    kept = ~out | group
    return tracks.keep(kept), kept


class Movers:
    """Where something moves: the points on it, and the places in the room where it lost them within the last second.

    What comes near changes so much from image to image that no point on it is tracked for long. Evidence are points
    that have disagreed themselves, not those that are new beside them: else marks would spread over a still room.
    """

    def __init__(self) -> None:
        self._places: F64 = np.zeros((0, 3))  # metres, odometry frame, where points were lost
        self._frames: I32 = np.zeros(0, np.int32)  # in which a point there must agree before it is used
        self._uv: F64 = np.zeros((0, 2))  # px, of the places in the last image
        self._rho: F64 = np.zeros(0)  # 1/m

    def forget(self) -> None:
        """Nothing is known to move: tracking begins anew."""
        self._places, self._frames = np.zeros((0, 3)), np.zeros(0, np.int32)
        self._uv, self._rho = np.zeros((0, 2)), np.zeros(0)

    def update(self, before: Tracks, after: Tracks, camera: Camera, pose: F64) -> None:
        """Remember the points that moved in the last image and are not in the tracks `after` it.

        `pose`: (4, 4) odom_T_cam of the image.
        """
        lost = before.disagreed & ~np.isin(before.point_ids, after.point_ids)
        if not (len(self._frames) or lost.any()):
            return
        gone = before.keep(lost)
        places = np.concatenate([self._places, gone.points()])
        frames = np.concatenate([self._frames, gone.misses]) - 1
        in_camera = se3.transform(se3.inverse(pose), places)
        uv = camera.project(in_camera)
        kept = (frames > 0) & np.isfinite(uv).all(1)
        self._places, self._frames, self._uv = places[kept], frames[kept].astype(np.int32), uv[kept]
        self._rho = 1.0 / np.linalg.norm(in_camera[kept], axis=1)

    def near(self, uv: F64, rho: F64, tracks: Tracks, least: int = NEIGHBOURS // 2) -> I32:
        """(M,) frames in which new points, (M, 2) px and (M,) 1/m, must agree before they are used.

        0 where fewer than `least` of their nearest neighbours move, or lost their points while they came nearer; else
        those neighbours' mean.
        """
        if not (len(self._rho) or tracks.disagreed.any()):
            return np.zeros(len(uv), np.int32)
        among_uv, among_rho = np.concatenate([tracks.uv, self._uv]), np.concatenate([tracks.rho, self._rho])
        frames = np.where(tracks.disagreed, tracks.misses, 0)
        frames = np.concatenate([frames, self._frames])
        near, alike = _neighbours(uv, rho, among_uv, among_rho, len(tracks))
        marked = alike & (frames[near] > 0)
        count = marked.sum(1)
        mean = np.where(marked, frames[near], 0).sum(1) / np.maximum(count, 1)
        return np.where(count >= least, np.ceil(mean), 0).astype(np.int32)


def _marked_neighbours(tracks: Tracks, points: Bool, marked: Bool) -> I64:
    """(N,) how many of the nearest NEIGHBOURS of `points` (N,) are marked (N,) and at about the same distance."""
    out, rows = np.zeros(len(tracks), np.int64), np.flatnonzero(points)
    if len(rows) and marked.any():
        near, alike = _neighbours(tracks.uv[rows], tracks.rho[rows], tracks.uv, tracks.rho, len(tracks))
        out[rows] = (marked[near] & alike).sum(1)
    return out


def _neighbours(uv: F64, rho: F64, among_uv: F64, among_rho: F64, tracked: int) -> tuple[I64, Bool]:
    """(M, K) rows of the nearest NEIGHBOURS in the image, and which of them are at about the same distance.

    `tracked`: how many of the N are tracked; of the others farther ones count too, for what moved has come nearer.
    """
    squared = np.square(uv[:, :1] - among_uv[:, 0]) + np.square(uv[:, 1:] - among_uv[:, 1])
    nearest = squared.argpartition(min(NEIGHBOURS, len(among_uv)) - 1, axis=1)[:, :NEIGHBOURS]
    nearer = np.log(among_rho[nearest] / rho[:, None])  # than the new point
    return nearest, (np.abs(nearer) < SAME_DEPTH) | ((nearest >= tracked) & (nearer < 0.0))


def in_group(tracks: Tracks, points: Bool) -> Bool:
    """(N,) which of the `points` (N,) have neighbours among them at their own distance."""
    if np.count_nonzero(points) < MIN_GROUP:
        return np.zeros(len(points), bool)
    return _marked_neighbours(tracks, points, points) > NEIGHBOURS // 2


def beside_moving(tracks: Tracks) -> Bool:
    """(N,) which static points have a moving one among their nearest neighbours, at about their distance."""
    return _marked_neighbours(tracks, ~tracks.moving, tracks.moving) > 0


def without_moving(corners: Corners, tracks: Tracks, movers: Movers) -> Corners:
    """The corners that are not on moving objects."""
    distance = np.linalg.norm(corners.points_cam, axis=1).astype(np.float64)
    static = movers.near(corners.uv_left.astype(np.float64), 1.0 / np.maximum(distance, 1e-6), tracks) == 0
    return Corners(
        corners.uv_left[static], corners.uv_right[static], corners.points_cam[static], corners.descriptors[static]
    )
