"""Measurement of the readout time of a rolling shutter from the motion of points between images.

A row exposed s seconds after an image's stamp is exposed from the pose at that time: points are displaced by s times
the derivative of their pixels by the camera's motion, times its velocity. A constant velocity displaces a point by the
same amount in successive images, and so does an error of the calibration, in proportion to the velocity. A change of
velocity has an effect that no calibration error has: it displaces the rows of an image relative to those of the
previous one by readout * (row / rows - 1/2) * J * (change of velocity), with J the derivatives of pixels by the pose.
The readout is the coefficient of this displacement in a robust regression of the points' motion, together with the pose
of the image, the displacement by the velocity itself, and that by one error of all inverse distances: on a road what is
near is low in the image. While the velocity changes steadily, an error of the calibration changes in the same way: the
mean of the changes is not used. The standard error is from the spread between
images (cluster-robust; Liang and Zeger, Biometrika 73, 1986), known as well as the number of pairs that tell something
allows, and from the velocities: differences of successive poses are smoother than the motion, so that at a low frame
rate its changes are underestimated. With constant velocity the readout is not observable, and the standard error is
large.
"""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false

from __future__ import annotations

import functools
import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from stereo_sfm.calib.choice import Estimate
from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import Config
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.kernels import njit
from stereo_sfm.geometry.order_statistics import median
from stereo_sfm.geometry.small_matrix import cholesky, cholesky_solve
from stereo_sfm.tracking.flow.tracks import Tracks
from stereo_sfm.types import F64, I64, Bool

MIN_PAIRS = 20  # of images
SHARING = 3  # pairs before a pair with which it shares some of the four images that both are of
STEADY = 0.1  # of a new change of velocity in their mean, in which vibration cancels; not removed: KITTI 01 has -14 ms
MIN_POINTS = 30  # in both images of a pair
# Standard deviations of a Gaussian, of one in 2,000 by chance, between measured and calibrated readout that differ. In
# 33 runs of 17 sequences with a global shutter, asked at every image, the largest is 3.3.
DEVIATIONS = 3.5
SMOOTHING = 0.1  # share of the readout: velocities from poses 1/15 s apart, of a robot with vibration
# Smallest difference, and largest standard error with which a readout of 20 ms, a common one, differs from none.
KNOWN_S = 0.005
CAUCHY = 2.0  # standard deviations
ROLLING = "the camera reads its rows one after the other"  # how the news begin
ROUNDS = 4  # of reweighting
RAYLEIGH = math.sqrt(2 * math.log(2))  # median of the length of two errors, in their standard deviations
LEAST_PX = 0.3  # standard deviation of a pixel; with 0.001, repeated images of 7-Scenes decide, which show none
NOTHING = 1e-6  # normal equation of a column that a camera at rest leaves empty


@dataclass(frozen=True)
class Readout:
    """The measured readout of a recording."""

    calibrated_s: float  # the calibration's
    measured_s: float  # NaN without enough images; negative: read from the bottom up
    spread_s: float  # standard error by the spread between images
    freedom: float  # degrees of freedom of this spread

    @property
    def sigma_s(self) -> float:
        """Standard error."""
        return math.hypot(self.spread_s, SMOOTHING * self.measured_s)

    @functools.cached_property
    def differs(self) -> bool:
        """Whether the measurement differs significantly from the calibration."""
        return self._error_s > KNOWN_S and self._reach(self._error_s) > DEVIATIONS

    @functools.cached_property
    def matters(self) -> bool:
        """Whether it differs by surely more (two standard errors) than is worth a change."""
        return self.differs and self._error_s - KNOWN_S > 2 * self.sigma_s

    @property
    def known(self) -> bool:
        """Whether the motion determines the readout."""
        return self.differs or self.sigma_s < KNOWN_S

    @functools.cached_property
    def settled(self) -> bool:
        """Whether more images would tell little: the difference is known but for what all images share, which is four
        fifths of the variance then; or it is known not to matter."""
        if self.differs:
            return self.spread_s < 0.5 * SMOOTHING * abs(self.measured_s)
        return self._error_s < KNOWN_S and self._reach(KNOWN_S - self._error_s) > DEVIATIONS

    @property
    def _error_s(self) -> float:
        return abs(self.measured_s - self.calibrated_s)

    def _reach(self, seconds: float) -> float:
        """In standard errors of a Gaussian."""
        return Estimate(np.array([seconds]), np.array([[self.sigma_s**2]]), self.freedom).reach

    @property
    def best_s(self) -> float:
        """The measured readout if it differs from the calibration's, else the calibration's."""
        return self.measured_s if self.differs else self.calibrated_s

    @property
    def text(self) -> str:
        """How long, without its direction."""
        return f"{1e3 * abs(self.measured_s):.0f} ± {1e3 * self.sigma_s:.0f} ms"


