"""The camera's rotation by images and gyroscope: a Kalman filter with an innovation test.

Between two images a gyroscope's rotation is several times more accurate than one from pixels; over seconds only that
from pixels stays. Where they contradict each other now and then, the images are wrong: points that slide along edges
or onto others agree on a turn that was none. Where they do so all the time, or by much, the gyroscope is. The pose from
images is corrected as a whole: where rotation and translation look alike (a far scene, few points), an exact rotation
corrects the translation too.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from stereo_sfm.geometry import se3
from stereo_sfm.types import F64

DOUBTED_CHI2 = 11.3  # of three degrees of freedom: 99 %; beyond, one of them is wrong and counts less
JUDGED = 20  # images: when most of them contradict a sensor, it is wrong, not each of them
WRONG_TURN = 0.01  # rad by which points that agree with each other do not err: so is a single jump of the gyroscope


class RotationFilter:
    """One `fused` per image; without it, `restart`."""

    def __init__(self) -> None:
        self._covariance: F64 | None = None  # (3, 3) of the last rotation, camera axes
        self._contradicted: deque[bool] = deque(maxlen=JUDGED)
        self.chi2 = 0.0  # of three: the newest rotation from images against the predicted one

    def restart(self) -> None:
        """The last pose is not one of this filter."""
        self._covariance = None

    def fused(self, predicted: F64, turn: F64, noise: F64, seen: F64, covariance: F64) -> F64:
        """The pose of an image (4, 4) odom_T_cam.

        Args:
            predicted: (3, 3) odom_R_cam by the gyroscope from the last pose. turn: (3, 3) of that, last_R_cam.
            noise: (3, 3) covariance of `turn`, camera axes.
            seen, covariance: (4, 4) odom_T_cam by the image and (6, 6) of seen @ exp(xi), xi = (rho, phi).
        """
        if self._covariance is None:
            self._covariance = covariance[3:, 3:].copy()
            return seen
        expected = turn.T @ self._covariance @ turn + noise
        off = se3.so3_log(seen[:3, :3].T @ predicted)
        information = np.linalg.inv(covariance[3:, 3:] + expected)
        self.chi2 = float(off @ information @ off)
        self._contradicted.append(self.chi2 > DOUBTED_CHI2)
        excess = max(self.chi2 / DOUBTED_CHI2, 1.0)
        if sum(self._contradicted) > JUDGED // 2 or off @ off > WRONG_TURN**2:
            gain = covariance[:, 3:] @ information / excess
            self._covariance = covariance[3:, 3:] - gain[3:] @ covariance[3:, 3:]
        else:
            if excess > 1.0:
                information = np.linalg.inv(covariance[3:, 3:] + expected / excess)
            gain = covariance[:, 3:] @ information
            self._covariance = gain[3:] @ expected
        return seen @ se3.exp(gain @ off)
