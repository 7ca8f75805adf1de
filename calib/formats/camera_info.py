"""ROS CameraInfo and Foxglove CameraCalibration of messages and files: K D R P of a camera, extrinsics from R and P.

R rotates into the rectified camera and P projects from there; the right camera's P[0, 3] is -fx * baseline. Two
messages thus hold the whole rig: left_R_right = R1' R2 and the baseline along the rectified x axis.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from stereo_sfm.calib.formats.common import brown, exact_rotation, padded, unsupported
from stereo_sfm.calib.lens_doubts import believable
from stereo_sfm.calib.rig import Rig
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Camera, KannalaBrandt, Pinhole
from stereo_sfm.geometry.stereo import rectifying_rotations
from stereo_sfm.types import F64

# Names of lens models in the wild, in lower case.
_FISHEYE = ("equidistant", "fisheye", "kannala_brandt", "kannala_brandt4")
_BROWN = ("plumb_bob", "rational_polynomial", "radtan", "radial-tangential", "brown_conrady", "none", "pinhole", "")


@dataclass(frozen=True, eq=False)
class CameraInfo:
    """One camera as a message or file states it, not checked. K, R (3, 3), P (3, 4); zeros where it states none."""

    width: int
    height: int
    distortion_model: str
    coefficients: tuple[float, ...]
    k: F64
    r: F64
    p: F64
    frame: str = ""

    def checked(self) -> CameraInfo:
        """The same with a rotation for R, the identity where there is none.

        Raises:
            ValueError: a number that is not finite, or R is no rotation.
        """
        for name, values in (("K", self.k), ("D", self.coefficients), ("R", self.r), ("P", self.p)):
            if not np.isfinite(values).all():
                raise ValueError(f"{name} is not finite")
        if self.p.any() and not (self.p[0, 0] > 0 and self.p[1, 1] > 0):
            raise ValueError("P has no focal length")
        try:
            turn = exact_rotation(se3.from_rotation_translation(self.r if self.r.any() else np.eye(3), np.zeros(3)))
        except ValueError:
            raise ValueError("R is no rotation") from None
        return replace(self, r=turn[:3, :3])

    def camera(self, rectified: bool = False) -> Camera:
        """The lens that is stated; of `rectified` images the pinhole of P.

        Raises:
            ValueError: an unsupported model, an uncalibrated camera (K is zero), or impossible numbers.
        """
        info = self.checked()
        size, k, model = (info.width, info.height), info.k, info.distortion_model.lower()
        if rectified and info.p.any():
            return Pinhole(*size, info.p[0, 0], info.p[1, 1], info.p[0, 2], info.p[1, 2])
        if k[0, 0] <= 0 or k[1, 1] <= 0:
            raise ValueError("K is zero: the camera is not calibrated")
        if model in _FISHEYE:
            d = [*info.coefficients, 0.0, 0.0, 0.0, 0.0]
            if any(d[4:]):
                raise ValueError(f"D has {len(info.coefficients)} coefficients, a fisheye four")
            return KannalaBrandt(*size, k[0, 0], k[1, 1], k[0, 2], k[1, 2], tuple(d[:4]))
        if model in _BROWN:
            return brown(size, (k[0, 0], k[1, 1]), (k[0, 2], k[1, 2]), info.coefficients)
        known = ", ".join(name for name in (*_BROWN, *_FISHEYE) if name)
        raise ValueError(f"distortion model '{info.distortion_model}' is not supported (supported: {known})")

    def offset(self) -> F64:
        """(3,) metres: the rectified camera's points are those of the pair's reference plus this."""
        p = self.p
        return np.array([p[0, 3] / p[0, 0], p[1, 3] / p[1, 1], p[2, 3]]) if p.any() else np.zeros(3)


def extrinsics(left: CameraInfo, right: CameraInfo, rectified: bool = False) -> F64 | None:
    """left_T_right (4, 4) of two cameras from R and P, None where P has no baseline; images as seen, or `rectified`.

    Raises:
        ValueError: R or P is damaged.
    """
    left, right = left.checked(), right.checked()
    baseline = left.offset() - right.offset()
    if np.linalg.norm(baseline) < 1e-9:
        return None
    if rectified:
        return se3.from_rotation_translation(np.eye(3), baseline)
    return exact_rotation(se3.from_rotation_translation(left.r.T @ right.r, left.r.T @ baseline))


def rig_from_infos(
    left: CameraInfo, right: CameraInfo | None, name: str = "", lens: str = "", unit: float = 1.0
) -> Rig:
    """The rig of one or two cameras; `lens` replaces the model's name, `unit` is the length of P's in metres.

    Raises:
        ValueError: damaged, or without a baseline.
    """
    infos = [info if not lens else replace(info, distortion_model=lens) for info in (left, right) if info is not None]
    cameras = [info.camera() for info in infos]
    if not lens:
        cameras = believable(cameras, name)
    if right is None:
        return Rig(cameras[0], name=name)
    transform = extrinsics(left, right)
    if transform is None:
        raise ValueError("the right camera's P has no Tx = -fx * baseline: the extrinsics are missing")
    transform[:3, 3] *= unit
    return Rig(cameras[0], cameras[1], transform, name=name)


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
    elif camera.model in ("pinhole", "radtan", "tilted"):
        model, count = ("plumb_bob", 5) if len(camera.distortion) <= 5 else ("rational_polynomial", 8)
        count = 14 if camera.model == "tilted" else count
    else:
        raise unsupported(camera, "camera info")
    return CameraInfo(camera.width, camera.height, model, tuple(padded(camera, count)), camera.matrix, r, p)


def info_rows(info: CameraInfo) -> dict[str, list[float]]:
    """K D R P as flat row-major lists."""
    arrays = {"K": info.k, "D": np.array(info.coefficients), "R": info.r, "P": info.p}
    return {key: [float(v) for v in a.ravel()] for key, a in arrays.items()}


def info_from_rows(
    width: int, height: int, model: str | None, k: object, d: object, r: object, p: object, frame: str = ""
) -> CameraInfo:
    """From flat row-major lists, which may be empty.

    Raises:
        ValueError: a list of another length.
    """
    matrix, turn, projection = (
        _rows(name, values, shape) for name, values, shape in (("K", k, (3, 3)), ("R", r, (3, 3)), ("P", p, (3, 4)))
    )
    coefficients = tuple(float(v) for v in np.asarray([] if d is None else d, float).ravel())
    return CameraInfo(int(width), int(height), model or "", coefficients, matrix, turn, projection, frame)


def _rows(name: str, values: object, shape: tuple[int, int]) -> F64:
    flat = np.asarray([] if values is None else values, float).ravel()
    if len(flat) not in (0, shape[0] * shape[1]):
        raise ValueError(f"{name} has {len(flat)} numbers instead of {shape[0] * shape[1]}")
    return flat.reshape(shape).copy() if len(flat) else np.zeros(shape)


def check_pair(infos: list[CameraInfo], what: str) -> tuple[CameraInfo, CameraInfo | None]:
    """One or two messages in order left, right."""
    if not 1 <= len(infos) <= 2:
        raise StereoSfmError(f"{what} has {len(infos)} cameras: expected one or two")
    return infos[0], infos[1] if len(infos) == 2 else None
