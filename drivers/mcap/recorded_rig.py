"""What a recording of another program says about its sensors: calibrations, transforms, and the true poses."""

from __future__ import annotations

import itertools
import logging
from dataclasses import replace
from pathlib import Path

import numpy as np

from stereo_sfm.calib.formats.camera_info import CameraInfo
from stereo_sfm.calib.imu import Imu
from stereo_sfm.calib.rig import Rig
from stereo_sfm.calib.side_names import words_of
from stereo_sfm.calib.wheel import Wheel
from stereo_sfm.drivers.mcap.clock import Clock
from stereo_sfm.drivers.mcap.messages import BAD_MESSAGE, CAMERAS, POSES, TRANSFORMS, Transform, schema_name
from stereo_sfm.drivers.mcap.recording import Recording
from stereo_sfm.drivers.mcap.rig import camera_of, chain, other_reading, stereo_rig
from stereo_sfm.drivers.mcap.samples import imu_reading, wheel_reading
from stereo_sfm.drivers.mcap.topics import ChosenTopics, camera_topic, is_rectified
from stereo_sfm.drivers.unreadable import Unreadable
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.types import Trajectory

log = logging.getLogger("stereo_sfm")

_STATIC_NS = 10_000_000_000  # fixed transforms among moving ones must come within the first ten seconds


class RecordedRig:
    """Reads calibrations, transforms and true poses of the chosen topics."""

    def __init__(self, reader: Recording, topics: ChosenTopics, left_frame: str) -> None:
        """`left_frame`: name of the left camera's frame, "" where there is none."""
        self._reader, self._topics, self._left_frame = reader, topics, left_frame
        self._name = str(reader.path)

    def cameras(self) -> Rig:
        """The cameras alone.

        Raises:
            StereoSfmError: no calibration, or one that cannot be used.
        """
        names = self._names()
        if not all(names):
            raise StereoSfmError(f"{self._name} has no calibration of its images: give one with --rig FILE")
        infos = [self._camera_info(name) for name in names]
        rectified, label = is_rectified(self._topics.left), Path(self._reader.path.name).stem
        if len(infos) == 1:
            return Rig(camera_of(infos[0], names[0], rectified), name=label)
        if names[0] == names[1]:
            raise StereoSfmError(
                f"{self._name} has one calibration, {names[0]}, for two cameras: give one with --rig FILE"
            )
        return replace(stereo_rig(infos[0], infos[1], (names[0], names[1]), rectified, self._transforms()), name=label)

    def _names(self) -> tuple[str, ...]:
        """Topics of the calibrations, "" where there is none."""
        return tuple(camera_topic(t, self._topics.cameras) for t in (self._topics.left, self._topics.right) if t)

    def other_reading(self) -> tuple[str, Rig] | None:
        """As of `stereo_sfm.drivers.source.Source`."""
        names = self._names()
        if len(names) != 2 or not all(names):
            return None
        left, right = map(self._camera_info, names)
        rectified = is_rectified(self._topics.left)
        return other_reading(left, right, (names[0], names[1]), rectified, self._transforms())

    def _camera_info(self, topic: str) -> CameraInfo:
        for record in self._reader.messages([topic]):
            try:
                return CAMERAS[schema_name(record)](record.data)
            except BAD_MESSAGE as error:
                raise StereoSfmError(f"{self._name}: calibration on {topic} cannot be read: {error}") from None
        raise StereoSfmError(f"{self._name}: {topic} is empty")

    def with_imu(self, rig: Rig) -> Rig:
        """The rig with the pose of the IMU, where the recording has one and its transforms say where it is."""
        if rig.imu is not None or not self._topics.imu:
            return rig
        records = self._reader.messages(self._topics.imu[:1])
        reading = next((r for m in records if (r := imu_reading(m, self._topics)) is not None), None)
        left_T_imu = chain(self._transforms(), self._left_frame, reading.frame) if reading else None
        if left_T_imu is None:
            log.warning("%s: no transform from the left camera to the IMU: its samples are not used", self._name)
            return rig
        return replace(rig, imu=Imu(left_T_imu))

    def with_wheel(self, rig: Rig) -> Rig:
        """The rig with the robot's pose, where the recording has its velocities and its transforms say where it is."""
        if rig.wheel is not None or not self._topics.wheel:
            return rig
        reading = next((r for m in self._reader.messages([self._topics.wheel]) if (r := wheel_reading(m))), None)
        left_T_wheel = chain(self._transforms(), self._left_frame, reading.frame) if reading else None
        if left_T_wheel is None or reading is None or reading.joints:
            text = "%s: %s needs the wheels' calibration (--rig FILE): it is not used"
            log.warning(text, self._name, self._topics.wheel)
            return rig
        return replace(rig, wheel=Wheel(left_T_wheel))

    def _transforms(self) -> list[Transform]:
        """The fixed ones."""
        out: list[Transform] = []
        unreadable = Unreadable(self._name, "transforms could not be read")
        start, _ = self._reader.time_range
        fixed = [t for t in self._topics.transforms if "static" in words_of(t)]  # few: the clock may be set after them
        others = [t for t in self._topics.transforms if t not in fixed]
        first = self._reader.messages(others, None, start + _STATIC_NS)
        for record in itertools.chain(self._reader.messages(fixed), first):
            try:
                out += TRANSFORMS[schema_name(record)](record.data)
            except BAD_MESSAGE as error:
                unreadable.skip(f"a transform on {record.topic} cannot be read: {error}")
        unreadable.end()
        return out

    def truth(self, clock: Clock) -> Trajectory | None:
        """Poses of the left camera if its pose on the tracked body is known, else positions of the body itself."""
        rows: list[Transform] = []
        for record in self._reader.messages([self._topics.truth] if self._topics.truth else []):
            try:
                pose = POSES[schema_name(record)](record.data)
            except BAD_MESSAGE:
                continue
            stamp_ns = clock.stamp(pose.stamp_ns, record.log_time)
            rows.append(Transform(stamp_ns, pose.parent, pose.child, pose.matrix))
        if not rows:
            return None
        rows.sort(key=lambda row: row.stamp_ns)
        body = rows[0].child
        body_T_cam = chain(self._transforms(), body, self._left_frame) if body else None
        known = body_T_cam is not None or bool(body and body.lstrip("/") == self._left_frame.lstrip("/"))
        if not known:
            log.warning(
                "%s: no transform from the body of %s to the left camera: only positions are compared",
                self._reader.path, self._topics.truth,
            )  # fmt: skip
        poses = np.array([row.matrix for row in rows]) @ (np.eye(4) if body_T_cam is None else body_T_cam)
        return Trajectory(np.array([row.stamp_ns for row in rows], np.int64), poses, oriented=known)
