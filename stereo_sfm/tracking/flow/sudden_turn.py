"""A sudden rotation of the right camera, noticed in the image in which it happens.

Between two successive images the pose moves what both cameras see alike. What moves the right pixels of all points
besides, as one rotation of the right camera would, is such a rotation. Errors of the rig, of lenses and of distances
are the same in both images, so that a hundredth of a degree is seen. How much the rotation scatters from image to image
(vibration, a mount that gives, cameras that are triggered apart) is learned, and what it has to do with the rotation of
the image before: vibration goes there and back, a wrong distance goes on. Sudden is what the sequence has not shown
before, and after which the camera stays as it is.
"""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false

from __future__ import annotations

import math

import numpy as np

from stereo_sfm.calib.choice import Estimate
from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import Config
from stereo_sfm.geometry.kernels import njit, project_one
from stereo_sfm.geometry.order_statistics import median
from stereo_sfm.geometry.small_matrix import solve_symmetric
from stereo_sfm.tracking.flow.stereo_cameras import StereoCameras
from stereo_sfm.tracking.flow.tracks import Tracks
from stereo_sfm.types import F64

MIN_POINTS = 20  # common to two images, seen by both cameras: in a window they leave seven rows for each unknown
STEPS, SCALE = 8, 2.0  # of the robust estimate; its scale over the median deviation of the points ...
LEAST_PX = 1e-3  # ... and what it is at least
# Of a sudden rotation: one is looked for in each image. With 3.5, one sequence of fifteen has a false one; with 7, the
# smallest injected ones are missed.
SIGMAS = 5.0
SUSPECTED = "the right camera seems to have turned suddenly"  # how what is suspected begins
# Standard deviation of the rotation from image to image before the sequence shows its own, rad, and as many images as
# that counts for: a few, so that nothing is sudden while the sequence is new.
USUAL, USUAL_IMAGES = 2e-4, 4.0
REMEMBERED_IMAGES = 100.0  # after which what was usual is forgotten
DECIDED = 8  # keyframes that show it, in which the mapper corrects the rig or never will: twice those that it compares
FOLLOWED_SIGMAS = 3.0  # of what the camera turns by after it, within which it stays


