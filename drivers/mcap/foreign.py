"""Recordings of other programs as a source: two image topics, their calibrations, and other usable topics."""

from __future__ import annotations

import itertools
import logging
from collections import deque
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np

from stereo_sfm.calib.formats.camera_info import CameraInfo
from stereo_sfm.calib.imu import Imu
from stereo_sfm.calib.rig import Rig
from stereo_sfm.calib.side_names import words_of
from stereo_sfm.calib.wheel import Wheel
from stereo_sfm.drivers.folder_source import SHOWN_WARNINGS
from stereo_sfm.drivers.image_lists import MAX_SKEW_NS
from stereo_sfm.drivers.mcap import McapOptions
from stereo_sfm.drivers.mcap.clock import Clock, clock_of
from stereo_sfm.drivers.mcap.messages import (
    BAD_MESSAGE,
    CAMERAS,
    IMAGES,
    IMUS,
    JOINTS,
    POSES,
    TRANSFORMS,
    VELOCITIES,
    ImageMessage,
    ImuReading,
    Transform,
    WheelReading,
    half_of,
    schema_name,
)
from stereo_sfm.drivers.mcap.recording import Recording
from stereo_sfm.drivers.mcap.rig import camera_of, chain, stereo_rig
from stereo_sfm.drivers.mcap.topics import ChosenTopics, camera_topic, choose_topics, is_rectified
from stereo_sfm.drivers.mcap.video import KEYFRAMES_NS, VideoDecoder
from stereo_sfm.drivers.rig_option import chosen_rig
from stereo_sfm.drivers.source import BaseSource, Stamps
from stereo_sfm.drivers.tum_rgbd.source import with_virtual_camera
from stereo_sfm.drivers.used_bits import used_bits
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.log.images import UnknownEncoding
from stereo_sfm.log.reader import Record
from stereo_sfm.pixels import eight_bits
from stereo_sfm.types import ImuSamples, StereoImage, Trajectory, WheelSamples

log = logging.getLogger("stereo_sfm")

Reading = TypeVar("Reading", ImuReading, WheelReading)

_STATIC_NS = 10_000_000_000  # fixed transforms among moving ones must come within the first ten seconds
_STEP_BACK_NS = 200_000_000  # messages of several threads may be out of order by less
FIRST = 5  # images of which one must be readable
_WAITING_BYTES = 1 << 28  # of images of one camera that wait for the other: logs may be written in bursts


@dataclass
class _StampedImage:
    """An image of one camera, not decoded."""

    stamp_ns: int
    message: ImageMessage


