"""`Rig`: the calibration type of the project; every file format is read into it and written from it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from stereo_sfm.calib.imu import Imu
from stereo_sfm.calib.wheel import Wheel
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Camera
from stereo_sfm.types import F64, Bool, ReadOnly

BASELINE_RANGE_M = 1e-4, 10.0
MAX_SKEW = 1e-4  # of a rotation: largest deviation of its product with its transpose from the identity
MAX_PIXELS = 10**8
MAX_FOCAL = 100  # of the larger side of the image: of telescopes
MAX_READOUT_S = 0.2
SMALLEST_SHARE = 0.05  # of an image's pixels, that a mask must leave
MAX_DISTORTION = 1e6  # rational models of real lenses have some hundred


_FORWARD = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])  # optical axes seen by the robot
_FORWARD.flags.writeable = False


@dataclass(frozen=True, eq=False)
class Rig(ReadOnly):
    """One camera, or a stereo pair.

    `left_T_right` maps points of the right camera to the left one: its translation is the position of the right camera
    in the left one, (+baseline, 0, 0) for an ideal pair. `right` is None for a monocular camera. An RGB-D camera has
    `right` equal to `left` with a virtual baseline, and its images have `depth`.
    """

    left: Camera  # the reference of all poses
    right: Camera | None = None  # None: one camera
    left_T_right: F64 = field(default_factory=lambda: np.eye(4))  # (4, 4), metres
    body_T_left: F64 = field(default_factory=lambda: np.eye(4))  # (4, 4), metres: where the camera is on the robot
    depth: bool = False  # RGB-D: the right camera is virtual, u_right = u_left - fx * baseline / depth
    name: str = ""  # readable
    serial: str = ""  # of the camera, "" where unknown
    imu: Imu | None = None  # calibration of its inertial sensor; None: inertial samples are not used
    wheel: Wheel | None = None  # calibration of its wheel odometry; None: wheel samples are not used
    left_mask: Bool | None = None  # (H, W) True where the image is used (stereo_sfm.calib.mask); None: everywhere
    right_mask: Bool | None = None  # (H, W)
    # Rolling shutter: seconds from the first row's exposure to the last's, negative if read from below; 0: global.
    readout_s: float = 0.0

    def __post_init__(self) -> None:
        for transform in (self.left_T_right, self.body_T_left):
            rotation = transform[:3, :3]
            if transform.shape != (4, 4) or not np.abs(rotation @ rotation.T - np.eye(3)).max() <= MAX_SKEW:
                raise StereoSfmError("invalid calibration: a transform is not rigid; check the extrinsics")
            transform.flags.writeable = False
            if not np.isfinite(transform).all():
                raise StereoSfmError("invalid calibration: a transform is not finite; check the extrinsics")
        for side, camera in (("left", self.left), ("right", self.right)):
            if camera is not None:
                _check_camera(side, camera)
        _check_mask("left", self.left_mask, self.left)
        _check_mask("right", self.right_mask, self.right)
        if not abs(self.readout_s) <= MAX_READOUT_S:
            raise StereoSfmError(
                f"invalid calibration: readout of {self.readout_s:g} s; give the seconds from first to last row, "
                "negative if rows are read from below, 0 for a global shutter"
            )
        with np.errstate(over="ignore"):
            baseline = self.baseline
        if self.right is not None and not BASELINE_RANGE_M[0] <= baseline <= BASELINE_RANGE_M[1]:
            raise StereoSfmError(
                f"invalid calibration: baseline of {baseline:g} m; give the extrinsics in metres "
                "('stereo-sfm convert-calib --unit mm' converts millimetres)"
            )

    @property
    def base_T_left(self) -> F64:
        """(4, 4) in the axes of robots (REP 103: x forward, y left, z up): the body's, or the left camera's own turned.

        The second where the calibration has no body.
        """
        return self.body_T_left if not np.allclose(self.body_T_left, np.eye(4)) else _FORWARD

    @property
    def stereo(self) -> bool:
        """Whether there are two cameras (or one with depth)."""
        return self.right is not None

    @property
    def second_camera(self) -> Camera | None:
        """The right camera; None where there is one camera, or one with depth, whose right camera is virtual."""
        return None if self.depth else self.right

    @property
    def masked_share(self) -> tuple[float, float]:
        """Share of the left and right image's pixels that are not used."""
        left, right = (0.0 if mask is None else 1.0 - float(mask.mean()) for mask in (self.left_mask, self.right_mask))
        return left, right

    @property
    def baseline(self) -> float:
        """Distance between the cameras in metres; 0 for one camera."""
        return float(np.linalg.norm(self.left_T_right[:3, 3])) if self.stereo else 0.0

    @property
    def pixel_angle(self) -> float:
        """Radians per pixel at the centre of the left image."""
        return 1.0 / (0.5 * (self.left.fx + self.left.fy))

    def project_right(self, points: F64) -> F64:
        """Points (N, 3) in the left camera -> pixels (N, 2) of the right one, NaN where it cannot see them.

        Raises:
            StereoSfmError: one camera.
        """
        if self.right is None:
            raise StereoSfmError("this rig has one camera: no right image")
        return self.right.project(se3.transform(se3.inverse(self.left_T_right), points))

    def range_sigmas(self, points: F64, disparity_sigma: float) -> F64:
        """Standard deviation (N,) in metres of the ranges of stereo points (N, 3) in the left camera.

        range^2 * angle of `disparity_sigma` pixels / baseline across the ray; NaN where a point is.
        """
        distance = np.linalg.norm(points, axis=1)
        (x, y, z), (tx, ty, tz) = points.T, self.left_T_right[:3, 3]
        twice_area = np.sqrt((y * tz - z * ty) ** 2 + (z * tx - x * tz) ** 2 + (x * ty - y * tx) ** 2)
        across = twice_area / np.maximum(distance, 1e-9)
        return distance**2 * disparity_sigma * self.pixel_angle / np.maximum(across, 1e-3 * self.baseline + 1e-12)

    @property
    def shutter(self) -> str:
        """The shutter as readable text."""
        if not self.readout_s:
            return "all rows at once"
        return f"rows read {'from below ' if self.readout_s < 0 else ''}within {1e3 * abs(self.readout_s):g} ms"

    def row_seconds(self, rows: F64) -> F64:
        """Seconds from an image's stamp, which is that of the middle row, to the exposure of other rows (pixels)."""
        return (rows / (self.left.height - 1) - 0.5) * self.readout_s


