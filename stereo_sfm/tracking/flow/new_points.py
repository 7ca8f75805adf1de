"""New points in areas without points: corners of the left image with a stereo match."""

from __future__ import annotations

import math

import numpy as np

from stereo_sfm.config import TrackerConfig
from stereo_sfm.tracking.flow.consensus import NEIGHBOURS, Movers
from stereo_sfm.tracking.flow.corners import detect_corners
from stereo_sfm.tracking.flow.follower import Follower
from stereo_sfm.tracking.flow.klt import StereoPyramids
from stereo_sfm.tracking.flow.pose_solver import MIN_RHO
from stereo_sfm.tracking.flow.rolling_shutter import RollingShutter
from stereo_sfm.tracking.flow.stereo import StereoMatch, StereoMatcher
from stereo_sfm.tracking.flow.tracks import Tracks
from stereo_sfm.tracking.flow.visible_area import VisibleArea
from stereo_sfm.types import F64

FEW = 0.25  # share of the points wanted, below which the tests of their windows give way
SPACING = 0.75  # of the side of the square per point if points were evenly spread


class NewPoints:
    """Finds new points, spread over the image; point ids are never reused."""

    def __init__(
        self,
        config: TrackerConfig,
        area: VisibleArea,
        stereo: StereoMatcher,
        follower: Follower,
        shutter: RollingShutter,
        movers: Movers,
    ) -> None:
        self._config, self._area, self._stereo, self._follower, self._shutter = config, area, stereo, follower, shutter
        self._movers = movers
        self._next_point_id = 0

    def add(
        self,
        tracks: Tracks,
        images: StereoPyramids,
        pose: F64,
        velocity: F64,
        most: int,
        moving_neighbours: int = NEIGHBOURS // 2,
    ) -> Tracks:
        """The tracks followed by new ones, `most` in all; pose (4, 4) and velocity (6,) of the image.

        `moving_neighbours`: of a new point that counts as moving.
        """
        missing = most - len(tracks)
        if missing <= 0:
            return tracks
        self._area.learn(images.left[1])
        match = self._match(images, tracks.uv, missing, most, math.ceil(FEW * most) - len(tracks))
        good = np.flatnonzero(match.good)
        rows, slots = self._follower.begin(images.left, match.uv_left[good], pose)
        new, n = good[rows], len(rows)
        rho = np.maximum(match.rho[new], MIN_RHO)
        marked = self._movers.near(match.uv_left[new], rho, tracks, moving_neighbours)
        origin, direction = self._shutter.rays(pose, velocity, match.uv_left[new], match.bearing[new])
        tracks = tracks.append(
            Tracks(
                point_ids=self._next_point_id + np.arange(n, dtype=np.int64),
                uv=match.uv_left[new],
                uv_right=match.uv_right[new],
                right_offset=match.offset[new],
                origin=origin,
                direction=direction,
                rho=rho,
                variance=match.variance[new],
                age=np.zeros(n, np.int32),
                misses=marked,
                moving=marked > 0,
                warp=np.tile(np.eye(2), (n, 1, 1)),
                slot=slots,
                mapped=np.zeros(n, bool),
                disagreed=np.zeros(n, bool),
            )
        )
        self._next_point_id += n
        return tracks

    def triangulate_again(self, tracks: Tracks, pose: F64, velocity: F64, keep_marks: bool = False) -> None:
        """Place the tracks of the last image, at a pose (4, 4) with a velocity (6,), by the rig as it is known now.

        Those that the second camera does not see keep their positions. None is taken for moving, unless marks are kept:
        what contradicted another rig need not contradict this one.
        """
        match = self._stereo.placed(tracks.uv, tracks.uv_right)
        seen = match.good
        origin, direction = self._shutter.rays(pose, velocity, tracks.uv[seen], match.bearing[seen])
        tracks.origin[seen], tracks.direction[seen] = origin, direction
        tracks.rho[seen] = np.maximum(match.rho[seen], MIN_RHO)
        tracks.variance[seen], tracks.right_offset[seen] = match.variance[seen], match.offset[seen]
        tracks.mapped[seen] = False
        if not keep_marks:
            tracks.moving[:], tracks.misses[:] = False, 0

    def seen(self, images: StereoPyramids) -> F64:
        """(M, 3) metres in the camera, none behind it: corners spread over the image, as many as are tracked."""
        most = self._config.max_features
        match = self._match(images, np.zeros((0, 2)), most, most)
        return match.bearing[match.good] / np.maximum(match.rho[match.good, None], MIN_RHO)

    def _match(self, images: StereoPyramids, taken: F64, count: int, most: int, needed: int = 0) -> StereoMatch:
        """At most `count` corners away from pixels (N, 2), spread as if there were `most` in all, and their matches.

        `needed`: see `StereoMatcher.match`.
        """
        spacing = SPACING * math.sqrt(4.0 * self._area.mask.sum() / most)
        corners = detect_corners(
            images.left[1], self._area.mask, taken, count, spacing, self._config.corner_quality,
            edges=not isinstance(images.right, tuple),
        )  # fmt: skip
        return self._stereo.match(images.left, images.right, corners, needed)