class SuddenTurns:
    """Of the right camera; one `seen` per image with a pose."""

    def __init__(self) -> None:
        self.turn: F64 = np.zeros(3)  # rad about the right camera's axes, since the rig was corrected last
        self.covariance: F64 = np.zeros((3, 3))  # of `turn`
        self._followed = np.zeros(3), np.zeros((3, 3))  # by what it has turned in the images since, and covariance
        self._new = False  # noticed in the last image
        self._last: F64 = np.zeros(3)  # the rotation of the image before, without what was sudden
        self._usual: F64 = USUAL**2 * np.eye(6)  # covariance of the rotations to an image and to the one before
        self._images = USUAL_IMAGES  # that have shown it
        self._said: F64 = np.zeros(3)  # `turn` of the last news

    @staticmethod
    def from_config(config: Config, rig: Rig) -> SuddenTurns | None:
        """Those of a run; None where the mapper does not correct the rig."""
        corrects = config.self_calibration.mode == "auto" and config.mapper.enabled
        return SuddenTurns() if corrects and rig.second_camera is not None else None

    def seen(self, before: Tracks, pose_before: F64, tracks: Tracks, pose: F64, cameras: StereoCameras) -> bool:
        """Whether the right camera has turned suddenly between two images, or does not stay so: `turn` is another then.

        Args:
            before: with the pixels of the first image. tracks: some of its points, with the pixels of the second.
            pose_before, pose: (4, 4) odom_T_cam of the images.
        """
        static = np.flatnonzero(~tracks.moving)
        _, of, at = np.intersect1d(tracks.point_ids[static], before.point_ids, True, True)
        of = static[of]
        seen = np.isfinite(tracks.uv_right[of, 0] + before.uv_right[at, 0])
        of, at = of[seen], at[seen]
        turn, covariance, count = _turn(
            pose_before, pose, tracks.origin[of], tracks.direction[of], tracks.rho[of],
            before.uv[at], before.uv_right[at], tracks.uv[of], tracks.uv_right[of], cameras,
        )  # fmt: skip
        if count < MIN_POINTS:
            return False
        last, self._last = self._last, turn
        of_this, of_last, both_ways = self._usual[:3, :3], self._usual[3:, 3:], self._usual[3:, :3]
        by = np.linalg.solve(of_last, both_ways).T
        expected, usual = by @ last, of_this - by @ both_ways + covariance
        # What goes back to where it was before the image before has not turned.
        of_sum = of_this + both_ways.T + both_ways + of_last + covariance
        goes_back = Estimate(turn + last, of_sum).reach < Estimate(last, of_last).reach
        sudden = self._significant(turn - expected, usual) and not goes_back
        self._images = min(self._images + 1.0, REMEMBERED_IMAGES)
        both = np.concatenate([turn, last])
        self._usual = self._usual + (np.outer(both, both) - self._usual) / self._images
        turn = turn - expected
        if sudden:
            self._last = expected
        if sudden and (self._new or not self.turn.any()):  # one rotation may begin during an exposure
            self.turn, self.covariance, self._new = self.turn + turn, self.covariance + usual, not self._new
            if not self._significant(self.turn, self.covariance):  # there and back
                self._forget()
            return True
        self._new = False
        if not self.turn.any():
            return False
        followed, uncertain = self._followed[0] + turn, self._followed[1] + usual
        self._followed = followed, uncertain
        # nearer to where it has turned to than to where it was
        stays = Estimate(followed, usual).reach < 0.5 * Estimate(self.turn, usual).reach
        if sudden or not (stays or Estimate(followed, uncertain).reach < FOLLOWED_SIGMAS):
            self._forget()
            return True
        return False

    def _forget(self) -> None:
        self.turn, self.covariance = np.zeros(3), np.zeros((3, 3))
        self._followed = np.zeros(3), np.zeros((3, 3))

    def _significant(self, turn: F64, covariance: F64) -> bool:
        return Estimate(turn, covariance, self._images).reach > SIGMAS

    def news(self) -> str:
        """What is suspected, where that is new; "" otherwise."""
        said, self._said = self._said, self.turn
        if np.array_equal(said, self.turn):
            return ""
        if not self.turn.any():
            return f"{SUSPECTED}, but did not stay so: the calibration is not changed"
        degrees = np.rad2deg(np.linalg.norm(self.turn))
        return f"{SUSPECTED}, by {degrees:.2f} degrees: the calibration is corrected if it stays so"

    def refused(self) -> None:
        """The mapper's keyframes are better explained by the rig as it was."""
        self._forget()

    def confirmed(self, turn: F64) -> None:
        """The rig has been corrected by a rotation (3,)."""
        rest, uncertain = self.turn - turn, self.covariance + self._usual[:3, :3]
        self._forget()
        self._said = self.turn
        if self._significant(rest, uncertain):
            self.turn, self.covariance = rest, uncertain


