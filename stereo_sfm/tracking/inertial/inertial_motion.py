"""Inertial prediction of the tracker: the next pose, and poses while the images give none."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from stereo_sfm.calib.imu import TURN_SHARE, Imu
from stereo_sfm.calib.wheel import Wheel
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.preintegration import GRAVITY, Preintegrated, preintegrate
from stereo_sfm.tracking.inertial.agreement import ForceAgreement, RateAgreement, SensorUse
from stereo_sfm.tracking.inertial.dead_reckoning import DeadReckoning
from stereo_sfm.tracking.inertial.inertial_filter import ROTATION_SIGMA, WRONG_CHI2, InertialFilter, InertialState
from stereo_sfm.tracking.inertial.rest import STILL_NS
from stereo_sfm.tracking.inertial.rotation_filter import JUDGED, RotationFilter
from stereo_sfm.tracking.inertial.series import Intervals, SampleBuffer
from stereo_sfm.types import F64, ImuSamples, InertialLink

NODE_NS = 200_000_000  # between the poses of the filter
MAX_TURN_ERROR = 0.1  # rad/s between gyroscope and images, root mean square: more is another sensor's data
MISSING_S = 10.0  # between a pose and the newest sample: more is another clock
LOOKED_AGAIN = 60  # intervals after which what is wrong is known better
MAX_GRAVITY_ERROR = 1.0  # m/s^2 of its size
STILL = np.array([0.005, 0.05])  # rad/s, m/s^2: spread of a sensor at rest ...
STILL_NOISE = 3.0  # ... and its own noise so many times
STILL_TURN = 0.03  # rad/s that the known bias may be off


class InertialMotion:
    """Integrates the samples of every image; corrected by the poses from images."""

    def __init__(self, imu: Imu) -> None:
        self._imu = imu
        self._buffer = SampleBuffer(imu)
        self._filter = InertialFilter(imu)
        self._rotation = RotationFilter()
        self._state: InertialState | None = None
        self._node_ns = self._last_ns = 0
        self._odom_T_node: F64 = np.eye(4)
        self._odom_T_last: F64 = np.eye(4)
        self._gyro_bias: F64 = np.zeros(3)
        self._begun = False
        self._integrated: dict[tuple[int, int], Preintegrated | None] = {}  # by interval, since the last samples
        self._rates, self._forces = RateAgreement(imu.gyro_bias_sigma), ForceAgreement(imu.accel_bias_sigma)
        self._agreed = SensorUse.UNKNOWN  # what the images have shown to be right
        self._node: _Node | None = None  # the motion that led to the newest pose of the filter
        self._silent = 0  # successive poses without samples around
        self._turn_errors: list[float] = []  # squared, rad/s
        self._moves_wrong: deque[bool] = deque(maxlen=JUDGED)
        self.left_out = ""  # why the sensor is not used
        self._why = ""  # in more words
        self._out = 0  # poses for which it has been left out

    @property
    def state(self) -> InertialState | None:
        """Velocity, gravity and biases at the newest pose of the filter; None while they are not known."""
        return self._state

    @property
    def use(self) -> SensorUse:
        """How far it counts."""
        if self.left_out:
            return SensorUse.CONTRADICTS
        if self._silent >= JUDGED:
            return SensorUse.MISSING
        return SensorUse.USED if self._state is not None else min(self._agreed, SensorUse.ROTATION)

    @property
    def news(self) -> str:
        """Why the sensor does not count, beginning with a word for each reason; "" if it does, or may yet."""
        if self.left_out:
            return f"{self.left_out}: {self._why}"
        return f"imu_missing: {self._missing}" if self.use == SensorUse.MISSING else ""

    @property
    def _missing(self) -> str:
        newest_ns = self._buffer.newest_ns
        if newest_ns is None:
            return "no samples came"
        away_s = abs(self._last_ns - newest_ns) * 1e-9
        if away_s > MISSING_S:
            return "its stamps have another clock than the images'"
        return "samples are missing (a warning of the source may say why)"

    @property
    def left_R_imu(self) -> F64:
        """(3, 3) as the calibration has it."""
        return self._imu.left_T_imu[:3, :3]

    def gravity(self, odom_T_cam: F64) -> tuple[F64, float] | None:
        """Its direction in the camera (4, 4), a unit vector (3,), and the standard deviation in radians about each
        horizontal axis; None while it is not known."""
        if self._state is None:
            return None
        down = odom_T_cam[:3, :3].T @ self._state.gravity
        return down / np.linalg.norm(down), self._state.tilt_sigma

    def feed(self, samples: ImuSamples | None) -> None:
        """Samples up to the image that is tracked next."""
        self._integrated.clear()
        if samples is not None and len(samples):
            self._buffer.add(samples)

    def begin(self, stamp_ns: int, odom_T_cam: F64) -> None:
        """The odometry begins anew here: poses from before do not go with those to come."""
        self._begun, self._state = True, None
        self._rates.begin()
        self._restart(stamp_ns, odom_T_cam @ self._imu.left_T_imu)

    def _restart(self, stamp_ns: int, odom_T_imu: F64) -> None:
        self._filter.begin(odom_T_imu)
        self._rotation.restart()
        self._node = None
        self._node_ns = self._last_ns = stamp_ns
        self._odom_T_node = self._odom_T_last = odom_T_imu

    def predict(self, stamp_ns: int, expected: F64) -> F64:
        """(4, 4) odom_T_cam at a time after the last pose: the rotation by the gyroscope once that agrees with the
        images, the translation too once velocity and gravity are known; `expected` (4, 4) otherwise."""
        motion = self.motion(self._last_ns, stamp_ns)
        if motion is None or self.use < SensorUse.ROTATION:
            return expected
        odom_R_imu = self._odom_T_last[:3, :3] @ motion.rotation
        if self._state is None:
            odom_R_cam = odom_R_imu @ self._imu.left_T_imu[:3, :3].T
            return se3.from_rotation_translation(odom_R_cam, expected[:3, 3])
        velocity, accel_bias = self._velocity(), self._state.accel_bias
        t = motion.seconds
        position = self._odom_T_last[:3, 3] + velocity * t + 0.5 * self._state.gravity * t * t
        position = position + self._odom_T_last[:3, :3] @ motion.position_with(self._gyro_bias, accel_bias)
        return se3.from_rotation_translation(odom_R_imu, position) @ se3.inverse(self._imu.left_T_imu)

    def fused(self, stamp_ns: int, seen: F64, covariance: F64) -> F64:
        """The pose (4, 4) that an image gave, with its covariance (6, 6), corrected by the rotation since the last."""
        motion = self.motion(self._last_ns, stamp_ns)
        if motion is None or self.use < SensorUse.ROTATION:
            self._rotation.restart()
            return seen
        cam_R_imu = self._imu.left_T_imu[:3, :3]
        predicted = self._odom_T_last[:3, :3] @ motion.rotation @ cam_R_imu.T
        turn = cam_R_imu @ motion.rotation @ cam_R_imu.T
        share = TURN_SHARE * float(np.linalg.norm(se3.so3_log(turn)))
        bias_sigma = self._filter.gyro_bias_sigma if self._state is None else self._state.gyro_bias_sigma
        common = (bias_sigma * motion.seconds) ** 2 + share**2
        noise = cam_R_imu @ motion.covariance[:3, :3] @ cam_R_imu.T + common * np.eye(3)
        return self._rotation.fused(predicted, turn, noise, seen, covariance)

    def accept(self, stamp_ns: int, odom_T_cam: F64, timed: bool = True) -> None:
        """The images gave this pose (4, 4). `timed`: the time since the last one is right."""
        odom_T_imu = odom_T_cam @ self._imu.left_T_imu
        if not self._begun:
            self.begin(stamp_ns, odom_T_cam)
            return
        if timed:
            self._compare(stamp_ns, odom_T_imu)
        else:
            self._rates.begin()
        self._last_ns, self._odom_T_last = stamp_ns, odom_T_imu
        if stamp_ns - self._node_ns < NODE_NS:
            return
        motion = self.motion(self._node_ns, stamp_ns)
        if motion is None:  # samples are missing
            self._state = None
            self._restart(stamp_ns, odom_T_imu)
            return
        self._moves_wrong.append(self._filter.add(motion, odom_T_imu) > WRONG_CHI2)
        node = _Node.of(motion, self._odom_T_node, odom_T_imu)
        if self._node is not None:
            self._forces.add(*node.since(self._node))
        self._node_ns, self._odom_T_node, self._node = stamp_ns, odom_T_imu, node
        self._buffer.forget(stamp_ns)
        self._state = self._filter.estimate() if self._agreed == SensorUse.USED else None
        self._gyro_bias = self._filter.gyro_bias() if self._state is None else self._state.gyro_bias
        self._integrated.clear()

    def bridge(self, stamp_ns: int) -> tuple[F64, F64] | None:
        """Pose (4, 4) odom_T_cam at a time after the last pose, and its covariance (6, 6); None if it is unknown."""
        covariance = None if self.left_out else self.covariance(stamp_ns)
        return None if covariance is None else (self.predict(stamp_ns, np.eye(4)), covariance)

    def covariance(self, stamp_ns: int) -> F64 | None:
        """(6, 6) of the predicted pose @ exp(xi), xi = (rho, phi) in camera axes; None where samples are missing."""
        motion = self.motion(self._last_ns, stamp_ns)
        if self._state is None or motion is None:
            return None
        t, odom_R_imu = motion.seconds, self._odom_T_last[:3, :3]
        by = np.hstack([t * np.eye(3), 0.5 * t * t * np.eye(3), odom_R_imu @ motion.position_by_accel])
        turn = (self._state.gyro_bias_sigma * t) ** 2 + self._imu.gyro_noise**2 * t
        tilted = turn * (GRAVITY * t * t / 6) ** 2  # a tilt that grows with time pushes with gravity's share
        noise = self._imu.accel_noise**2 * t**3 / 3 + tilted
        position = by @ self._state.covariance @ by.T + noise * np.eye(3)
        cam_R_odom = self._imu.left_T_imu[:3, :3] @ motion.rotation.T @ odom_R_imu.T
        out = np.zeros((6, 6))
        out[:3, :3], out[3:, 3:] = cam_R_odom @ position @ cam_R_odom.T, turn * np.eye(3)
        return out

    def still(self, stamp_ns: int) -> bool | None:
        """Whether the sensor was at rest for the last half second; None where samples are missing, or it is wrong."""
        found = None if self.left_out else self._buffer.between(stamp_ns - STILL_NS, stamp_ns)
        if found is None:
            return None
        noise = np.sqrt(self._imu.rate_hz) * np.array([self._imu.gyro_noise, self._imu.accel_noise])
        limits = STILL_NOISE * noise + STILL
        spreads = found.gyro.std(axis=0).max(), found.accel.std(axis=0).max()
        turned = float(np.abs(found.gyro.mean(axis=0) - self._gyro_bias).max())
        return bool(spreads[0] < limits[0] and spreads[1] < limits[1] and turned < STILL_TURN)

    def turning(self, begin_ns: int, end_ns: int) -> Intervals | None:
        """The gyroscope between two times, without its bias; None where samples are missing."""
        found = self._buffer.between(begin_ns, end_ns) if self.use >= SensorUse.ROTATION else None
        return None if found is None else replace(found, gyro=found.gyro - self._gyro_bias)

    def link(self, begin_ns: int, stamp_ns: int) -> InertialLink | None:
        """From the stamp of the keyframe before to that of a keyframe; None where the IMU does not count.

        The state is that of the newest pose, and not given where the keyframe has another.
        """
        if self._agreed != SensorUse.USED:
            return None
        found = self._buffer.between(begin_ns, stamp_ns) if stamp_ns > begin_ns else None
        edges, gyro, accel = np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3))
        if found is not None:
            edges, gyro, accel = found.edges_ns, found.gyro, found.accel
        state, covariance = np.zeros(12), np.zeros((12, 12))
        if (s := self._state) is not None and stamp_ns == self._last_ns:
            turn, into = self._odom_T_last[:3, :3].T, np.eye(9)
            into[:3, :3] = into[3:6, 3:6] = turn
            state = np.concatenate([turn @ self._velocity(), turn @ s.gravity, s.accel_bias, self._gyro_bias])
            covariance[:9, :9] = into @ s.covariance @ into.T
            covariance[9:, 9:] = s.gyro_bias_sigma**2 * np.eye(3)
        return InertialLink(edges, gyro, accel, state, covariance)

    def reckoning(self, wheel: Wheel, lasting: F64) -> DeadReckoning | None:
        """From the last pose on, with wheels whose scale and direction have a covariance `lasting` (4, 4).

        None where the IMU does not know its velocity, or is wrong.
        """
        if self._state is None or self.left_out:
            return None
        state = replace(self._state, velocity=self._velocity())
        return DeadReckoning(self._imu, wheel.left_T_wheel, self._odom_T_last, state, lasting)

    def motion(self, begin_ns: int, end_ns: int) -> Preintegrated | None:
        """From one time to another with the biases of today; each is asked for several times a frame."""
        if (begin_ns, end_ns) not in self._integrated:
            found, biases, imu = self._buffer.between(begin_ns, end_ns), (self._gyro_bias, np.zeros(3)), self._imu
            self._integrated[begin_ns, end_ns] = None if found is None else preintegrate(
                found.seconds, found.gyro, found.accel, *biases, imu.gyro_noise, imu.accel_noise
            )  # fmt: skip
        return self._integrated[begin_ns, end_ns]

    def _velocity(self) -> F64:
        """(3,) m/s of the IMU at the last pose: the filter's, taken on from its newest pose."""
        assert self._state is not None
        motion = self.motion(self._node_ns, self._last_ns) if self._last_ns > self._node_ns else None
        if motion is None:
            return self._state.velocity
        turned = self._odom_T_node[:3, :3] @ motion.velocity_with(self._gyro_bias, self._state.accel_bias)
        return self._state.velocity + self._state.gravity * motion.seconds + turned

    def _compare(self, stamp_ns: int, odom_T_imu: F64) -> None:
        """Compare with what the images showed: a sensor counts once it agrees, and no longer where it contradicts."""
        motion = self.motion(self._last_ns, stamp_ns)
        self._silent = 0 if motion is not None else self._silent + 1
        if motion is None:
            self._rates.begin()
            return
        seen = self._odom_T_last[:3, :3].T @ odom_T_imu[:3, :3]
        off = se3.so3_log(motion.rotation.T @ seen)
        beyond = float(off @ off) - 6 * ROTATION_SIGMA**2  # the noise of two poses
        self._turn_errors = [*self._turn_errors[1 - JUDGED :], beyond / motion.seconds**2]
        t = motion.seconds
        self._rates.add(se3.so3_log(motion.rotation) / t + motion.gyro_bias, se3.so3_log(seen) / t, t)
        rates, forces = self._rates.verdict(), self._forces.verdict()
        enough = len(self._turn_errors) >= JUDGED
        size = 0.0 if self._state is None else abs(self._filter.force - GRAVITY)
        before = self.left_out
        if rates is False or (enough and sum(self._turn_errors) > JUDGED * MAX_TURN_ERROR**2):
            self.left_out = "gyro_contradicts_images"
        elif forces is False or size > MAX_GRAVITY_ERROR or sum(self._moves_wrong) > JUDGED // 2:
            self.left_out = "accelerometer_contradicts_images"
        elif self.left_out and enough:
            self.left_out = ""
        if self.left_out:
            self._agreed, self._state = SensorUse.UNKNOWN, None
            self._out = 0 if self.left_out != before else self._out + 1
            if self._out in (0, LOOKED_AGAIN):
                self._why = self._explained(forces)
        elif rates or self._agreed >= SensorUse.ROTATION:
            both = forces or self._agreed == SensorUse.USED
            self._agreed = SensorUse.USED if both else SensorUse.ROTATION

    def _explained(self, forces: bool | None) -> str:
        """What is wrong, and what to do."""
        if self.left_out.startswith("gyro"):
            wrong = self._rates.why()
        elif forces is False:
            wrong = self._forces.why()
        else:
            wrong = "its mean force is not that of gravity, or not in its direction"
        return f"{wrong} ('stereo-sfm calibrate SOURCE --imu' finds rotation and time offset)"