@dataclass(frozen=True, eq=False)
class _View:
    """The points that were followed to one image."""

    stamp_ns: int
    odom_T_cam: F64  # (4, 4)
    point_ids: I64  # (N,)
    uv: F64  # (N, 2) px
    points: F64  # (N, 3) metres, odometry frame
    agrees: Bool  # (N,) with the pose


class ReadoutSearch:
    """Measures the readout of the images of a run, until more of them would not make it better."""

    def __init__(self, rig: Rig, applies: bool = False) -> None:
        """`applies`: the measured readout is used as soon as it is better than the calibration's."""
        self._camera, self._applies = rig.left, applies
        self.used_s = rig.readout_s
        self.measured = Readout(rig.readout_s, math.nan, math.nan, math.nan)  # by the images so far
        self.few_agree = False  # points with the last poses
        self._views: deque[_View] = deque(maxlen=4)
        self._total: F64 = np.zeros(2)  # over pairs: displacement * movement, displacement squared, weighted
        self._last = deque([np.zeros(2)] * SHARING, maxlen=SHARING)  # these of the last pairs
        self._products: F64 = np.zeros((SHARING + 1, 2, 2))  # sums of their products with themselves and those before
        self._count, self._seconds = 0, 0.0  # of pairs, and sum of their intervals
        self._steady: F64 | None = None  # (6,) mean change of velocity
        self._said = False

    @staticmethod
    def from_config(config: Config, rig: Rig) -> ReadoutSearch | None:
        """That of a run; None where the calibration states a readout, or is not checked."""
        mode = config.self_calibration.mode
        return None if mode == "off" or rig.readout_s != 0 else ReadoutSearch(rig, mode == "auto")

    def interrupt(self) -> None:
        """An image has no pose."""
        self._views.clear()

    def add(self, stamp_ns: int, odom_T_cam: F64, tracks: Tracks, agrees: Bool) -> None:
        """Add an image with its pose (4, 4), the pixels of its points, and which of them (N,) agree with the pose."""
        if self.measured.settled:
            return
        self._views.append(_View(stamp_ns, odom_T_cam, tracks.point_ids.copy(), tracks.uv, tracks.points(), agrees))
        if len(self._views) < 4 or not self._compare(*self._views):
            return
        if self._count < MIN_PAIRS:
            return
        self.measured = found = self._estimate()
        if self._applies and found.matters:
            most_s = self._seconds / self._count  # all rows are read before those of the next image
            self.used_s = min(max(found.measured_s, -most_s), most_s)

    def _estimate(self) -> Readout:
        product, square = self._total
        if square <= 0:
            return self.measured
        readout_s = float(product / square)
        rest = np.array([1.0, -readout_s])
        own, *shared = (float(rest @ products @ rest) for products in self._products)
        spread_s = math.sqrt(own + 2 * max(sum(shared), 0.0)) / float(square)
        pairs = float(square**2 / self._products[0, 1, 1])  # if all weighed the same
        return replace(self.measured, measured_s=readout_s, spread_s=spread_s, freedom=max(pairs - 1, 0.1))

    def news(self) -> str:
        """That the calibration's readout is wrong, once that is certain; "" otherwise."""
        if self._said or not self.measured.matters:
            return ""
        self._said = True
        below = "from below " if self.measured.measured_s < 0 else ""
        return f"{ROLLING} {below}within {self.measured.text}: set readout_s in rig.yaml"

    def _compare(self, first: _View, before: _View, now: _View, last: _View) -> bool:
        """Add the motion between the second and third of four successive views, whose velocities are known.

        By the points that agree with the poses; by all where these are few: an unknown readout makes them few. False
        without enough.
        """
        velocities = _velocity((first, before, now)), _velocity((before, now, last))
        _, i, j = np.intersect1d(before.point_ids, now.point_ids, return_indices=True)
        agree = before.agrees[i] & now.agrees[j]
        self.few_agree = np.count_nonzero(agree) < MIN_POINTS
        if not self.few_agree:
            i, j = i[agree], j[agree]
        if velocities[0] is None or velocities[1] is None:
            return False
        points = now.points[j]
        points_cam = se3.transform(se3.inverse(now.odom_T_cam), points)
        uv_before = self._camera.project(se3.transform(se3.inverse(before.odom_T_cam), points))
        uv_now, by_point = self._camera.project_jacobian(points_cam)
        moved = (now.uv[j] - uv_now) - (before.uv[i] - uv_before)
        row = now.uv[j, 1] / (self._camera.height - 1) - 0.5
        seen = np.isfinite(moved[:, 0])
        if np.count_nonzero(seen) < MIN_POINTS:
            return False
        velocity, change = 0.5 * (velocities[0] + velocities[1]), velocities[1] - velocities[0]
        sudden = change - (change if self._steady is None else self._steady)
        self._steady = change - (1 - STEADY) * sudden
        self._seconds += (now.stamp_ns - before.stamp_ns) * 1e-9
        self._count += 1
        pair = np.array(_readout(points_cam[seen], by_point[seen], row[seen], moved[seen], velocity, sudden))
        self._total += pair
        self._products += [np.outer(pair, other) for other in (pair, *self._last)]
        self._last.appendleft(pair)
        return True


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