@njit
def _turn(pose_a, pose_b, origin, direction, rho, left_a, right_a, left_b, right_b, cameras):
    """The rotation of the right camera between two images, by iteratively re-weighted least squares.

    Unknown is what else the second image's pose is wrong by, too: a step that is too long changes disparities.

    Args:
        pose_a, pose_b: (4, 4) odom_T_cam. origin, direction, rho: of the points. Others: (N, 2) their pixels.

    Returns:
        (3,) rad; its covariance (3, 3) by the scatter of the points; how many have a pixel in both.
    """
    count, off, jac = 0, np.zeros((len(rho), 4)), np.zeros((len(rho), 4, 9))
    first, unused = np.zeros(4), np.zeros((4, 9))
    for k in range(len(rho)):
        _residuals(pose_a, origin[k], direction[k], rho[k], left_a[k], right_a[k], cameras, first, unused)
        _residuals(pose_b, origin[k], direction[k], rho[k], left_b[k], right_b[k], cameras, off[count], jac[count])
        for i in range(4):
            off[count, i] -= first[i]
        if not math.isnan(off[count].sum()):
            count += 1
    solution, covariance, factor = np.zeros(9), np.zeros((3, 3)), np.zeros((9, 9))
    if count < MIN_POINTS:
        return solution[6:], covariance, 0
    distance, weight, rest = np.zeros((2, count)), np.zeros((2, count)), np.zeros(4)
    normal, rhs, squares = np.zeros((9, 9)), np.zeros(9), 0.0
    for _ in range(STEPS):
        for k in range(count):
            for i in range(4):
                rest[i] = off[k, i]
                for j in range(9):
                    rest[i] -= jac[k, i, j] * solution[j]
            distance[0, k], distance[1, k] = math.hypot(rest[0], rest[1]), math.hypot(rest[2], rest[3])
        normal[:], rhs[:] = 0.0, 0.0
        squares = 0.0
        for side in range(2):
            scale = max(SCALE * median(distance[side]), LEAST_PX)
            for k in range(count):
                weight[side, k] = 1.0 / (scale**2 + distance[side, k] ** 2)
                squares += weight[side, k] * distance[side, k] ** 2
        for k in range(count):
            for i in range(4):
                w = weight[i // 2, k]
                for j in range(9):
                    rhs[j] += w * jac[k, i, j] * off[k, i]
                    for m in range(j + 1):
                        normal[j, m] += w * jac[k, i, j] * jac[k, i, m]
        for j in range(9):
            for m in range(j):
                normal[m, j] = normal[j, m]
        if not solve_symmetric(normal, rhs, solution, factor):
            return solution[6:], covariance, 0
    unit, column = np.zeros(9), np.zeros(9)
    for j in range(3):
        unit[:] = 0.0
        unit[6 + j] = squares / (4.0 * count - 9.0)
        solve_symmetric(normal, unit, column, factor)
        covariance[j] = column[6:]
    return solution[6:].copy(), covariance, count


@njit
def _residuals(pose, origin, direction, rho, uv_l, uv_r, cameras, off, jac):
    """A point's residuals `off` (4,) px and their derivatives; NaN where a camera does not see it.

    Left, and right beyond left: what the left image is tracked wrong by, the right one is, too. `jac`: (4, 9) by
    translation and rotation of the left camera's axes, and by the right camera's turn.
    """
    right_T_left = cameras.right_T_left
    p, q, by_p, by_q = np.zeros(3), np.zeros(3), np.zeros((2, 3)), np.zeros(3)
    for i in range(3):
        for j in range(3):
            p[i] += pose[j, i] * (origin[j] + direction[j] / rho - pose[j, 3])
    for i in range(3):
        q[i] = right_T_left[i, 3]
        for j in range(3):
            q[i] += right_T_left[i, j] * p[j]
    left = project_one(cameras.model_l, cameras.params_l, p[0], p[1], p[2])
    right = project_one(cameras.model_r, cameras.params_r, q[0], q[1], q[2])
    for i in range(2):
        off[i] = uv_l[i] - left[i]
        off[2 + i] = uv_r[i] - right[i] - off[i]
        for j in range(3):
            by_p[0, j], by_q[j] = left[2 + 3 * i + j], right[2 + 3 * i + j]
        for j in range(3):
            by_p[1, j] = -by_p[0, j]
            for m in range(3):
                by_p[1, j] += by_q[m] * right_T_left[m, j]
        for row in range(2):
            for j in range(3):
                jac[2 * row + i, j] = by_p[row, j]
                jac[2 * row + i, 3 + j] = (
                    by_p[row, (j + 2) % 3] * p[(j + 1) % 3] - by_p[row, (j + 1) % 3] * p[(j + 2) % 3]
                )
        for j in range(3):
            jac[2 + i, 6 + j] = by_q[(j + 1) % 3] * q[(j + 2) % 3] - by_q[(j + 2) % 3] * q[(j + 1) % 3]