@dataclass(frozen=True, eq=False)
class _Node:
    """The motion between two poses of the filter as the comparison of forces needs it, odometry frame."""

    seconds: float
    velocity: F64  # (3,) m/s, mean by the images
    pushed: F64  # (3,) m/s, by the measured forces
    moved: F64  # (3,) m/s, mean by the measured forces
    by_bias: tuple[F64, F64]  # (3, 3) of both, by the accelerometer's bias

    @staticmethod
    def of(m: Preintegrated, begin: F64, end: F64) -> _Node:
        """From pose (4, 4) to pose (4, 4)."""
        r, t = begin[:3, :3], m.seconds
        return _Node(
            t, (end[:3, 3] - begin[:3, 3]) / t, r @ m.velocity, r @ m.position / t,
            (r @ m.velocity_by_accel, r @ m.position_by_accel / t),
        )  # fmt: skip

    def since(self, before: _Node) -> tuple[F64, F64, F64, float]:
        """The arguments of `ForceAgreement.add`: by the mean velocities of two successive motions the accelerations are
        known without the velocities themselves (Qin and Shen 2017)."""
        t = 0.5 * (before.seconds + self.seconds)
        measured = (before.pushed - before.moved + self.moved) / t
        by_bias = (before.by_bias[0] - before.by_bias[1] + self.by_bias[1]) / t
        return measured, (self.velocity - before.velocity) / t, by_bias, t


def roll_pitch_deg(down: F64) -> tuple[float, float]:
    """Degrees to the right and upwards of a camera (x right, y down, z forward) that sees gravity along `down` (3,)."""
    x, y, z = (down / np.linalg.norm(down)).tolist()
    return float(np.degrees(np.arctan2(x, y))), float(np.degrees(np.arcsin(np.clip(-z, -1.0, 1.0))))
