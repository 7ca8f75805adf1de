"""The simulated cameras: a T265-like fisheye pair and an OAK-like pinhole pair."""

from __future__ import annotations

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.errors import one_of
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Camera, KannalaBrandt, Pinhole, RadTan

# Factory values of one T265 (librealsense issue 3621): fx fy cx cy, k1..k4.
_T265 = (
    (286.2216, 287.4801, 419.4670, 386.9751, (-0.004348, 0.037126, -0.035539, 0.005773)),
    (285.2292, 286.3337, 422.0390, 397.0160, (-0.005279, 0.038634, -0.036636, 0.006108)),
)


def fisheye() -> Rig:
    """848 x 800, Kannala-Brandt, 64 mm, a small rotation between the cameras as in factory calibrations."""
    left, right = (KannalaBrandt(848, 800, fx, fy, cx, cy, k) for fx, fy, cx, cy, k in _T265)
    left_T_right = se3.exp(np.array([0.06394, 0.00021, -0.00034, 0.0021, -0.0034, 0.0016]))
    left_T_right[:3, 3] = 0.06394, 0.00021, -0.00034
    return Rig(left, right, left_T_right, name="sim fisheye", serial="sim-848x800")


def pinhole() -> Rig:
    """640 x 400, ideal pinholes, 75 mm, rectified."""
    camera = Pinhole(640, 400, 399.3, 399.3, 321.7, 203.4)
    left_T_right = np.eye(4)
    left_T_right[0, 3] = 0.075
    return Rig(camera, camera, left_T_right, name="sim pinhole", serial="sim-640x400")


def distorted() -> Rig:
    """640 x 400 with lens distortion of each camera, 75 mm, not rectified."""
    left = RadTan(640, 400, 401.2, 401.6, 318.9, 204.8, (-0.092, 0.061, 0.0004, -0.0007, -0.012))
    right = RadTan(640, 400, 400.4, 400.7, 322.3, 199.1, (-0.090, 0.058, -0.0003, 0.0005, -0.011))
    left_T_right = se3.exp(np.array([0.0, 0.0, 0.0, -0.0018, 0.0042, 0.0027]))
    left_T_right[:3, 3] = 0.07493, -0.00031, 0.00052
    return Rig(left, right, left_T_right, name="sim distorted", serial="sim-640x400-d")


CAMERAS = {"fisheye": fisheye, "pinhole": pinhole, "distorted": distorted}


def _scaled(camera: Camera, width: int, height: int) -> Camera:
    """The same lens on a sensor of fewer pixels; pixel centres at whole numbers."""
    a, b = width / camera.width, height / camera.height
    cx, cy = (camera.cx + 0.5) * a - 0.5, (camera.cy + 0.5) * b - 0.5
    return type(camera)(width, height, camera.fx * a, camera.fy * b, cx, cy, camera.distortion)


def make_rig(name: str, size: tuple[int, int] | None = None) -> Rig:
    """A rig by name, its images scaled to `size` (width, height).

    Raises:
        StereoSfmError: unknown name.
    """
    rig = CAMERAS[one_of(name, CAMERAS, "camera")]()
    if size is None:
        return rig
    right = _scaled(rig.right, *size) if rig.right is not None else None
    return Rig(_scaled(rig.left, *size), right, rig.left_T_right.copy(), name=rig.name, serial=rig.serial)
