"""Does the camera expose its rows one after the other? The residuals of tracking with several readouts tell.

That points fit better with another readout is not enough. A camera that drives straight ahead displaces the rows of a
rolling shutter in every image by the same amount, and so does a calibration that is slightly wrong: a right camera
turned by 0.1 degrees makes KITTI's global shutter fit 10 % better with rows read within 30 ms. What a wrong calibration
displaces stays in place when the motion changes, what the rows displace changes with it: then the right readout gains
the more the further the motion is from the usual one, while for a wrong calibration every unusual motion makes the
other readout fit worse. So the gain must grow with the distance of the angular velocity from its median.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import TrackerConfig
from stereo_sfm.geometry import se3
from stereo_sfm.tracking.flow.tracker import Tracker
from stereo_sfm.types import F64, StereoImage

READOUTS_S = (0.0, 0.01, 0.02, 0.03)  # the errors tell it to about 10 ms
LEAST_FRAMES = 20
NEARLY = 0.1  # of the gain: errors are flat beyond the true readout
LEAST_EVIDENCE = 2.0  # standard deviations by which the gain must follow the motion
LEAST_GAIN = 0.05  # global shutters gain up to 0.03 by chance and by faults of the lens model


@dataclass(frozen=True, eq=False)
class ReadoutErrors:
    """How well the points of a recording fit, by readout."""

    readout_s: F64  # (R,) seconds, the first one the rig's own
    error_px: F64  # (R,) mean over the frames of the median residual; NaN without enough frames
    evidence: float = math.inf  # how surely the best one's gain grows with unusual motion, in standard deviations

    @property
    def best_s(self) -> float:
        """The shortest readout that fits about as well as the best; the rig's own where none is clearly better."""
        if not self.gain > LEAST_GAIN or self.explained_otherwise:
            return float(self.readout_s[0])
        enough = self.error_px.min() + NEARLY * (self.error_px[0] - self.error_px.min())
        return float(self.readout_s[self.error_px <= enough].min())

    @property
    def explained_otherwise(self) -> bool:
        """Whether another readout fits better, but not as rows do that follow the motion: as a wrong calibration."""
        return self.gain > LEAST_GAIN and not self.evidence > LEAST_EVIDENCE

    @property
    def shown(self) -> bool:
        """Whether the recording tells readouts apart: a camera that hardly moves fits them all."""
        return float(np.ptp(self.error_px)) > LEAST_GAIN * float(self.error_px.min())

    @property
    def gain(self) -> float:
        """By what part the error is smaller with the best one than with the rig's own; NaN when it is not known."""
        return float(1 - self.error_px.min() / self.error_px[0])


class ReadoutSearch:
    """One tracker for each readout, on the same images."""

    def __init__(self, config: TrackerConfig, rig: Rig) -> None:
        readouts = (rig.readout_s, *(s for s in READOUTS_S if abs(s - rig.readout_s) > 0.004))
        self._readout_s = np.array(readouts)
        self._trackers = [Tracker(config, replace(rig, readout_s=s)) for s in readouts]
        self._errors: list[list[float]] = []
        self._poses: list[F64] = []
        self._stamps: list[int] = []

    def add(self, image: StereoImage) -> None:
        """Track one more image."""
        frames = [tracker.step(image)[0] for tracker in self._trackers]
        solutions = [tracker.solution for tracker in self._trackers]
        self._errors.append([math.nan if s is None else s.residual_px for s in solutions])
        self._poses.append(frames[0].odom_T_cam)
        self._stamps.append(image.stamp_ns)

    def errors(self) -> ReadoutErrors:
        """What was found until now."""
        errors: F64 = np.array(self._errors, float).reshape(-1, len(self._trackers))
        known = np.isfinite(errors).all(axis=1) & (np.arange(len(errors)) > 0)  # no motion led to the first
        if known.sum() < LEAST_FRAMES:
            return ReadoutErrors(self._readout_s, np.full(len(self._trackers), np.nan))
        mean = errors[known].mean(0)
        gain = errors[:, 0] ** 2 - errors[:, int(mean.argmin())] ** 2
        return ReadoutErrors(self._readout_s, mean, _follows(gain[known], self._unusual()[known]))

    def _unusual(self) -> F64:
        """(F,) rad/s between the angular velocity that led to each frame and the median one."""
        poses, seconds = np.array(self._poses), np.diff(self._stamps) * 1e-9
        turns = se3.so3_log((se3.inverse(poses[:-1]) @ poses[1:])[:, :3, :3]) / np.maximum(seconds, 1e-6)[:, None]
        return np.concatenate([[0.0], np.linalg.norm(turns - np.median(turns, axis=0), axis=1)])


def _follows(gain: F64, unusual: F64) -> float:
    """How surely one of two columns grows with the other: Spearman's rank correlation in standard deviations."""
    if np.ptp(gain) == 0 or np.ptp(unusual) == 0:
        return 0.0
    ranks = [np.argsort(np.argsort(column, kind="stable")) - 0.5 * (len(column) - 1) for column in (gain, unusual)]
    rho = float(ranks[0] @ ranks[1] / np.sqrt((ranks[0] @ ranks[0]) * (ranks[1] @ ranks[1])))
    return rho * math.sqrt((len(gain) - 2) / max(1 - rho * rho, 1e-9))
