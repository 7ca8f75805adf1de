"""Recovery after a loss of tracking: prediction, test whether the view is unobstructed, relocalization."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.geometry import se3
from stereo_sfm.tracking.flow.consensus import MIN_GROUP
from stereo_sfm.tracking.flow.frame_pose import PoseSolution
from stereo_sfm.tracking.flow.keyframes import without_points
from stereo_sfm.tracking.flow.klt import StereoPyramids
from stereo_sfm.tracking.flow.motion_prior import Expectation, MotionPrior
from stereo_sfm.tracking.flow.place_corners import PlaceCorners
from stereo_sfm.tracking.flow.tracks import Tracks
from stereo_sfm.tracking.flow.visible_area import cells_of
from stereo_sfm.tracking.protocol import Places
from stereo_sfm.types import F64, Corners, Keyframe, StereoImage

REACH = 3.0  # sigmas of a prediction within which a pose agrees with it
NEAR = 0.4  # of the median distance of the newest keyframe's corners: nearer ones may be on an occluding object
FADING = 0.9  # factor on the number of occupied cells from keyframe to keyframe
UNCERTAIN_M = 0.2  # standard deviation of the predicted position from which other motions are tried
MOTIONS_AT_ONCE = 2  # of them in an image, besides the straight ones
GRID = (16, 12)  # columns and rows of the image in which corners are counted: fine against the rim beside a cover
SUFFICIENT_RECALL = 0.65  # with which the search ends
SAME_PLACE = 0.1, 0.03  # metres, radians between two hypotheses of one place
RIVAL = 0.75  # share of what speaks for the best place with which another one makes the result ambiguous
MIN_INLIER_SHARE = 0.6  # of the points that are found
# Recall that is needed, the rest may still be covered: for a pose that is certain, as much again per standard deviation
# between the pose and the prediction, and more for a prediction with a standard deviation, up to the largest. Ceiling
# and floor alone, where lamps are taken for the next ones, have 0.43 to 0.64; right poses after 3 to 4 m without sight
# 0.69 to 0.84.
MIN_RECALL, RECALL_PER_METRE = 0.1, 0.7
MAX_SIGMA_M = 0.8
# Of the cells with corners in the newest keyframes, row by row, with which the view is open again. An open one has 0.63
# of them at least, also after a turn; the rim around a cover 0.47 at most, although it has half as many cells.
OPEN_SHARE = 0.5


class Recovery:
    """The motion prior and the newest keyframes, for relocalization."""

    def __init__(self, place_corners: PlaceCorners | None, places: Places | None, size: tuple[int, int]) -> None:
        """`size`: width and height of the left image. Without `places` there is no search."""
        self._place_corners, self._places, self._size = place_corners, places, size
        self._near = 0.0  # metres: corners nearer to the camera than this are not counted
        self._rows: F64 = np.zeros(GRID[1])  # cells of each row in which the newest keyframes had corners further away
        self._cells = 0.0  # number of them in one keyframe
        self._next = 0  # of the other motions
        self.motion = MotionPrior()
        self.unobstructed = True  # whether the last searched image has corners in most of the cells of each row

    def use(self, rig: Rig) -> None:
        """Use a corrected rig."""
        if self._places is not None:
            self._places.use(rig)

    def remember(self, keyframe: Keyframe) -> None:
        """Add a keyframe for later searches, if it has corners."""
        self._next = 0
        if not keyframe.described:
            return
        if self._places is not None:
            self._places.add(keyframe)
        if len(keyframe.corners):
            self._near = NEAR * float(np.median(np.linalg.norm(keyframe.corners.points_cam, axis=1)))
        rows = self._occupied(keyframe.corners)
        self._rows = np.maximum(rows, FADING * self._rows)
        self._cells = max(float(rows.sum()), FADING * self._cells)

    def search(self, image: StereoImage, images: StereoPyramids, expected: Expectation) -> Iterator[F64]:
        """Hypotheses odom_T_cam (4, 4) of the image's pose, within reach of the prediction."""
        if self._places is None or self._place_corners is None:
            return
        corners = self._place_corners.find_in(images.left, images.right)
        self.unobstructed = bool(np.minimum(self._occupied(corners), self._rows).sum() >= OPEN_SHARE * self._cells)
        if self.unobstructed and expected.sigma_m > UNCERTAIN_M:
            straight, *others = self.motion.others(image.stamp_ns)
            yield from (self.motion.steady(image.stamp_ns).odom_T_cam, straight)
            yield from (others[(self._next + k) % len(others)] for k in range(MOTIONS_AT_ONCE))
            self._next += MOTIONS_AT_ONCE
        if len(corners):
            seen = without_points(image, -1, np.eye(4), corners=corners)
            candidates = self._places.find(seen, expected.odom_T_cam)
            yield from (pose for pose in candidates if expected.sigmas_off(pose) < REACH)

    def possible(
        self, expected: Expectation, solution: PoseSolution, recall: float, steady: Expectation | None = None
    ) -> bool:
        """Whether a pose is within reach of the prediction and supported by the points.

        Ceilings and shelves repeat: the share of inliers among the found points counts, and the `recall`, the share of
        the view in which the points are found that should be. Where a `steady` motion ends, a repeated ceiling is
        seen by chance only.
        """
        share = solution.inliers / max(len(solution.error), 1)
        if solution.inliers < 2 * MIN_GROUP or share < MIN_INLIER_SHARE:
            return False
        predictions = [expected] if steady is None or steady.sigmas_off(solution.pose) > REACH else [expected, steady]
        needed = min(_recall_needed(prediction, solution.pose) for prediction in predictions)
        return expected.sigmas_off(solution.pose) < REACH and recall >= needed

    def best(self, found: list[tuple[Tracks, PoseSolution, float]]) -> tuple[Tracks, PoseSolution, float] | None:
        """The pose with the highest recall, which is the third of each; None if another place has nearly as much."""
        if not found:
            return None
        best = max(found, key=lambda x: x[2])
        rivals = [recall for _, s, recall in found if not se3.within(s.pose, best[1].pose, *SAME_PLACE)]
        return None if any(recall > RIVAL * best[2] for recall in rivals) else best

    def _occupied(self, corners: Corners) -> F64:
        """(rows,) number of cells of the image with a corner that is not on an object close to the camera."""
        uv = corners.uv_left[np.linalg.norm(corners.points_cam, axis=1) > self._near]
        occupied = np.unique(cells_of(uv, self._size, GRID))
        return np.bincount(occupied // GRID[0], minlength=GRID[1]).astype(np.float64)


def _recall_needed(prediction: Expectation, pose: F64) -> float:
    """The least recall of a pose (4, 4)."""
    off = prediction.sigmas_off(pose)
    return MIN_RECALL * (1.0 + off) + RECALL_PER_METRE * min(prediction.sigma_m, MAX_SIGMA_M)
