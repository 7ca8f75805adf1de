"""Measurement of the readout time of a rolling shutter from the motion of points between images.

A row exposed s seconds after an image's stamp is exposed from the pose at that time: points are displaced by s times
the derivative of their pixels by the camera's motion, times its velocity. A constant velocity displaces a point by the
same amount in successive images, and so does an error of the calibration, in proportion to the velocity. A change of
velocity has an effect that no calibration error has: it displaces the rows of an image relative to those of the
previous one by readout * (row / rows - 1/2) * J * (change of velocity), with J the derivatives of pixels by the pose.
The readout is the coefficient of this displacement in a robust regression of the points' motion, together with the pose
of the image and the displacement by the velocity itself. Its standard error is from the spread between images
(cluster-robust; Liang and Zeger, Biometrika 73, 1986), and from the velocities: differences of successive poses are
smoother than the motion, so that at a low frame rate its changes are underestimated. With constant velocity the readout
is not observable, and the standard error is large.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import TrackerConfig
from stereo_sfm.geometry import se3
from stereo_sfm.tracking.flow.tracker import Tracker
from stereo_sfm.types import F64, I64, Frame, Keyframe, StereoImage

MIN_PAIRS = 20  # of images
MIN_POINTS = 30  # in both images of a pair
DEVIATIONS = 4.0  # standard errors between measured and calibrated readout that make a difference significant
SMOOTHING = 0.1  # share of the readout: velocities from poses 1/15 s apart, of a robot with vibration
# Smallest difference, and largest standard error with which a readout of 20 ms, a common one, differs from none.
KNOWN_S = 0.005
CAUCHY = 2.0  # standard deviations
ROUNDS = 4  # of reweighting


@dataclass(frozen=True)
class Readout:
    """The measured readout of a recording."""

    calibrated_s: float  # the calibration's
    measured_s: float  # NaN without enough images; negative: read from the bottom up
    sigma_s: float  # standard error
    error_px: float  # median reprojection error, mean over the images

    @property
    def differs(self) -> bool:
        """Whether the measurement differs significantly from the calibration."""
        return abs(self.measured_s - self.calibrated_s) > max(DEVIATIONS * self.sigma_s, KNOWN_S)

    @property
    def known(self) -> bool:
        """Whether the motion determines the readout."""
        return self.differs or self.sigma_s < KNOWN_S

    @property
    def best_s(self) -> float:
        """The measured readout if it differs from the calibration's, else the calibration's."""
        return self.measured_s if self.differs else self.calibrated_s


@dataclass(frozen=True, eq=False)
class _View:
    """The points of one image that agree with its pose."""

    stamp_ns: int
    odom_T_cam: F64  # (4, 4)
    point_ids: I64  # (N,)
    uv: F64  # (N, 2) px
    points: F64  # (N, 3) metres, odometry frame


class ReadoutSearch:
    """Tracks a recording and measures its readout."""

    def __init__(self, config: TrackerConfig, rig: Rig) -> None:
        self._rig, self._tracker = rig, Tracker(config, rig)
        self._views: deque[_View] = deque(maxlen=4)
        self._pairs: list[tuple[float, float]] = []  # weighted sums: displacement * movement, displacement squared
        self._error_px: list[float] = []

    def add(self, image: StereoImage, measured: bool = True) -> tuple[Frame, Keyframe | None]:
        """Track one more image, and use it unless it is not `measured`; returns what the tracker made of it."""
        frame, keyframe = self._tracker.step(image)
        if measured:
            self._measure(image, frame)
        return frame, keyframe

    def _measure(self, image: StereoImage, frame: Frame) -> None:
        seen, solution = frame.observations, self._tracker.solution
        if solution is None or solution.reason:
            self._views.clear()
            return
        self._error_px.append(solution.residual_px)
        good = seen.inlier
        points = self._tracker.points[good]
        self._views.append(_View(image.stamp_ns, frame.odom_T_cam, seen.point_ids[good], seen.uv_left[good], points))
        if len(self._views) == 4:
            self._compare(*self._views)

    def measured(self) -> Readout:
        """The result of the images so far."""
        product, square = np.array(self._pairs, float).reshape(-1, 2).T
        total = float(square.sum())
        if len(self._pairs) < MIN_PAIRS or total <= 0:
            return Readout(self._rig.readout_s, math.nan, math.nan, math.nan)
        readout_s = float(product.sum()) / total
        rest = product - readout_s * square
        neighbours = float(rest[1:] @ rest[:-1])  # successive pairs share an image
        spread_s = math.sqrt(rest @ rest + 2 * max(neighbours, 0.0)) / total
        sigma_s = math.hypot(spread_s, SMOOTHING * readout_s)
        return Readout(self._rig.readout_s, readout_s, sigma_s, float(np.mean(self._error_px)))

    def _compare(self, first: _View, before: _View, now: _View, last: _View) -> None:
        """Add the motion between the second and third of four successive views, whose velocities are known."""
        velocities = _velocity((first, before, now)), _velocity((before, now, last))
        _, i, j = np.intersect1d(before.point_ids, now.point_ids, return_indices=True)
        if len(i) < MIN_POINTS or velocities[0] is None or velocities[1] is None:
            return
        points = now.points[j]
        uv_before, _ = self._project(before, points)
        uv_now, by_pose = self._project(now, points)
        moved = (now.uv[j] - uv_now) - (before.uv[i] - uv_before)
        row = (now.uv[j, 1] / (self._rig.left.height - 1) - 0.5)[:, None]
        by_velocity = row * (by_pose @ (0.5 * (velocities[0] + velocities[1])))
        by_change = row * (by_pose @ (velocities[1] - velocities[0]))
        columns = np.concatenate([by_pose, by_velocity[..., None], by_change[..., None]], axis=2)
        visible = np.isfinite(columns).all(axis=(1, 2)) & np.isfinite(moved).all(axis=1)
        if visible.sum() >= MIN_POINTS:
            self._pairs.append(_last_coefficient(columns[visible], moved[visible]))

    def _project(self, view: _View, points: F64) -> tuple[F64, F64]:
        """Pixels (N, 2) of points (N, 3) and their derivatives (N, 2, 6) by odom_T_cam @ exp(xi)."""
        points_cam = se3.transform(se3.inverse(view.odom_T_cam), points)
        uv, by_point = self._rig.left.project_jacobian(points_cam)
        return uv, np.concatenate([-by_point, by_point @ se3.skew(points_cam)], axis=2)


def _velocity(views: Sequence[_View]) -> F64 | None:
    """(6,) tangent a second at the second of three views, exact for a constant acceleration; None without times."""
    means: list[F64] = []
    seconds: list[float] = []
    for a, b in pairwise(views):
        seconds.append((b.stamp_ns - a.stamp_ns) * 1e-9)
        if seconds[-1] <= 0:
            return None
        means.append(se3.log(se3.inverse(a.odom_T_cam) @ b.odom_T_cam) / seconds[-1])
    return (seconds[1] * means[0] + seconds[0] * means[1]) / (seconds[0] + seconds[1])


def _last_coefficient(columns: F64, moved: F64) -> tuple[float, float]:
    """Normal equation of the last column's coefficient in a robust regression, the others eliminated.

    Args:
        columns: (N, 2, C). moved: (N, 2) px.

    Returns:
        Right and left side, in units of the noise.
    """
    weight, sigma = np.ones(len(moved)), 1.0
    flat, target = columns.reshape(2 * len(moved), -1), moved.ravel()
    for _ in range(ROUNDS):
        weighted = flat * np.repeat(weight, 2)[:, None]
        coefficients = np.linalg.pinv(weighted.T @ flat, hermitian=True) @ (weighted.T @ target)
        error = np.hypot(*(target - flat @ coefficients).reshape(-1, 2).T)
        sigma = max(float(np.median(error)) / math.sqrt(2 * math.log(2)), 1e-3)  # of a Rayleigh distribution
        weight = 1 / (1 + (error / (CAUCHY * sigma)) ** 2)
    weighted = flat * np.repeat(weight / sigma**2, 2)[:, None]
    normal, right = weighted.T @ flat, weighted.T @ target
    eliminated = normal[-1, :-1] @ np.linalg.pinv(normal[:-1, :-1], hermitian=True)
    return float(right[-1] - eliminated @ right[:-1]), float(normal[-1, -1] - eliminated @ normal[:-1, -1])
