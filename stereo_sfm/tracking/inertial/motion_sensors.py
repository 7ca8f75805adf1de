"""What IMU and wheels say of the motion: the next pose, and poses while the images give none."""

from __future__ import annotations

from collections import deque

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import TrackerConfig
from stereo_sfm.geometry import se3
from stereo_sfm.tracking.inertial.dead_reckoning import DeadReckoning
from stereo_sfm.tracking.inertial.inertial_motion import InertialMotion, roll_pitch_deg
from stereo_sfm.tracking.inertial.rest import Rest
from stereo_sfm.tracking.inertial.series import LONGEST_S
from stereo_sfm.tracking.inertial.wheel_motion import LINK_NS, WheelMotion
from stereo_sfm.types import (
    F64,
    ImuSamples,
    InertialLink,
    MotionLink,
    SensorSamples,
    SensorUpdate,
    StereoImage,
    WheelSamples,
)

SHORT_S = 0.2  # over which the IMU alone is as good as with the wheels
# Longest time without images, by the IMU alone, whose positions drift with the square of it, and with wheels.
INERTIAL_S, WHEEL_S = 10.0, 30.0
BRIDGED_M = 0.5  # largest standard deviation of a position without images


class CollectedSamples:
    """What calibrates IMU and wheels: poses that the images gave, and all samples between, since the last keyframe."""

    def __init__(self) -> None:
        self._stamp_ns: list[int] = []
        self._poses: list[F64] = []
        self._imu: deque[ImuSamples] = deque()
        self._wheel: deque[WheelSamples] = deque()

    def feed(self, image: StereoImage) -> None:
        """The samples up to the image that is tracked next."""
        if image.imu is not None and len(image.imu):
            self._imu.append(image.imu)
        if image.wheel is not None and len(image.wheel):
            self._wheel.append(image.wheel)
        for kept in (self._imu, self._wheel):
            while kept and image.stamp_ns - int(kept[0].stamp_ns[-1]) > LONGEST_S * 1e9:
                kept.popleft()

    def begin(self) -> None:
        """The odometry begins anew: poses from before do not go with those to come."""
        self._stamp_ns, self._poses = [], []

    def accept(self, stamp_ns: int, odom_T_cam: F64) -> None:
        """The images gave this pose (4, 4)."""
        self._stamp_ns.append(stamp_ns)
        self._poses.append(odom_T_cam.copy())

    def joined(self) -> SensorSamples:
        """What was collected."""
        imu = ImuSamples.joined(self._imu) if self._imu else None
        wheel = WheelSamples.joined(self._wheel) if self._wheel else None
        return SensorSamples(np.array(self._stamp_ns, np.int64), np.array(self._poses).reshape(-1, 4, 4), imu, wheel)