@njit
def _readout(points_cam, by_point, row, moved, velocity, change):
    """Normal equation of the readout in a robust regression, in which all else is eliminated.

    Args:
        points_cam: (N, 3) metres. by_point: (N, 2, 3) derivatives of their pixels. row: (N,) share of the image's
            height, from its middle. moved: (N, 2) px, besides the motion of the camera. velocity, change: (6,).

    Returns:
        Right and left side, in units of the noise.
    """
    n, count = len(row), 9
    weight, error, sigma = np.ones(n), np.empty(n), 1.0
    normal, factor = np.empty((count, count)), np.zeros((count, count))
    right, x, columns = np.empty(count), np.zeros(count), np.empty((n, 2, count))
    for i in range(n):
        p = points_cam[i]
        distance = math.sqrt(p[0] ** 2 + p[1] ** 2 + p[2] ** 2)
        for k in range(2):
            column, by = columns[i, k], by_point[i, k]
            for a in range(3):
                column[a] = -by[a]
            column[3] = by[1] * p[2] - by[2] * p[1]  # by_point @ skew(p)
            column[4] = by[2] * p[0] - by[0] * p[2]
            column[5] = by[0] * p[1] - by[1] * p[0]
            for a in range(6, count):
                column[a] = 0.0
            for a in range(3):
                column[7] += distance * column[a] * velocity[a]
            for a in range(6):
                column[6] += row[i] * column[a] * velocity[a]
                column[8] += row[i] * column[a] * change[a]
    for _ in range(ROUNDS + 1):
        for a in range(count):
            right[a] = 0.0
            for b in range(a + 1):
                normal[a, b] = NOTHING if a == b else 0.0
        for i in range(n):
            for k in range(2):
                for a in range(count):
                    weighted = weight[i] * columns[i, k, a] / sigma**2
                    right[a] += weighted * moved[i, k]
                    for b in range(a + 1):
                        normal[a, b] += weighted * columns[i, k, b]
        if not cholesky(normal, factor):
            return 0.0, 0.0
        cholesky_solve(factor, right, x)
        for i in range(n):
            total = 0.0
            for k in range(2):
                rest = moved[i, k]
                for a in range(count):
                    rest -= columns[i, k, a] * x[a]
                total += rest**2
            error[i] = math.sqrt(total)
        sigma = max(median(error) / RAYLEIGH, LEAST_PX)
        for i in range(n):
            weight[i] = 1 / (1 + (error[i] / (CAUCHY * sigma)) ** 2)
    square = factor[-1, -1] ** 2
    return square * x[-1], square
