"""Recordings of other programs as a source: two image topics, their calibrations, and other usable topics."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.drivers.image_lists import MAX_SKEW_NS
from stereo_sfm.drivers.mcap import McapOptions
from stereo_sfm.drivers.mcap.clock import Clock, clock_of
from stereo_sfm.drivers.mcap.messages import BAD_MESSAGE, ImuReading, WheelReading
from stereo_sfm.drivers.mcap.pairs import STEP_BACK_NS, ImagePairs, StampedImage, message_of
from stereo_sfm.drivers.mcap.recorded_rig import RecordedRig
from stereo_sfm.drivers.mcap.recording import Recording
from stereo_sfm.drivers.mcap.samples import on_the_clock, take_imu, take_wheel
from stereo_sfm.drivers.mcap.topics import choose_topics
from stereo_sfm.drivers.rig_option import chosen_rig
from stereo_sfm.drivers.source import BaseSource, Stamps
from stereo_sfm.drivers.tum_rgbd.source import with_virtual_camera
from stereo_sfm.drivers.unreadable import Unreadable
from stereo_sfm.drivers.used_bits import used_bits
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.log.images import UnknownEncoding
from stereo_sfm.pixels import eight_bits
from stereo_sfm.types import StereoImage

log = logging.getLogger("stereo_sfm")

FIRST = 5  # images of which one must be readable


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
        self._unreadable = Unreadable(self.name, "images could not be read")
        self._read_forward()
        left = reader.messages([self.topics.left])
        first = next((found for record in left if (found := message_of(record, self._unreadable)) is not None), None)
        self._video = first.encoding if first and first.video else ""
        clock = self._found_clock()
        self.topics = on_the_clock(reader, self.topics, clock)
        recorded = RecordedRig(reader, self.topics, first.frame if first else "")
        self._recorded = None if options.rig else recorded
        self.rig = recorded.with_wheel(recorded.with_imu(chosen_rig(options.rig, recorded.cameras)))
        if self.topics.depth:
            self.rig = with_virtual_camera(self.rig)
        self.ground_truth = recorded.truth(clock)
        self._pairs = ImagePairs(reader, self.topics, clock, bool(self._video), self._unreadable)
        counts = {t.topic: t.count for t in reader.topics}
        self.frame_count = min(counts[t] for t in self.topics.images)
        self._bits = used_bits(self.name, self._sample)
        self._check_first()

    def _read_forward(self) -> None:
        """In the order of the file, where the clock by which messages were logged was set back."""
        back_ns = self.reader.step_back_ns(self.topics.left)
        if back_ns > STEP_BACK_NS:
            self.reader.by_time = False
            log.warning(
                "%s: the clock goes back by %.1f s in it: its messages are read in the order of the file",
                self.name,
                back_ns / 1e9,
            )

    def _found_clock(self) -> Clock:
        def stamps(topic: str) -> Iterator[tuple[int, int]]:
            read = ((record, message_of(record, self._unreadable)) for record in self.reader.messages([topic]))
            return ((message.stamp_ns, record.log_time) for record, message in read if message is not None)

        clock, warning = clock_of(self.name, self.topics.images, stamps)
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

    def other_reading(self) -> tuple[str, Rig] | None:
        return None if self._recorded is None else self._recorded.other_reading()

    def close(self) -> None:
        self.reader.close()

    def __iter__(self) -> Iterator[StereoImage]:
        return self.frames()

    def stamps(self) -> Stamps:
        """Of all usable pairs."""
        pairs = [
            (a.stamp_ns, b.stamp_ns if b else a.stamp_ns)
            for a, b in self._pairs.read(None, None, [], [])
            if self._used(b)
        ]
        table = np.array(pairs, np.int64).reshape(-1, 2)
        skew = (
            float(np.abs(table[:, 1] - table[:, 0]).max()) / 1e6 if len(table) and self.topics.right else float("nan")
        )
        return Stamps(table[:, 0].copy(), skew)

    def _used(self, other: StampedImage | None) -> bool:
        return other is not None or not self.topics.other

    def frames(self, start_ns: int | None = None, until_ns: int | None = None) -> Iterator[StereoImage]:
        """Frames logged in [start_ns, until_ns]; the first is number 0 whatever the start.

        Raises:
            StereoSfmError: images that do not fit the calibration.
        """
        dropped = 0
        self._unreadable.begin()
        imu: list[ImuReading] = []
        wheel: list[WheelReading] = []
        for frame_id, (left, other) in enumerate(self._pairs.read(start_ns, until_ns, imu, wheel)):
            image = self._decode(frame_id, left, other, dropped) if self._used(other) else None
            dropped = 0 if image is not None else dropped + 1
            if image is not None:
                yield replace(
                    image,
                    imu=take_imu(imu, left.stamp_ns) if self.topics.imu else None,
                    wheel=take_wheel(wheel, left.stamp_ns, self._joints) if self.topics.wheel else None,
                )
        self._unreadable.end()

    def _decode(
        self, frame_id: int, left: StampedImage, other: StampedImage | None, dropped: int
    ) -> StereoImage | None:
        try:
            return self._decoded(frame_id, left, other, dropped)
        except BAD_MESSAGE as error:
            self._unreadable.skip(f"image at {left.stamp_ns} ns is skipped: {error}")
            return None

    def _decoded(self, frame_id: int, left: StampedImage, other: StampedImage | None, dropped: int) -> StereoImage:
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

    def _sample(self, count: int) -> Iterator[Any]:
        """Readable images of both cameras at evenly spaced times."""
        first, last = self.reader.time_range
        for topic in filter(None, (self.topics.left, self.topics.right)):
            for k in range(count):
                at = self.reader.messages([topic], first + k * (last - first) // max(count, 1))
                image = next((image for record in at if (image := self._pairs.image_of(record)) is not None), None)
                with suppress(*BAD_MESSAGE):
                    if image is not None:
                        yield image.message.gray()

    def _check_first(self) -> None:
        """Raises StereoSfmError before the first frame if the images cannot be read or do not match the calibration."""
        used = ((left, other) for left, other in self._pairs.read(None, None, [], []) if self._used(other))
        why: Exception | str | None = None
        for left, other in itertools.islice(used, FIRST):
            try:
                self._decoded(0, left, other, 0)
                if other is not None and self.topics.depth:
                    self._check_depth(left.message.frame.lstrip("/"), other.message.frame.lstrip("/"))
                return
            except BAD_MESSAGE as error:
                why = error
        if why is None and self._video:
            why = f"'{self._video}' video without a keyframe"
        if why is None:
            left, *other = self.topics.images
            raise StereoSfmError(
                f"{self.name}: no image of {left} has a partner on {''.join(other)}: their stamps are never near each "
                "other. Record both cameras at the same time, with one clock"
            )
        raise StereoSfmError(f"{self.name}: its images cannot be read: {why}")

    def _check_depth(self, frame: str, of_depth: str) -> None:
        """Warn where depth is another camera's: its pixels do not tell."""
        if frame and of_depth and frame != of_depth:
            log.warning(
                "%s: %s is the depth of %s, not of %s: record it registered to the image, or choose it by ?depth=TOPIC",
                self.name, self.topics.depth, of_depth, frame,
            )  # fmt: skip

    def _check_size(self, what: str, shape: tuple[int, ...], size: tuple[int, int]) -> None:
        if (shape[1], shape[0]) != size:
            raise StereoSfmError(
                f"{self.name}: {what} images are {shape[1]}x{shape[0]} but the calibration is for {size[0]}x{size[1]}: "
                "use the calibration of these images (--rig FILE)"
            )
