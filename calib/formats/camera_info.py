"""The common part of ROS CameraInfo and Foxglove CameraCalibration: K D R P of a camera, extrinsics from R and P.

R rotates into the rectified camera and P projects from there; the right camera's P[0, 3] is -fx * baseline. Two
messages thus hold the whole rig: left_R_right = R1' R2 and the baseline along the rectified x axis.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereo_sfm.calib.formats.common import brown, exact_rotation, numbers, padded, unsupported
from stereo_sfm.calib.rig import Rig
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Camera, KannalaBrandt
from stereo_sfm.geometry.stereo import rectifying_rotations
from stereo_sfm.types import F64

_FISHEYE = ("equidistant", "fisheye", "kannala_brandt")
_BROWN = ("plumb_bob", "rational_polynomial", "")


@dataclass(frozen=True, eq=False)
class CameraInfo:
    """One camera. K, R (3, 3), P (3, 4)."""

    width: int
    height: int
    distortion_model: str
    coefficients: tuple[float, ...]
    k: F64
    r: F64
    p: F64

    def camera(self) -> Camera:
        """The camera model.

        Raises:
            ValueError: unsupported model, or a message of an uncalibrated camera (K is zero).
        """
        k = self.k
        if k[0, 0] <= 0 or k[1, 1] <= 0:
            raise ValueError("K is zero: the camera is not calibrated")
        if self.distortion_model in _FISHEYE:
            coefficients = tuple(numbers(self.coefficients, 4))
            return KannalaBrandt(self.width, self.height, k[0, 0], k[1, 1], k[0, 2], k[1, 2], coefficients)
        if self.distortion_model in _BROWN:
            return brown((self.width, self.height), (k[0, 0], k[1, 1]), (k[0, 2], k[1, 2]), self.coefficients)
        raise ValueError(f"distortion model '{self.distortion_model}' is not supported")


def rig_from_infos(left: CameraInfo, right: CameraInfo | None, name: str = "") -> Rig:
    """The rig of one or two messages."""
    if right is None:
        return Rig(left.camera(), name=name)
    baseline = left.p[0, 3] / left.p[0, 0] - right.p[0, 3] / right.p[0, 0] if left.p[0, 0] and right.p[0, 0] else 0.0
    if abs(baseline) < 1e-9:
        raise ValueError("the right camera's P has no Tx = -fx * baseline: the extrinsics are missing")
    transform = np.eye(4)
    transform[:3, :3] = left.r.T @ right.r
    transform[:3, 3] = left.r.T @ np.array([baseline, 0.0, 0.0])
    return Rig(left.camera(), right.camera(), exact_rotation(transform), name=name)


def infos_from_rig(rig: Rig, fisheye_name: str) -> list[CameraInfo]:
    """One or two messages; `fisheye_name` is the format's name of Kannala-Brandt.

    P has the left camera's focal length and the image centre: an arbitrary choice for consumers that rectify with it.
    """
    if rig.right is None:
        return [_info(rig.left, np.eye(3), np.column_stack([rig.left.matrix, np.zeros(3)]), fisheye_name)]
    rect_R_left, rect_R_right = rectifying_rotations(rig.left_T_right)
    focal = float(rig.left.fx)
    same = rig.left.model == rig.right.model == "pinhole" and np.allclose(rect_R_left, np.eye(3), atol=1e-12)
    left = rig.left
    k = (
        left.matrix
        if same
        else np.array([[focal, 0, left.width / 2 - 0.5], [0, focal, left.height / 2 - 0.5], [0, 0, 1]])
    )
    p_left = np.column_stack([k, np.zeros(3)])
    p_right = np.column_stack([k, [-focal * rig.baseline, 0.0, 0.0]])
    return [_info(left, rect_R_left, p_left, fisheye_name), _info(rig.right, rect_R_right, p_right, fisheye_name)]


def _info(camera: Camera, r: F64, p: F64, fisheye_name: str) -> CameraInfo:
    if camera.model == "kannala_brandt":
        model, count = fisheye_name, 4
    elif camera.model in ("pinhole", "radtan"):
        model, count = ("plumb_bob", 5) if len(camera.distortion) <= 5 else ("rational_polynomial", 8)
    else:
        raise unsupported(camera, "camera info")
    return CameraInfo(camera.width, camera.height, model, tuple(padded(camera, count)), camera.matrix, r, p)


def info_rows(info: CameraInfo) -> dict[str, list[float]]:
    """K D R P as flat row-major lists."""
    arrays = {"K": info.k, "D": np.array(info.coefficients), "R": info.r, "P": info.p}
    return {key: [float(v) for v in a.ravel()] for key, a in arrays.items()}


def info_from_rows(width: int, height: int, model: str, k: object, d: object, r: object, p: object) -> CameraInfo:
    """From flat row-major lists; an empty R is the identity, an empty P is [K 0]."""
    matrix = np.array(numbers(k, 9)).reshape(3, 3)
    rotation = np.array(numbers(r or np.eye(3), 9)).reshape(3, 3)
    projection = np.array(numbers(p or np.column_stack([matrix, np.zeros(3)]), 12)).reshape(3, 4)
    transform = exact_rotation(se3.from_rotation_translation(rotation if rotation.any() else np.eye(3), np.zeros(3)))
    return CameraInfo(int(width), int(height), model or "", tuple(numbers(d)), matrix, transform[:3, :3], projection)


def check_pair(infos: list[CameraInfo], what: str) -> tuple[CameraInfo, CameraInfo | None]:
    """One or two messages in order left, right."""
    if not 1 <= len(infos) <= 2:
        raise StereoSfmError(f"{what} has {len(infos)} cameras: expected one or two")
    return infos[0], infos[1] if len(infos) == 2 else None
