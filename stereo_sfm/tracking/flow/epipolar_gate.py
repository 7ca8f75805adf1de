"""Test whether stereo matches lie where the rig's epipolar curves are, which the images of the sequence tell.

An error of the calibration shifts all matches off their curves by a distance that varies slowly over the image, and a
soft lens or strong compression scatters them. Both are learned: a plane over the image, and the scatter around it, from
which the limit follows. A poor calibration has wider limits, not fewer points.
"""

from __future__ import annotations

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.geometry.order_statistics import percentile
from stereo_sfm.geometry.stereo import epipolar_angle
from stereo_sfm.types import F64, Bool

PERCENTILE, ITS_SIGMAS = 25, 0.3186  # of the distances: right ones, whatever half of the matches are; of a normal one
FIRST, LEARNED = 20.0, 200.0  # matches that the first guess counts for, and what was learned at most: some keyframes'


class EpipolarGate:
    """What a sequence shows of the distances of its matches from their epipolar curves."""

    def __init__(self, first_sigma_px: float, sigmas: float) -> None:
        """`first_sigma_px`: scatter before any match was seen. `sigmas`: limit."""
        self._plane: F64 = np.zeros(3)  # px: distance at the image's corner, and its change over width and height
        self._variance = first_sigma_px**2
        self._matches = 0.0  # by which the plane was learned
        self._sigmas = sigmas

    def forget(self) -> None:
        """Another rig: the plane is a new one."""
        self._plane, self._matches = np.zeros(3), 0.0

    def passed(self, rig: Rig, uv_left: F64, uv_right: F64, candidates: Bool, learns: bool = True) -> Bool:
        """(N,) which of the candidates (N,) are near their curves.

        Args:
            uv_left, uv_right: (N, 2) px. candidates: matches that passed all other tests.
            learns: from these matches first; else they are coarser, and the limit is twice as wide.
        """
        out = np.zeros(len(candidates), bool)
        rows = np.flatnonzero(candidates)
        if len(rows) == 0:
            return out
        assert rig.right is not None
        bearings = rig.left.unproject(uv_left[rows]), rig.right.unproject(uv_right[rows])
        with np.errstate(invalid="ignore"):
            signed = rig.left.fx * epipolar_angle(*bearings, rig.left_T_right)
        rows, signed = rows[np.isfinite(signed)], signed[np.isfinite(signed)]
        if len(rows) == 0:
            return out
        shape = np.column_stack([np.ones(len(rows)), uv_left[rows] / [rig.left.width, rig.left.height]])
        if learns:
            self._learn(shape, signed)
        limit = (1.0 if learns else 2.0) * self._sigmas * np.sqrt(self._variance)
        out[rows] = np.abs(signed - shape @ self._plane) < limit
        return out

    def _learn(self, shape: F64, signed: F64) -> None:
        """The plane by least squares with Cauchy weights around what was learned before, then the scatter."""
        held = self._matches * _EVENLY
        plane = self._plane if self._matches >= FIRST else np.array([np.median(signed), 0.0, 0.0])
        for _ in range(5):
            weight = 1 / (1 + (signed - shape @ plane) ** 2 / self._variance)
            normal = held + shape.T @ (shape * weight[:, None]) + 1e-9 * np.eye(3)
            plane = np.asarray(np.linalg.solve(normal, held @ self._plane + shape.T @ (weight * signed)), float)
        self._plane = plane
        scatter = percentile(np.abs(signed - shape @ plane), PERCENTILE) / ITS_SIGMAS
        before = max(self._matches, FIRST)
        self._variance = (before * self._variance + len(signed) * scatter**2) / (before + len(signed))
        self._matches = min(self._matches + len(signed), LEARNED)


# (3, 3) information about the plane by a match, if matches are spread evenly over the image.
_EVENLY = np.array([[1, 1 / 2, 1 / 2], [1 / 2, 1 / 3, 1 / 4], [1 / 2, 1 / 4, 1 / 3]])