class MotionSensors:
    """The IMU, the wheels, or both."""

    def __init__(
        self, inertial: InertialMotion | None, wheels: WheelMotion | None, collected: CollectedSamples | None = None
    ) -> None:
        """`collected`: None: they are not calibrated."""
        self._inertial, self._wheels, self._collected = inertial, wheels, collected
        self._rest = Rest()
        self._last_ns = 0
        self._reckoning: DeadReckoning | None = None  # since the last pose
        self._reckoned_ns = 0
        self._said: set[str] = set()
        self._terms: tuple[F64, F64] = np.zeros(4), np.zeros(8)  # by which the calibrations are corrected
        # With other terms, to be used from the next pose by images on.
        self._renewed: tuple[InertialMotion | None, WheelMotion | None] = None, None

    @staticmethod
    def of(config: TrackerConfig, rig: Rig) -> MotionSensors | None:
        """Those of a rig that are to be used; None if there are none."""
        inertial = InertialMotion(rig.imu) if rig.imu is not None and config.inertial else None
        wheels = WheelMotion(rig.wheel) if rig.wheel is not None and config.wheels else None
        collected = CollectedSamples() if config.calibrate_sensors else None
        return None if inertial is None and wheels is None else MotionSensors(inertial, wheels, collected)

    def use(self, update: SensorUpdate, rig: Rig) -> None:
        """Use the calibration of an update, which `rig` contains, from the next pose by images on.

        The axes of the IMU stay those of the first calibration, which the map uses: samples are turned into them.
        """
        if self._inertial is not None and rig.imu is not None and not np.array_equal(update.imu, self._terms[0]):
            self._renewed = InertialMotion(rig.imu.in_axes(self._inertial.left_R_imu)), self._renewed[1]
        if self._wheels is not None and rig.wheel is not None and not np.array_equal(update.wheel, self._terms[1]):
            self._renewed = self._renewed[0], WheelMotion(rig.wheel)
        self._terms = update.imu, update.wheel

    def feed(self, image: StereoImage) -> None:
        """The samples up to the image that is tracked next."""
        if self._collected is not None:
            self._collected.feed(image)
        if self._inertial is not None:
            self._inertial.feed(image.imu)
        if self._wheels is not None:
            self._wheels.feed(image.wheel)

    def begin(self, stamp_ns: int, odom_T_cam: F64) -> None:
        """The odometry begins anew here: poses from before do not go with those to come."""
        self._last_ns, self._reckoning = stamp_ns, None
        self._rest.forget()
        if self._collected is not None:
            self._collected.begin()
        for sensor in (self._inertial, self._wheels):
            if sensor is not None:
                sensor.begin(stamp_ns, odom_T_cam)

    def accept(self, stamp_ns: int, odom_T_cam: F64, timed: bool = True) -> None:
        """The images gave this pose (4, 4). `timed`: the time since the last one is right."""
        self._last_ns, self._reckoning = stamp_ns, None
        inertial, wheels = self._renewed
        self._inertial, self._wheels = inertial or self._inertial, wheels or self._wheels
        self._renewed = None, None
        if self._inertial is not None:
            self._inertial.accept(stamp_ns, odom_T_cam, timed)
        if self._wheels is not None:
            self._wheels.accept(stamp_ns, odom_T_cam)

    def corrected(self, stamp_ns: int, odom_T_cam: F64, covariance: F64) -> F64:
        """The pose (4, 4) that the images gave, with its covariance (6, 6), corrected by the gyroscope and at rest."""
        if self._collected is not None:
            self._collected.accept(stamp_ns, odom_T_cam)
        if self._inertial is not None:
            odom_T_cam = self._inertial.fused(stamp_ns, odom_T_cam, covariance)
        return self.settled(stamp_ns, odom_T_cam)

    def settled(self, stamp_ns: int, odom_T_cam: F64) -> F64:
        """The pose (4, 4) that the images gave, or the one that is held while the robot stands."""
        return self._rest.settled(stamp_ns, odom_T_cam, lambda: self._still(stamp_ns))

    def _still(self, stamp_ns: int) -> bool:
        """Whether the sensors say so."""
        answers = [s.still(stamp_ns) for s in (self._inertial, self._wheels) if s is not None]
        return True in answers and False not in answers

    def predict(self, stamp_ns: int, odom_T_last: F64, step: F64) -> F64:
        """(4, 4) odom_T_cam at a time after the last pose (4, 4); `step` (6,) where the sensors do not reach."""
        inertial, wheels = self._inertial, self._wheels
        if wheels is not None and (stamp_ns - self._last_ns) * 1e-9 > SHORT_S:
            bridge = self._bridge(stamp_ns)
            if bridge is not None:
                return bridge[0]
        if wheels is not None:
            step = wheels.changed(stamp_ns, step)
        expected = odom_T_last @ se3.exp(step)
        return expected if inertial is None else inertial.predict(stamp_ns, expected)

    def bridge(self, stamp_ns: int) -> tuple[F64, F64] | None:
        """Pose (4, 4) and covariance (6, 6) since the last pose from images; None if they are not accurate enough."""
        bridge = self._bridge(stamp_ns)
        exact = bridge is not None and float(np.sqrt(np.trace(bridge[1][:3, :3]) / 3)) < BRIDGED_M
        return bridge if exact else None

    def _bridge(self, stamp_ns: int) -> tuple[F64, F64] | None:
        seconds = (stamp_ns - self._last_ns) * 1e-9
        together = self._together(stamp_ns) if seconds <= WHEEL_S else None
        if together is not None:
            return together
        if self._wheels is not None and seconds <= WHEEL_S:
            by_wheels = self._wheels.predict(stamp_ns)
            if by_wheels is not None:
                return by_wheels
        return self._inertial.bridge(stamp_ns) if self._inertial is not None and seconds <= INERTIAL_S else None

    def _together(self, stamp_ns: int) -> tuple[F64, F64] | None:
        """By both sensors; None without one of them, or where samples of the IMU are missing."""
        inertial, wheels = self._inertial, self._wheels
        if inertial is None or wheels is None:
            return None
        if self._reckoning is None:
            self._reckoning, self._reckoned_ns = inertial.reckoning(wheels.wheel, wheels.lasting), self._last_ns
        if self._reckoning is None:
            return None
        while stamp_ns - self._reckoned_ns >= LINK_NS:
            begin, end = self._reckoned_ns, self._reckoned_ns + LINK_NS
            motion, turning = inertial.motion(begin, end), inertial.turning(begin, end)
            if motion is None or turning is None:
                return None
            self._reckoning.advance(motion, wheels.step(turning, inertial.left_R_imu))
            self._reckoned_ns = end
        motion = inertial.motion(self._reckoned_ns, stamp_ns)
        return None if motion is None and stamp_ns > self._reckoned_ns else self._reckoning.after(motion)

    def level(self, odom_T_cam: F64) -> dict[str, float]:
        """Of the camera (4, 4) against measured gravity: `roll_deg`, positive to the right, `pitch_deg`, upwards, and
        `tilt_sigma_deg`, the standard deviation of each; {} while gravity is not known."""
        gravity = self.gravity(odom_T_cam)
        if gravity is None:
            return {}
        roll, pitch = roll_pitch_deg(gravity[0])
        return {"roll_deg": roll, "pitch_deg": pitch, "tilt_sigma_deg": float(np.degrees(gravity[1]))}

    def gravity(self, odom_T_cam: F64) -> tuple[F64, float] | None:
        """Its direction in the camera (4, 4), (3,), and how accurate that is, radians; None while it is not known."""
        return None if self._inertial is None else self._inertial.gravity(odom_T_cam)

    def links(self, begin_ns: int, stamp_ns: int) -> tuple[InertialLink | None, MotionLink | None]:
        """What they measured between the stamps of two keyframes, of which the later has the newest pose; the same
        stamp twice where there is none before in the submap."""
        inertial, wheels = self._inertial, self._wheels
        moved = wheels is not None and stamp_ns > begin_ns
        return (
            None if inertial is None else inertial.link(begin_ns, stamp_ns),
            wheels.link(begin_ns, stamp_ns) if moved and wheels is not None else None,
        )

    def samples(self) -> SensorSamples | None:
        """What calibrates them, since the keyframe before; None where that is not asked for."""
        collected = self._collected
        if collected is None:
            return None
        self._collected = CollectedSamples()
        return collected.joined()

    def use_of_each(self) -> dict[str, float]:
        """How far each sensor counts, a `SensorUse` by its name."""
        sensors = {"imu": self._inertial, "wheels": self._wheels}
        return {name: float(sensor.use) for name, sensor in sensors.items() if sensor is not None}

    def news(self) -> str:
        """Why a sensor is left out, when that is new; "" otherwise."""
        reasons = [sensor.news for sensor in (self._inertial, self._wheels) if sensor is not None]
        new = [r for r in reasons if r and r not in self._said]
        self._said.update(new[:1])
        return new[0] if new else ""
