"""A rig as arguments of the compiled kernels."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.types import F64


class StereoCameras(NamedTuple):
    """Model ids and parameters of both cameras, and their relative pose (4, 4)."""

    model_l: int
    params_l: F64
    model_r: int
    params_r: F64
    left_T_right: F64
    right_T_left: F64
    depth: bool  # the right camera is virtual: only disparities are measured

    @staticmethod
    def of(rig: Rig) -> StereoCameras:
        """Raises StereoSfmError for a rig with one camera."""
        if rig.right is None:
            raise StereoSfmError(
                "the default tracker needs a stereo or RGB-D source (for one camera: --preset cpp-course)"
            )
        return StereoCameras.of_any(rig)

    @staticmethod
    def of_any(rig: Rig) -> StereoCameras:
        """With one camera, that twice."""
        left, right = rig.left, rig.right if rig.right is not None else rig.left
        right_T_left = np.ascontiguousarray(se3.inverse(rig.left_T_right))
        poses = np.ascontiguousarray(rig.left_T_right), right_T_left
        return StereoCameras(left.model_id, left.params, right.model_id, right.params, *poses, rig.depth)
