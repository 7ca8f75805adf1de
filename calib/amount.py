"""The effect of a correction of rotations, focal lengths and lenses on pixels, over the places where points matched.

The lens displacements of both cameras are mapped into the right image (at infinity, where the cameras differ by a
rotation) and fitted by a rotation and a magnification; what neither explains is ignored.
"""

from __future__ import annotations

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.calib.scene_model import FOCAL, FOCAL_RIGHT, NUISANCE, ROTATION, SHARED, displacement
from stereo_sfm.calib.tracks import Window
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Camera
from stereo_sfm.types import F64

TURN, FOCAL_RATIO, FOCAL_BOTH = slice(0, 3), 3, 4


def amounts(rig: Rig, windows: list[Window]) -> F64:
    """(5, SHARED) maps a correction's vector to the rotation (3), the ratio of focal lengths, and their scale."""
    assert rig.right is not None
    left = np.concatenate([w.left[0] for w in windows])
    right = np.concatenate([w.right[0] for w in windows])
    in_left, in_right = rig.left.unproject(left), rig.right.unproject(right)
    seen = np.isfinite(in_left).all(1) & np.isfinite(in_right).all(1)
    left, right, in_left, in_right = left[seen], right[seen], in_left[seen], in_right[seen]
    out = np.zeros((5, SHARED))
    out[TURN, ROTATION] = np.eye(3)
    out[FOCAL_RATIO, FOCAL_RIGHT] = out[FOCAL_BOTH, FOCAL] = 1.0
    out[FOCAL_BOTH, FOCAL_RIGHT] = 0.5
    by_left, jac_left = _turn_and_scale(rig.left, in_left)
    by_right, jac_right = _turn_and_scale(rig.right, in_right)
    # A pixel of the left image -> its bearing -> a pixel of the right image.
    back = np.swapaxes(jac_left, 1, 2) @ np.linalg.inv(jac_left @ np.swapaxes(jac_left, 1, 2))
    across = jac_right @ rig.left_T_right[:3, :3].T @ back
    lens_left, lens_right = displacement(rig.left, left), displacement(rig.right, right)
    of_left, of_right = slice(8, 8 + NUISANCE), slice(8 + NUISANCE, SHARED)
    out[:4, of_left] = -_fitted(by_right, across @ lens_left)
    out[:4, of_right] = _fitted(by_right, lens_right)
    out[FOCAL_BOTH, of_left] = 0.5 * _fitted(by_left, lens_left)[3]
    out[FOCAL_BOTH, of_right] = 0.5 * _fitted(by_right, lens_right)[3]
    return out


def _turn_and_scale(camera: Camera, bearing: F64) -> tuple[F64, F64]:
    """(N, 2, 4) derivative of pixels by the camera's rotation and focal length, and (N, 2, 3) by the bearing."""
    uv, jac = camera.project_jacobian(bearing)
    scale = (uv - [camera.cx, camera.cy])[..., None]
    return np.concatenate([jac @ se3.skew(bearing), scale], -1), jac


def _fitted(by: F64, shapes: F64) -> F64:
    """(4, K) least-squares rotation and magnification of K displacement fields (N, 2, K)."""
    return np.asarray(np.linalg.lstsq(by.reshape(-1, 4), shapes.reshape(-1, shapes.shape[2]), rcond=None)[0], float)