class ForeignSource(BaseSource):
    """Pairs the images of two topics by their stamps. Frames without a partner count as dropped."""

    def __init__(self, reader: Recording, options: McapOptions) -> None:
        """Takes over the reader.

        Args:
            reader: the open recording.
            options: a calibration that replaces or supplies the one in the file; topics where names are ambiguous.
        """
        self.reader = reader
        self.name = str(reader.path)
        self.topics = choose_topics(reader, options.left, options.right, options.depth, options.wheel)
        self._joints = [name for name in options.joints.split(",") if name]
        self._unreadable = 0  # images of the last reading
        self._read_forward()
        first = self._first_left()
        self._video = first.encoding if first and first.video else ""
        self._clock = self._found_clock()
        self.rig = self._with_wheel(self._with_imu(chosen_rig(options.rig, self._recorded_rig)))
        if self.topics.depth:
            self.rig = with_virtual_camera(self.rig)
        self.ground_truth = self._read_truth()
        counts = {t.topic: t.count for t in reader.topics}
        self.frame_count = min(counts[t] for t in (self.topics.left, self._other()) if t)
        self._bits = used_bits(self.name, self._sample)
        self._check_first()

    def _read_forward(self) -> None:
        """In the order of the file, where the clock by which messages were logged was set back."""
        back_ns = self.reader.step_back_ns(self.topics.left)
        if back_ns > _STEP_BACK_NS:
            self.reader.by_time = False
            log.warning(
                "%s: the clock goes back by %.1f s in it: its messages are read in the order of the file",
                self.name,
                back_ns / 1e9,
            )

    def _found_clock(self) -> Clock:
        def stamps(topic: str) -> Iterator[tuple[int, int]]:
            records = self.reader.messages([topic])
            return ((message.stamp_ns, r.log_time) for r in records if (message := self._message_of(r)) is not None)

        clock, warning = clock_of(self.name, [t for t in (self.topics.left, self._other()) if t], stamps)
        if warning:
            log.warning("%s: %s", self.name, warning)
        if clock.skew_ns > MAX_SKEW_NS:
            log.warning(
                "%s: the stamps of left and right images differ by %.1f ms: in motion they see different scenes. "
                "Trigger both cameras together",
                self.name,
                clock.skew_ns / 1e6,
            )
        return clock

    def close(self) -> None:
        self.reader.close()

    def __iter__(self) -> Iterator[StereoImage]:
        return self.frames()

    def stamps(self) -> Stamps:
        """Of all usable pairs."""
        pairs = [
            (a.stamp_ns, b.stamp_ns if b else a.stamp_ns) for a, b in self._pairs(None, None, [], []) if self._used(b)
        ]
        table = np.array(pairs, np.int64).reshape(-1, 2)
        skew = (
            float(np.abs(table[:, 1] - table[:, 0]).max()) / 1e6 if len(table) and self.topics.right else float("nan")
        )
        return Stamps(table[:, 0].copy(), skew)

    def _used(self, other: _StampedImage | None) -> bool:
        return other is not None or not self._other()

    def frames(self, start_ns: int | None = None, until_ns: int | None = None) -> Iterator[StereoImage]:
        """Frames logged in [start_ns, until_ns]; the first is number 0 whatever the start.

        Raises:
            StereoSfmError: images that do not fit the calibration.
        """
        dropped = self._unreadable = 0
        imu: list[ImuReading] = []
        wheel: list[WheelReading] = []
        for frame_id, (left, other) in enumerate(self._pairs(start_ns, until_ns, imu, wheel)):
            image = self._decode(frame_id, left, other, dropped) if self._used(other) else None
            dropped = 0 if image is not None else dropped + 1
            if image is not None:
                yield replace(
                    image,
                    imu=take_imu(imu, left.stamp_ns) if self.topics.imu else None,
                    wheel=take_wheel(wheel, left.stamp_ns, self._joints) if self.topics.wheel else None,
                )
        if self._unreadable > SHOWN_WARNINGS:
            log.warning("%s: %d images could not be read", self.name, self._unreadable)

    def _other(self) -> str:
        return self.topics.right or self.topics.depth

    def _decode(
        self, frame_id: int, left: _StampedImage, other: _StampedImage | None, dropped: int
    ) -> StereoImage | None:
        try:
            return self._decoded(frame_id, left, other, dropped)
        except BAD_MESSAGE as error:
            self._unreadable += 1
            if self._unreadable <= SHOWN_WARNINGS:
                log.warning("%s: image at %d ns is skipped: %s", self.name, left.stamp_ns, error)
            return None

    def _decoded(self, frame_id: int, left: _StampedImage, other: _StampedImage | None, dropped: int) -> StereoImage:
        """Raises one of `BAD_MESSAGE` for an image that cannot be read, StereoSfmError where none can, or another size
        than the calibration's."""
        try:
            pixels = eight_bits(left.message.gray(), self._bits)
            right = eight_bits(other.message.gray(), self._bits) if other and self.topics.right else None
            depth = other.message.depth() if other and self.topics.depth else None
        except UnknownEncoding as error:
            raise StereoSfmError(f"{self.name}: {error}: record or convert them in one of these") from None
        self._check_size("left", pixels.shape, self.rig.left.size)
        if right is not None and self.rig.right is not None:
            self._check_size("right", right.shape, self.rig.right.size)
        if depth is not None:
            self._check_size("depth", depth.shape, self.rig.left.size)
        right_stamp = other.stamp_ns if other and right is not None and other.stamp_ns != left.stamp_ns else 0
        return StereoImage(
            frame_id, left.stamp_ns, pixels, right, depth, right_stamp_ns=right_stamp, dropped_before=dropped
        )

    def _pairs(
        self, start_ns: int | None, until_ns: int | None, imu: list[ImuReading], wheel: list[WheelReading]
    ) -> Iterator[tuple[_StampedImage, _StampedImage | None]]:
        """(left, right or depth) by stamp; an unpaired left image has None. Samples are put into `imu` and `wheel`."""
        samples = [*self.topics.imu, *([self.topics.wheel] if self.topics.wheel else [])]
        names = [t for t in (self.topics.left, self._other()) if t]
        lefts: deque[_StampedImage] = deque()
        others: deque[_StampedImage] = deque()
        decoder = VideoDecoder()
        if start_ns is not None and self._video:
            self._decode_before(start_ns, names, decoder)
        for record in self.reader.messages([*names, *samples], start_ns, until_ns):
            if record.topic in self.topics.imu:
                reading = _imu_reading(record, self.topics)
                imu += [self._on_clock(reading, record)] if reading is not None else []
                continue
            if record.topic == self.topics.wheel:
                turned = _wheel_reading(record)
                wheel += [self._on_clock(turned, record)] if turned is not None else []
                continue
            image = self._shown(self._image_of(record), record.topic, decoder)
            if image is None:
                continue
            if len(names) == 1:
                yield image, None
                continue
            for waiting in (lefts, others):  # from before the clock was set back
                while waiting and waiting[0].stamp_ns - image.stamp_ns > _STEP_BACK_NS:
                    waiting.popleft()
            (lefts if record.topic == names[0] else others).append(image)
            while lefts and others:
                skew = others[0].stamp_ns - lefts[0].stamp_ns
                if skew < -self._clock.tolerance_ns:
                    others.popleft()
                elif skew > self._clock.tolerance_ns:
                    yield lefts.popleft(), None
                else:
                    yield lefts.popleft(), others.popleft()
            if sum(len(x.message.data) for x in lefts) > _WAITING_BYTES:
                yield lefts.popleft(), None
            if sum(len(x.message.data) for x in others) > _WAITING_BYTES:
                others.popleft()

    def _decode_before(self, start_ns: int, names: list[str], decoder: VideoDecoder) -> None:
        """What a video's first image needs from before it."""
        for record in self.reader.messages(names, start_ns - KEYFRAMES_NS, start_ns - 1):
            self._shown(self._image_of(record), record.topic, decoder)

    def _shown(self, image: _StampedImage | None, topic: str, decoder: VideoDecoder) -> _StampedImage | None:
        """The image that a message of a video completes; others are as they are."""
        if image is None or not image.message.video:
            return image
        with suppress(*BAD_MESSAGE):
            found = decoder.decoded(topic, image.message, image.stamp_ns)
            return None if found is None else _StampedImage(*found)
        return None

    def _on_clock(self, reading: Reading, record: Record) -> Reading:
        """A sample with its stamp on the clock of the images."""
        stamp_ns = self._clock.stamp(reading.stamp_ns, record.log_time)
        return reading if stamp_ns == reading.stamp_ns else replace(reading, stamp_ns=stamp_ns)

    def _message_of(self, record: Record) -> ImageMessage | None:
        try:
            return IMAGES[schema_name(record)](record.data)
        except BAD_MESSAGE as error:
            log.warning("%s: a message of %s cannot be read: %s", self.name, record.topic, error)
            return None

    def _image_of(self, record: Record) -> _StampedImage | None:
        message = self._message_of(record)
        if message is None:
            return None
        return _StampedImage(self._clock.stamp(message.stamp_ns, record.log_time), message)

    def _recorded_rig(self) -> Rig:
        names = tuple(camera_topic(t, self.topics.cameras) for t in (self.topics.left, self.topics.right) if t)
        if not all(names):
            raise StereoSfmError(f"{self.name} has no calibration of its images: give one with --rig FILE")
        infos = [self._camera_info(name) for name in names]
        rectified = is_rectified(self.topics.left)
        if len(infos) == 1:
            return Rig(camera_of(infos[0], names[0], rectified), name=self.reader.path.stem)
        if names[0] == names[1]:
            raise StereoSfmError(
                f"{self.name} has one calibration, {names[0]}, for two cameras: give one with --rig FILE"
            )
        rig = stereo_rig(infos[0], infos[1], (names[0], names[1]), rectified, self._fixed_transforms())
        return Rig(rig.left, rig.right, rig.left_T_right, name=self.reader.path.stem)

    def _camera_info(self, topic: str) -> CameraInfo:
        for record in self.reader.messages([topic]):
            try:
                return CAMERAS[schema_name(record)](record.data)
            except BAD_MESSAGE as error:
                raise StereoSfmError(f"{self.name}: calibration on {topic} cannot be read: {error}") from None
        raise StereoSfmError(f"{self.name}: {topic} is empty")

    def _with_imu(self, rig: Rig) -> Rig:
        """The rig with the pose of the IMU, where the recording has one and its transforms say where it is."""
        if rig.imu is not None or not self.topics.imu:
            return rig
        records = self.reader.messages(self.topics.imu[:1])
        reading = next((r for m in records if (r := _imu_reading(m, self.topics)) is not None), None)
        left_T_imu = chain(self._fixed_transforms(), self._left_frame(), reading.frame) if reading else None
        if left_T_imu is None:
            log.warning("%s: no transform from the left camera to the IMU: its samples are not used", self.name)
            return rig
        return replace(rig, imu=Imu(left_T_imu))

    def _with_wheel(self, rig: Rig) -> Rig:
        """The rig with the robot's pose, where the recording has its velocities and its transforms say where it is."""
        if rig.wheel is not None or not self.topics.wheel:
            return rig
        reading = next((r for m in self.reader.messages([self.topics.wheel]) if (r := _wheel_reading(m))), None)
        left_T_wheel = chain(self._fixed_transforms(), self._left_frame(), reading.frame) if reading else None
        if left_T_wheel is None or reading is None or reading.joints:
            text = "%s: %s needs the wheels' calibration (--rig FILE): it is not used"
            log.warning(text, self.name, self.topics.wheel)
            return rig
        return replace(rig, wheel=Wheel(left_T_wheel))

    def _fixed_transforms(self) -> list[Transform]:
        out: list[Transform] = []
        start, _ = self.reader.time_range
        fixed = [t for t in self.topics.transforms if "static" in words_of(t)]  # few: the clock may be set after them
        others = [t for t in self.topics.transforms if t not in fixed]
        first = self.reader.messages(others, None, start + _STATIC_NS)
        for record in itertools.chain(self.reader.messages(fixed), first):
            try:
                out += TRANSFORMS[schema_name(record)](record.data)
            except BAD_MESSAGE as error:
                log.warning("%s: a transform on %s cannot be read: %s", self.name, record.topic, error)
        return out

    def _read_truth(self) -> Trajectory | None:
        """Poses of the left camera if its pose on the tracked body is known, else of the body itself."""
        rows: list[Transform] = []
        for record in self.reader.messages([self.topics.truth] if self.topics.truth else []):
            try:
                pose = POSES[schema_name(record)](record.data)
            except BAD_MESSAGE:
                continue
            stamp_ns = self._clock.stamp(pose.stamp_ns, record.log_time)
            rows.append(Transform(stamp_ns, pose.parent, pose.child, pose.matrix))
        if not rows:
            return None
        rows.sort(key=lambda row: row.stamp_ns)
        body_T_cam = chain(self._fixed_transforms(), rows[0].child, self._left_frame()) if rows[0].child else None
        poses = np.array([row.matrix for row in rows]) @ (np.eye(4) if body_T_cam is None else body_T_cam)
        return Trajectory(np.array([row.stamp_ns for row in rows], np.int64), poses)

    def _left_frame(self) -> str:
        first = self._first_left()
        return first.frame if first else ""

    def _first_left(self) -> ImageMessage | None:
        return next((self._message_of(r) for r in self.reader.messages([self.topics.left])), None)

    def _sample(self, count: int) -> Iterator[Any]:
        """Readable images of both cameras at evenly spaced times."""
        first, last = self.reader.time_range
        for topic in filter(None, (self.topics.left, self.topics.right)):
            for k in range(count):
                at = self.reader.messages([topic], first + k * (last - first) // max(count, 1))
                image = next((image for record in at if (image := self._image_of(record)) is not None), None)
                with suppress(*BAD_MESSAGE):
                    if image is not None:
                        yield image.message.gray()

    def _check_first(self) -> None:
        """Raises StereoSfmError before the first frame if the images cannot be read or do not match the calibration."""
        used = ((left, other) for left, other in self._pairs(None, None, [], []) if self._used(other))
        why: Exception | str | None = None
        for left, other in itertools.islice(used, FIRST):
            try:
                self._decoded(0, left, other, 0)
                return
            except BAD_MESSAGE as error:
                why = error
        if why is None and self._video:
            why = f"'{self._video}' video without a keyframe"
        if why is not None:
            raise StereoSfmError(f"{self.name}: its images cannot be read: {why}")

    def _check_size(self, what: str, shape: tuple[int, ...], size: tuple[int, int]) -> None:
        if (shape[1], shape[0]) != size:
            raise StereoSfmError(
                f"{self.name}: {what} images are {shape[1]}x{shape[0]} but the calibration is for {size[0]}x{size[1]}: "
                "use the calibration of these images (--rig FILE)"
            )


def _imu_reading(record: Record, topics: ChosenTopics) -> ImuReading | None:
    """What a message measures: of two topics the first one is the gyroscope's, the other one the accelerometer's."""
    with suppress(*BAD_MESSAGE):
        reading = IMUS[schema_name(record)](record.data)
        return reading if len(topics.imu) == 1 else half_of(reading, record.topic == topics.imu[0])
    return None


def _up_to(buffer: list[Reading], until_ns: int) -> list[Reading]:
    """Remove the samples up to a stamp from the buffer, in their order."""
    taken = sorted((s for s in buffer if s.stamp_ns <= until_ns), key=lambda s: s.stamp_ns)
    buffer[:] = [s for s in buffer if s.stamp_ns > until_ns]
    return taken


def take_imu(buffer: list[ImuReading], until_ns: int) -> ImuSamples:
    """Remove the samples up to a stamp from the buffer."""
    taken = _up_to(buffer, until_ns)
    values = np.array([s.values for s in taken], float).reshape(-1, 6)
    return ImuSamples(np.array([s.stamp_ns for s in taken], np.int64), values[:, :3].copy(), values[:, 3:].copy())


def _wheel_reading(record: Record) -> WheelReading | None:
    with suppress(*BAD_MESSAGE):
        return (VELOCITIES | JOINTS)[schema_name(record)](record.data)
    return None


def take_wheel(buffer: list[WheelReading], until_ns: int, joints: list[str]) -> WheelSamples:
    """Remove the samples up to a stamp from the buffer; speeds of `joints` where those are named."""
    taken = _up_to(buffer, until_ns)
    if joints:
        taken = [s for s in taken if all(name in s.joints for name in joints)]
        speeds = np.array([[s.joints[name] for name in joints] for s in taken], float).reshape(-1, len(joints))
        return WheelSamples.of_wheels(np.array([s.stamp_ns for s in taken], np.int64), speeds)
    linear, angular = (np.array([getattr(s, n) for s in taken], float).reshape(-1, 3) for n in ("linear", "angular"))
    return WheelSamples(np.array([s.stamp_ns for s in taken], np.int64), linear, angular)
