"""Test whether stereo matches lie on their epipolar curves, also with an error of the calibration.

An error of the calibration shifts all matches off their curves by a distance that varies slowly over the image. If most
matches would be rejected, a plane is fitted to the distances, and matches near it are kept, so that self-calibration
has points to work with. Single wrong matches fit no plane.
"""

from __future__ import annotations

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.geometry.stereo import epipolar_angle
from stereo_sfm.types import F64, Bool

MIN_MATCHES = 20
MIN_SHARE = 0.5  # of the matches that must be near the curves, or near the plane
MAX_OFFSET = 4.0  # of the plane, in units of the usual limit


def on_curve(rig: Rig, uv_left: F64, uv_right: F64, distance_px: F64, usual_px: float, candidates: Bool) -> Bool:
    """(N,) accepted matches.

    Args:
        uv_left, uv_right: (N, 2) px. distance_px: (N,) from the epipolar curve, unsigned.
        usual_px: limit. candidates: (N,) matches that passed all other tests.
    """
    with np.errstate(invalid="ignore"):
        near = distance_px < usual_px
    if not np.isfinite(usual_px) or np.count_nonzero(candidates) < MIN_MATCHES or near[candidates].mean() >= MIN_SHARE:
        return near
    assert rig.right is not None
    signed = np.full(len(near), np.nan)
    bearings = rig.left.unproject(uv_left[candidates]), rig.right.unproject(uv_right[candidates])
    signed[candidates] = rig.left.fx * epipolar_angle(*bearings, rig.left_T_right)
    shape = np.column_stack([np.ones(len(near)), uv_left / [rig.left.width, rig.left.height]])
    plane = shape @ _fit(shape[candidates], signed[candidates], usual_px)
    with np.errstate(invalid="ignore"):
        fitted = (np.abs(signed - plane) < usual_px) & (np.abs(plane) < MAX_OFFSET * usual_px)
    return fitted if fitted[candidates].mean() > MIN_SHARE else near


def _fit(shape: F64, values: F64, scale: float) -> F64:
    """(3,) by least squares with Cauchy weights."""
    seen = np.isfinite(values)
    shape, values = shape[seen], values[seen]
    coefficients = np.array([np.median(values), 0.0, 0.0]) if len(values) else np.zeros(3)
    for _ in range(5):
        weight = 1 / (1 + ((values - shape @ coefficients) / scale) ** 2)
        normal = shape.T @ (shape * weight[:, None]) + 1e-9 * np.eye(3)
        coefficients = np.asarray(np.linalg.solve(normal, shape.T @ (weight * values)), float)
    return coefficients
