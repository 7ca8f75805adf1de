"""The floor that a robot drives over: thresholds and ramps across its way, and how it stands on them.

Heights are smooth in the metres of the path (error functions), so that poses are smooth in time. They move the robot
only: the drawn floor stays flat.
"""

from __future__ import annotations

import numpy as np
from scipy.special import erf

from stereo_sfm.geometry import se3
from stereo_sfm.types import F64

SUPPORT_M = 0.36  # between the front and the rear contact of the robot with the floor
FREE_M = 2.0  # of the path at its start, flat
THRESHOLD_M, THRESHOLD_WIDTH_M, EDGE_M = (0.004, 0.010), (0.05, 0.12), 0.025  # height, width, roundness of an edge
RAMP_SLOPE, RAMP_M, RAMP_TOP_M, RAMP_ROUND_M = (0.03, 0.08), (0.8, 1.6), (1.0, 3.0), 0.15
SLOPES = 0.05, 0.2  # between which wheels that climb begin to slip


class Floor:
    """Height over the metres of the path."""

    def __init__(self, thresholds: int, ramps: int, way_m: float, rng: np.random.Generator) -> None:
        """So many of each, at random places of a path of `way_m` metres; a ramp leads up, and down again later."""
        places = np.sort(rng.uniform(min(FREE_M, way_m), way_m, thresholds))
        widths, heights = rng.uniform(*THRESHOLD_WIDTH_M, thresholds), rng.uniform(*THRESHOLD_M, thresholds)
        edges = [places, places + widths]
        rises, sharp = [heights, -heights], [np.full(thresholds, EDGE_M)] * 2
        begin, length = rng.uniform(min(FREE_M, way_m), way_m, ramps), rng.uniform(*RAMP_M, ramps)
        slope, top = rng.uniform(*RAMP_SLOPE, ramps), rng.uniform(*RAMP_TOP_M, ramps)
        self._steps = np.concatenate(edges), np.concatenate(rises), np.concatenate(sharp)
        bends = [begin, begin + length, begin + length + top, begin + 2 * length + top]
        self._bends = np.concatenate(bends), np.concatenate([slope, -slope, -slope, slope])

    def height(self, metres: F64) -> F64:
        """(N,) metres of the path -> (N,) metres above the start."""
        at, rise, width = self._steps
        steps = 0.5 * (1 + erf((metres[:, None] - at) / width)) @ rise
        at, change = self._bends
        x = (metres[:, None] - at) / RAMP_ROUND_M
        bends = RAMP_ROUND_M * 0.5 * (x * (1 + erf(x)) + np.exp(-x * x) / np.sqrt(np.pi)) @ change
        return np.asarray(steps + bends, float)

    def slope(self, metres: F64) -> F64:
        """(N,) metres of the path -> (N,) derivative of the height."""
        at, rise, width = self._steps
        steps = np.exp(-(((metres[:, None] - at) / width) ** 2)) @ (rise / width) / np.sqrt(np.pi)
        at, change = self._bends
        return np.asarray(steps + 0.5 * (1 + erf((metres[:, None] - at) / RAMP_ROUND_M)) @ change, float)

    def tilt(self, metres: F64) -> F64:
        """(N,) radians upwards of a robot that stands with its middle at the metres (N,)."""
        rise = self.height(metres + 0.5 * SUPPORT_M) - self.height(metres - 0.5 * SUPPORT_M)
        return np.arctan(rise / SUPPORT_M)

    def lift(self, metres: F64) -> F64:
        """(N,) metres by which the middle of the robot is above the start."""
        return 0.5 * (self.height(metres + 0.5 * SUPPORT_M) + self.height(metres - 0.5 * SUPPORT_M))

    def climb(self, metres: F64) -> F64:
        """(N,) derivative of `lift`."""
        return 0.5 * (self.slope(metres + 0.5 * SUPPORT_M) + self.slope(metres - 0.5 * SUPPORT_M))

    def standing(self, metres: F64, above_m: float) -> F64:
        """(N, 4, 4) from the robot on this floor to where it is on a flat one; origins `above_m` metres above it."""
        turn = se3.so3_exp(np.outer(self.tilt(metres), [0.0, -1.0, 0.0]))
        up = np.array([0.0, 0.0, above_m])
        return se3.from_rotation_translation(turn, turn @ up - up + np.outer(self.lift(metres), [0.0, 0.0, 1.0]))

    def slipping(self, metres: F64) -> F64:
        """(N,) share of their slip that wheels have, from 0 on a flat floor to 1 on a steep edge."""
        low, high = SLOPES
        return np.clip((np.abs(self.climb(metres)) - low) / (high - low), 0.0, 1.0)