def _check_camera(side: str, camera: Camera) -> None:
    """Raises StereoSfmError for impossible intrinsics."""
    numbers = {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy}
    wrong = [f"{name} {value:g}" for name, value in numbers.items() if not np.isfinite(value)]
    wrong += [f"distortion {value:g}" for value in camera.distortion if not abs(value) <= MAX_DISTORTION]
    wrong += [camera.impossible()] if not wrong and camera.impossible() else []
    most = MAX_FOCAL * max(camera.width, camera.height)
    wrong += [f"{name} {numbers[name]:g}" for name in ("fx", "fy") if not 0 < numbers[name] <= most]
    wrong += [f"cx {camera.cx:g}"] if abs(camera.cx) > 2 * camera.width else []
    wrong += [f"cy {camera.cy:g}"] if abs(camera.cy) > 2 * camera.height else []
    if min(camera.width, camera.height) < 1 or camera.width * camera.height > MAX_PIXELS:
        wrong.append(f"size {camera.width}x{camera.height}")
    if wrong:
        raise StereoSfmError(f"invalid calibration of the {side} camera: {', '.join(wrong)}")


def _check_mask(side: str, mask: Bool | None, camera: Camera | None) -> None:
    """Raises StereoSfmError for a mask that is not of the camera's size or leaves nothing to see."""
    if mask is None:
        return
    if camera is None or mask.shape != (camera.height, camera.width):
        size = "there is no such camera" if camera is None else f"its images {camera.width}x{camera.height}"
        raise StereoSfmError(
            f"invalid calibration: the mask of the {side} camera is {mask.shape[1]}x{mask.shape[0]} px, {size}"
        )
    if mask.mean() < SMALLEST_SHARE:
        raise StereoSfmError(
            f"invalid calibration: the mask of the {side} camera leaves {100 * mask.mean():.1f} % of its image; "
            "black pixels are not used, all others are"
        )
    mask.flags.writeable = False
