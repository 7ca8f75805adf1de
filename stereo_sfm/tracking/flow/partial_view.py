"""Poses found while a part of the view was covered, to be found anew once more of it is free.

What is left of a view may be one wall, before which a turn and a shift look alike: errors of some centimetres and half
a degree. New points inherit them. The reference image, from before the cover, does not have them.
"""

from __future__ import annotations

import math

import numpy as np

from stereo_sfm.geometry import se3
from stereo_sfm.tracking.flow.follower import ReferenceImage
from stereo_sfm.tracking.flow.recovery import REACH, SUFFICIENT_RECALL
from stereo_sfm.types import F64

MORE_RECALL = 0.15  # by which more of the reference points must be found than before
LASTS_NS = 1_000_000_000  # in which what covers the view has gone by, or stays


class PartialView:
    """The last pose from a part of the view."""

    def __init__(self) -> None:
        self._reference: ReferenceImage | None = None
        self._recall, self._sigma_m = 1.0, 0.0
        self._until_ns = 0

    def begin(self, reference: ReferenceImage, recall: float, covariance: F64, stamp_ns: int) -> None:
        """A pose was found at a time, with that share of the reference points; with a sufficient one it stays.

        `covariance`: (6, 6) of the pose.
        """
        self._reference = reference
        self._recall, self._sigma_m, self._until_ns = recall, _sigma_m(covariance), stamp_ns + LASTS_NS
        self.end(recall)

    def wanted(self, reference: ReferenceImage, stamp_ns: int) -> bool:
        """Whether to look for more points: not for long, and not in an image that became the reference since."""
        return reference is self._reference and stamp_ns <= self._until_ns

    def improved(self, before: F64, after: F64, recall: float, covariance: F64) -> bool:
        """Whether a pose (4, 4) by a share of the reference points replaces the one that it was looked for from.

        More of a view that the camera drives out of may be fewer points: their pose (`covariance` (6, 6)) is no better.
        """
        if recall < self._recall + MORE_RECALL:
            return False
        sigma_m = _sigma_m(covariance)
        contradicted = not se3.within(before, after, REACH * math.hypot(sigma_m, self._sigma_m), math.inf)
        return contradicted or sigma_m < self._sigma_m

    def end(self, recall: float) -> None:
        """Nothing more is to be found once a sufficient share of the reference points was."""
        if recall >= SUFFICIENT_RECALL:
            self._reference = None


def _sigma_m(covariance: F64) -> float:
    """Standard deviation of the position of a pose with covariance (6, 6)."""
    return math.sqrt(np.trace(covariance[:3, :3]))
