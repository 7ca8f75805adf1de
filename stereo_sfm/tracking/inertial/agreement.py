"""Whether what an IMU measures agrees with what the images show: before, it does not count.

The rates that the images show are y = M x + d x' + b for measured rates x: M is the identity if axes, signs and units
are right, d is a time offset, b a bias. The accelerations that the images show, in the odometry frame, are
y = s R f + g + R b for measured forces f: s is 1 if the accelerometer's axes, direction and units are right. All of it
is linear, and what the camera's motion does not show has a large standard deviation: then nothing is decided.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from stereo_sfm.calib.imu_fit import WRONG_OFFSET_MS, WRONG_ROTATION_DEG
from stereo_sfm.tracking.inertial.inertial_filter import ROTATION_SIGMA
from stereo_sfm.types import F64

MEMORY_S = 20.0  # time constant with which what was seen is forgotten
FREEDOM = 10  # degrees of freedom left before anything is decided: then residuals tell the noise to a third
AGREED, KNOWN = 0.3, 0.1  # error of a quantity that agrees, and its standard deviation: not another axis, sign or unit
TURNED = float(np.radians(WRONG_ROTATION_DEG[1]))  # error of rates that contradicts: what `check-calib` fails
SIGMAS = 3.0  # of an error beyond those: less may be chance
FORCE_SIGMA = 1e-3  # m of a pose by images at best: less is not believed of residuals


class SensorUse(IntEnum):
    """How far a sensor counts at a frame."""

    CONTRADICTS = -1  # it contradicts the images
    MISSING = 0  # no samples around the images
    UNKNOWN = 1  # the camera's motion does not show yet whether it agrees
    ROTATION = 2  # of an IMU, the gyroscope
    USED = 3


class RateAgreement:
    """Rates of a gyroscope against those of the images."""

    def __init__(self, bias_sigma: float) -> None:
        """`bias_sigma`: rad/s, standard deviation of the gyroscope's bias."""
        self._bias_sigma = bias_sigma
        self._last: deque[tuple[F64, F64, float]] = deque(maxlen=3)
        self._n = self._seconds = 0.0
        self._x, self._y = np.zeros(3), np.zeros(3)  # sums
        self._xx, self._yx, self._yy = np.zeros((3, 3)), np.zeros((3, 3)), 0.0
        self._changes, self._late = 0.0, 0.0  # of the time offset: sums of x'^2 and x'(y - x)

    def begin(self) -> None:
        """The next interval does not follow the last one."""
        self._last.clear()

    def add(self, measured: F64, seen: F64, seconds: float) -> None:
        """Mean rates (3,) rad/s of an interval, in the same axes."""
        self._last.append((measured, seen, seconds))
        if len(self._last) < 3:
            return
        (before, _, first), (x, y, t), (after, _, last) = self._last
        keep = float(np.exp(-t / MEMORY_S))
        change = (after - before) / (t + 0.5 * (first + last))
        self._n, self._seconds = keep * self._n + 1, keep * self._seconds + t
        self._x, self._y = keep * self._x + x, keep * self._y + y
        self._xx, self._yx = keep * self._xx + np.outer(x, x), keep * self._yx + np.outer(y, x)
        self._yy = keep * self._yy + float(y @ y)
        self._changes = keep * self._changes + float(change @ change)
        self._late = keep * self._late + float(change @ (y - x))

    def _fit(self) -> _RateFit | None:
        """None while too little was seen."""
        freedom = 3 * self._n - 13
        if freedom < FREEDOM:
            return None
        floor = 2 * (ROTATION_SIGMA * self._n / self._seconds) ** 2  # (rad/s)^2
        variance, energy, axes, found = floor, np.ones(3), np.eye(3), np.eye(3)
        for _ in range(2):  # the second time with the noise that is left
            n = self._n + variance / self._bias_sigma**2
            xx, yx = self._xx - np.outer(self._x, self._x) / n, self._yx - np.outer(self._y, self._x) / n
            energy, axes = np.linalg.eigh(xx)
            energy = np.maximum(energy, 1e-12)
            found = (yx @ axes) / energy
            left = self._yy - float(self._y @ self._y) / n - float((found**2 * energy).sum())
            variance = max(left / freedom, floor)
        changes = max(self._changes, 1e-12)
        return _RateFit(
            axes, found, np.sqrt(3 * variance / energy), self._late / changes, float(np.sqrt(variance / changes))
        )

    def verdict(self) -> bool | None:
        """Whether the gyroscope agrees with the images; None while that is not decided."""
        fit = self._fit()
        if fit is None:
            return None
        error = np.linalg.norm(fit.found - fit.axes, axis=0)
        if (error > TURNED + SIGMAS * fit.sigma).any() or fit.late:
            return False
        known = fit.sigma < KNOWN
        return True if known.any() and (error[known] < AGREED).all() else None

    def why(self) -> str:
        """What is wrong with a gyroscope that does not agree."""
        fit = self._fit()
        if fit is None or (fit.sigma > 1).all():
            return "it measures no rotation where the images turn"
        strongest = fit.found[:, 2]  # of ascending energies
        scale = float(np.linalg.norm(strongest))
        if scale > 0 and abs(np.log(np.radians(1) / scale)) < AGREED:
            return "its rates are in degrees, not radians"
        if scale < 0.5:
            return "its rates are not those of the images: another clock, or another sensor's data"
        turned, angle = fit.found @ fit.axes.T, 0.0
        if (fit.sigma < AGREED).all():
            if np.linalg.det(turned) < 0:
                return "its rates have the wrong sign, or left- and right-handed axes are mixed"
            u, _, vt = np.linalg.svd(turned)
            angle = float(np.arccos(np.clip((np.trace(u @ vt) - 1) / 2, -1.0, 1.0)))
        angle = angle or float(np.arccos(np.clip(strongest @ fit.axes[:, 2] / scale, -1.0, 1.0)))
        if fit.late and angle < 2 * AGREED:
            return f"its stamps are about {1e3 * fit.late_s:+.0f} ms off"
        if angle > TURNED:
            return f"its axes are turned by about {np.degrees(angle):.0f} degrees against the calibration"
        return f"its rates are {1 / scale:.2f} times those of the images"


