"""Motion by the wheels since the last pose from images."""

from __future__ import annotations

import math

import numpy as np

from stereo_sfm.calib.wheel import Wheel
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.twist_integration import TwistMotion, integrate_twists
from stereo_sfm.tracking.inertial.agreement import SensorUse
from stereo_sfm.tracking.inertial.dead_reckoning import WheelStep
from stereo_sfm.tracking.inertial.rest import STILL_NS
from stereo_sfm.tracking.inertial.series import Intervals, Series
from stereo_sfm.tracking.inertial.wheel_window import WheelCorrection, WheelWindow
from stereo_sfm.types import F64, MotionLink, WheelSamples

MAX_GAP_S = 0.25  # between samples: longer ones are not bridged
LINK_NS = 500_000_000  # of the comparison with the images
STILL = 1e-3  # m/s, rad/s of a robot at rest
ACCELERATION = np.array([3.0, 5.0])  # m/s^2, rad/s^2: wheels that change faster slip or are broken


class WheelMotion:
    """Integrates the samples of every image; corrected by the poses from images."""

    def __init__(self, wheel: Wheel) -> None:
        self._wheel, self._wheel_T_left = wheel, se3.inverse(wheel.left_T_wheel)
        self._series = Series(MAX_GAP_S)
        self._window = WheelWindow(wheel.model, wheel.slip)
        self._known: WheelCorrection | None = None  # what the window says, once asked for
        self._last_ns = self._link_ns = 0
        self._odom_T_last: F64 = np.eye(4)  # poses of the wheels
        self._odom_T_link: F64 = np.eye(4)
        self._last_step: tuple[float, F64] | None = None  # seconds and tangent (6,), camera axes
        self._raw_of: tuple[int, int, F64 | None] = (0, 0, None)  # an interval, and the motion in it
        self._begun = self._fed = False
        self._slips = 0.0  # share of the way that is in doubt in a turn

    @property
    def _correction(self) -> WheelCorrection:
        if self._known is None:
            self._known = self._window.correction()
        return self._known

    @property
    def wheel(self) -> Wheel:
        """As the calibration has it."""
        return self._wheel

    @property
    def left_out(self) -> bool:
        """Whether they contradict the images."""
        return self._window.left_out

    @property
    def news(self) -> str:
        """Why they do not count, beginning with a word for each reason; "" if they do, or may yet."""
        if not self.left_out:
            return ""
        return (
            "wheels_contradict_images: they measure nothing where the camera moves"
            if self._window.silent
            else "wheels_contradict_images: another motion ('stereo-sfm calibrate SOURCE --wheel' finds radii and pose)"
        )

    @property
    def use(self) -> SensorUse:
        """Whether they count: the images have shown that they measure the robot's motion."""
        if self.left_out:
            return SensorUse.CONTRADICTS
        return SensorUse.USED if self._window.agreed else SensorUse.UNKNOWN if self._fed else SensorUse.MISSING

    def feed(self, samples: WheelSamples | None) -> None:
        """Samples up to the image that is tracked next."""
        self._raw_of = 0, 0, None
        if samples is None or not len(samples):
            return
        self._fed = True
        stamps = samples.stamp_ns - round(self._wheel.offset_s * 1e9)
        values = np.hstack(self._wheel.velocities(samples))
        if not np.isfinite(values).all():
            values[:, 3:] = np.where(np.isfinite(values[:, 3:]), values[:, 3:], 0.0)  # of a sensor that tells the way
            known = np.isfinite(values).all(axis=1)
            stamps, values = stamps[known], values[known]
        rows = self._series.after_last(stamps)
        self._series.add(stamps[rows], values[rows])

    def begin(self, stamp_ns: int, odom_T_cam: F64) -> None:
        """The odometry begins anew here: poses from before do not go with those to come."""
        self._begun, self._last_step = True, None
        self._known = self._correction
        self._window.begin()
        self._last_ns = self._link_ns = stamp_ns
        self._odom_T_last = self._odom_T_link = odom_T_cam @ self._wheel.left_T_wheel

    def accept(self, stamp_ns: int, odom_T_cam: F64) -> None:
        """The images gave this pose (4, 4)."""
        if not self._begun:
            self.begin(stamp_ns, odom_T_cam)
            return
        step = self._raw(self._last_ns, stamp_ns)
        self._last_step = None if step is None else ((stamp_ns - self._last_ns) * 1e-9, self._in_camera(step))
        self._last_ns, self._odom_T_last = stamp_ns, odom_T_cam @ self._wheel.left_T_wheel
        if stamp_ns - self._link_ns < LINK_NS:
            return
        by_wheels = self._raw(self._link_ns, stamp_ns)
        if by_wheels is not None and stamp_ns - self._link_ns < 2 * LINK_NS:
            seen = se3.inverse(self._odom_T_link) @ self._odom_T_last
            self._window.add((stamp_ns - self._link_ns) * 1e-9, by_wheels, seen)
            self._known = None
        self._link_ns, self._odom_T_link = stamp_ns, self._odom_T_last
        self._series.forget(stamp_ns)

    def still(self, stamp_ns: int) -> bool | None:
        """Whether no wheel turned in the last half second; None where samples are missing, or they are wrong."""
        edges = None if self.left_out else self._series.edges(stamp_ns - STILL_NS, stamp_ns)
        return None if edges is None else bool(np.abs(self._series.means(edges)).max() < STILL)

    def changed(self, stamp_ns: int, step: F64) -> F64:
        """The expected step (6,) since the last pose, camera axes, with the wheels' change of speed added."""
        motion = self._raw(self._last_ns, stamp_ns) if self._window.agreed else None
        if motion is None or self._last_step is None:
            return step
        seconds = (stamp_ns - self._last_ns) * 1e-9
        change = self._in_camera(motion) - self._last_step[1] * (seconds / self._last_step[0])
        for part, limit in zip((change[:3], change[3:]), ACCELERATION * seconds**2, strict=True):
            part *= min(1.0, limit / max(math.sqrt(float(part @ part)), 1e-12))
        return step + change

    @property
    def lasting(self) -> F64:
        """(4, 4) covariance of what is not known of the logarithmic scale and the direction (3,)."""
        return self._correction.covariance

    def step(self, turning: Intervals, left_R_imu: F64) -> WheelStep | None:
        """The way over some time, turned as the gyroscope says; None where samples are missing or wrong.

        Where the wheels turn otherwise than the gyroscope they slip, and their way is in doubt.
        """
        edges, c = turning.edges_ns, self._correction
        if not self._window.agreed or self._series.edges(int(edges[0]), int(edges[-1])) is None:
            return None
        seconds, values = turning.seconds, self._series.means(edges)
        rates = turning.gyro @ (self._wheel.left_T_wheel[:3, :3].T @ left_R_imu).T
        motion = integrate_twists(seconds, rates, values[:, :3] @ c.matrix.T, 0.0, c.noise)
        by_wheels, turned = float(values[:, 5] @ seconds), float(rates[:, 2] @ seconds)
        doubt = self._window.doubt(motion.seconds, by_wheels, turned)
        self._slips = max(self._slips, doubt) if doubt else 0.0  # a slip that was seen in a turn may last to its end
        return WheelStep(motion.position, float(np.hypot(c.noise * np.sqrt(motion.seconds), self._slips * motion.way)))

    def predict(self, stamp_ns: int) -> tuple[F64, F64] | None:
        """Pose (4, 4) odom_T_cam at a time after the last one, and its covariance (6, 6) as that of a `Frame`.

        None where samples are missing, or the wheels do not count.
        """
        link = self.link(self._last_ns, stamp_ns) if self._begun else None
        if link is None:
            return None
        left_T_wheel = self._wheel.left_T_wheel
        return self._odom_T_last @ se3.inverse(left_T_wheel) @ link.last_T_cam, link.covariance

    def link(self, begin_ns: int, stamp_ns: int) -> MotionLink | None:
        """The camera's motion from one time to another; None where samples are missing, or the wheels do not count."""
        edges = self._series.edges(begin_ns, stamp_ns) if self._window.agreed else None
        if edges is None:
            return None
        c, values = self._correction, self._series.means(edges)
        motion = integrate_twists(
            np.diff(edges) * 1e-9, values[:, 3:] * c.turn, values[:, :3] @ c.matrix.T, c.turn_noise, c.noise
        )
        moved = se3.from_rotation_translation(motion.rotation, motion.position)
        covariance = self._covariance(motion)
        end_R_begin = np.kron(np.eye(2), motion.rotation.T)
        end_R_begin[3:, 3:] = np.eye(3)
        left_T_wheel = self._wheel.left_T_wheel
        into = se3.adjoint(left_T_wheel) @ end_R_begin
        return MotionLink(left_T_wheel @ moved @ se3.inverse(left_T_wheel), into @ covariance @ into.T)

    def _covariance(self, motion: TwistMotion) -> F64:
        """(6, 6) of position (axes at the beginning) and rotation (right tangent)."""
        c, p = self._correction, motion.position
        lasting = np.column_stack([p, -se3.skew(p)])
        out = motion.covariance.copy()
        out[:3, :3] += lasting @ c.covariance @ lasting.T
        by_rate = np.vstack([motion.position_by_rate, motion.rotation_by_rate])
        turned = float(np.linalg.norm(se3.so3_log(motion.rotation)))
        rate_sigma = c.turn_sigma * turned / motion.seconds
        sway = c.heading_sigma**2
        out[:3, :3] += sway * lasting[:, 1:] @ lasting[:, 1:].T
        out[3:, 3:] += sway * np.eye(3)
        return out + rate_sigma**2 * by_rate @ by_rate.T

    def _raw(self, begin_ns: int, end_ns: int) -> F64 | None:
        """(4, 4) motion by the uncorrected wheels; the last one is asked for several times a frame."""
        if self._raw_of[:2] != (begin_ns, end_ns):
            edges, motion = self._series.edges(begin_ns, end_ns), None
            if edges is not None:
                values = self._series.means(edges)
                found = integrate_twists(np.diff(edges) * 1e-9, values[:, 3:], values[:, :3], 0.0, 0.0)
                motion = se3.from_rotation_translation(found.rotation, found.position)
            self._raw_of = begin_ns, end_ns, motion
        return self._raw_of[2]

    def _in_camera(self, motion: F64) -> F64:
        """(6,) tangent of a motion of the wheels (4, 4) as one of the camera."""
        return np.asarray(se3.log(self._wheel.left_T_wheel @ motion @ self._wheel_T_left))
