"""Does the camera expose its rows one after the other? The residuals of tracking with several readouts tell."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from calib.rig import Rig
from stereo_sfm.config import TrackerConfig
from stereo_sfm.tracking.flow.tracker import Tracker
from stereo_sfm.types import F64, StereoImage

READOUTS_S = (0.0, 0.01, 0.02, 0.03)  # the errors tell it to about 10 ms
LEAST_FRAMES = 20
NEARLY = 0.1  # of the gain: errors are flat beyond the true readout
LEAST_GAIN = 0.05  # global shutters gain up to 0.03 by chance and by faults of the lens model


@dataclass(frozen=True, eq=False)
class ReadoutErrors:
    """How well the points of a recording fit, by readout."""

    readout_s: F64  # (R,) seconds, the first one the rig's own
    error_px: F64  # (R,) mean over the frames of the median residual; NaN without enough frames

    @property
    def best_s(self) -> float:
        """The shortest readout that fits about as well as the best; the rig's own where none is clearly better."""
        if not self.gain > LEAST_GAIN:
            return float(self.readout_s[0])
        enough = self.error_px.min() + NEARLY * (self.error_px[0] - self.error_px.min())
        return float(self.readout_s[self.error_px <= enough].min())

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

    def add(self, image: StereoImage) -> None:
        """Track one more image."""
        for tracker in self._trackers:
            tracker.step(image)
        solutions = [tracker.solution for tracker in self._trackers]
        self._errors.append([math.nan if s is None else s.residual_px for s in solutions])

    def errors(self) -> ReadoutErrors:
        """What was found until now."""
        errors = np.array(self._errors).reshape(-1, len(self._trackers))
        errors = errors[np.isfinite(errors).all(axis=1)]
        enough = len(errors) >= LEAST_FRAMES
        return ReadoutErrors(self._readout_s, errors.mean(0) if enough else np.full(len(self._trackers), np.nan))