@dataclass(frozen=True, eq=False)
class _RateFit:
    """M as far as the motion shows it."""

    axes: F64  # (3, 3) columns: directions of the measured rates, those with the least energy first
    found: F64  # (3, 3) M times each
    sigma: F64  # (3,) standard deviation of each, its length
    late_s: float  # time offset d
    late_sigma_s: float

    @property
    def late(self) -> bool:
        """Whether the time offset is wrong."""
        return abs(self.late_s) > 1e-3 * WRONG_OFFSET_MS[1] + SIGMAS * self.late_sigma_s


class ForceAgreement:
    """Forces of an accelerometer against the accelerations of the images."""

    def __init__(self, bias_sigma: float) -> None:
        """`bias_sigma`: m/s^2, standard deviation of the accelerometer's bias."""
        self._bias_sigma = bias_sigma
        self._n = self._period = 0.0
        self._h, self._b, self._yy = np.zeros((7, 7)), np.zeros(7), 0.0

    def add(self, measured: F64, seen: F64, by_bias: F64, seconds: float) -> None:
        """A mean acceleration in the odometry frame: measured with gravity (3,), seen (3,), m/s^2; derivative of the
        measured one by the accelerometer's bias (3, 3)."""
        rows = np.hstack([measured[:, None], np.eye(3), by_bias])
        keep = float(np.exp(-seconds / MEMORY_S))
        self._n, self._period = keep * self._n + 1, seconds
        self._h, self._b = keep * self._h + rows.T @ rows, keep * self._b + rows.T @ seen
        self._yy = keep * self._yy + float(seen @ seen)

    def _fit(self) -> tuple[float, float]:
        """s and its standard deviation, infinite while too little was seen."""
        freedom = 3 * self._n - 7
        if freedom < FREEDOM:
            return 1.0, np.inf
        floor = 6 * FORCE_SIGMA**2 / self._period**4  # (m/s^2)^2, of a second difference of positions
        scale, sigma, variance = 1.0, np.inf, floor
        for _ in range(2):  # the second time with the noise that is left
            h = self._h + np.diag([1e-9] * 4 + [variance / self._bias_sigma**2] * 3)
            x = np.linalg.solve(h, self._b)
            left = self._yy - 2 * float(x @ self._b) + float(x @ self._h @ x)
            variance = max(left / freedom, floor)
            scale, sigma = float(x[0]), float(np.sqrt(variance * np.linalg.inv(h)[0, 0]))
        return scale, sigma

    def verdict(self) -> bool | None:
        """Whether the accelerometer agrees with the images; None while that is not decided."""
        scale, sigma = self._fit()
        if abs(scale - 1) > AGREED + SIGMAS * sigma:
            return False
        return True if sigma < KNOWN and abs(scale - 1) < AGREED else None

    def why(self) -> str:
        """What is wrong with an accelerometer that does not agree."""
        scale = self._fit()[0]
        if scale < -0.5:
            return "its forces have the wrong sign"
        if scale < 0.5:
            return "its axes are not those of the calibration, or it is another sensor's data"
        return f"its forces are {1 / scale:.2f} times those of the images" + (" (in g?)" if scale > 5 else "")
