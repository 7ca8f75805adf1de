"""What a tracker does while the camera sees nothing that it knows: expect, look whether the view is free, search."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.geometry import se3
from stereo_sfm.tracking.flow.frame_pose import PoseSolution
from stereo_sfm.tracking.flow.place_corners import PlaceCorners
from stereo_sfm.tracking.flow.pyramids import StereoPyramids
from stereo_sfm.tracking.flow.tracks import Tracks
from stereo_sfm.tracking.flow.trusted_motion import Expectation, TrustedMotion
from stereo_sfm.tracking.protocol import Places
from stereo_sfm.types import F64, Corners, Keyframe, StereoImage

REACH = 3.0  # sigmas of the expectation within which a camera is looked for
NEAR = 0.4  # of the median distance of the newest keyframe's corners
FADING = 0.9  # of what a free view shows, from keyframe to keyframe
GRID = (8, 6)  # columns and rows of the image in which corners are counted
SURE_SHARE = 0.6  # of the points that should be visible: no need to look elsewhere
SAME_PLACE = 0.1, 0.03  # metres, radians between two answers that are one
RIVAL = 0.6  # another place with this share of the points makes the answer ambiguous
LEAST = 16  # points that agree
AGREEING = 0.6  # of the points that are found
FOUND_SHARE = 0.22  # of the points that should be visible, that are found and agree; the rest may still be covered
FREE_SHARE = 0.5  # of the cells in which the newest keyframe had corners: with as many the view is free again


class Recovery:
    """Remembers the motion that can be trusted and the newest keyframes."""

    def __init__(self, place_corners: PlaceCorners | None, places: Places | None, size: tuple[int, int]) -> None:
        """`size`: width and height of the left image. Without `places` nothing is searched."""
        self._place_corners, self._places, self._size = place_corners, places, size
        self._near = 0.0  # metres from the camera, nearer than most of what the newest keyframe showed
        self._cells = 0.0  # in which the newest keyframes had corners further away
        self.motion = TrustedMotion()
        self.free = True  # whether the last image that was searched shows as much as the newest keyframe

    def use(self, rig: Rig) -> None:
        """Use a corrected rig."""
        if self._places is not None:
            self._places.use(rig)

    def remember(self, keyframe: Keyframe) -> None:
        """A new keyframe that later images may be found in."""
        if self._places is not None:
            self._places.add(keyframe)
        if len(keyframe.corners):
            self._near = NEAR * float(np.median(np.linalg.norm(keyframe.corners.points_cam, axis=1)))
        self._cells = max(self._occupied(keyframe.corners), FADING * self._cells)

    def search(self, image: StereoImage, images: StereoPyramids, expected: Expectation) -> Iterator[F64]:
        """Poses odom_T_cam (4, 4) within reach of where the camera is expected, from which it may see this image."""
        if self._places is None or self._place_corners is None:
            return
        corners = self._place_corners.find_in(images.left, images.right)
        self.free = self._occupied(corners) >= FREE_SHARE * self._cells
        if len(corners):
            candidates = self._places.find(_seen(image, corners), expected.odom_T_cam)
            yield from (pose for pose in candidates if expected.sigmas_off(pose) < REACH)

    def possible(self, expected: Expectation, solution: PoseSolution, visible: int) -> bool:
        """Whether the camera can have come there, and the points say so.

        Ceilings and shelves repeat: beside the points that agree, those count that disagree, and those that should be
        visible from there (`visible` of them) and are not found.
        """
        share, recall = solution.inliers / max(len(solution.error), 1), solution.inliers / max(visible, 1)
        if solution.reason or solution.inliers < LEAST or share < AGREEING or recall < FOUND_SHARE:
            return False
        return expected.sigmas_off(solution.pose) < REACH

    def best(self, found: list[tuple[Tracks, PoseSolution]]) -> tuple[Tracks, PoseSolution] | None:
        """The pose that most points agree with, unless another place comes near it."""
        if not found:
            return None
        best = max(found, key=lambda x: x[1].inliers)
        rivals = [s for _, s in found if not alike(s.pose, best[1].pose, *SAME_PLACE)]
        return None if any(s.inliers > RIVAL * best[1].inliers for s in rivals) else best

    def _occupied(self, corners: Corners) -> int:
        """How many cells of the image hold a corner that is not on something close before the camera."""
        uv = corners.uv_left[np.linalg.norm(corners.points_cam, axis=1) > self._near]
        column, row = (np.clip(uv[:, k] * GRID[k] / self._size[k], 0, GRID[k] - 1).astype(np.int64) for k in (0, 1))
        return len(np.unique(row * GRID[0] + column))


def alike(a: F64, b: F64, metres: float, radians: float) -> bool:
    """Whether two poses (4, 4) are so near each other."""
    moved, turned = se3.extent(se3.inverse(a) @ b)
    return bool(moved < metres and turned < radians)


def _seen(image: StereoImage, corners: Corners) -> Keyframe:
    """An image that became no keyframe, as a place is recognised by it."""
    return Keyframe(
        kf_id=-1,
        frame_id=image.frame_id,
        stamp_ns=image.stamp_ns,
        odom_T_cam=np.eye(4),
        point_ids=np.zeros(0, np.int64),
        uv_left=np.zeros((0, 2)),
        uv_right=np.zeros((0, 2)),
        points_cam=np.zeros((0, 3)),
        descriptors=np.zeros((0, 32), np.uint8),
        corners=corners,
    )
