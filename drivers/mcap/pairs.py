"""Images of two topics of a recording of another program, paired by their stamps, with the samples between them."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace

from stereo_sfm.drivers.mcap.clock import Clock
from stereo_sfm.drivers.mcap.messages import BAD_MESSAGE, IMAGES, ImageMessage, ImuReading, WheelReading, schema_name
from stereo_sfm.drivers.mcap.recording import Recording
from stereo_sfm.drivers.mcap.samples import Reading, imu_reading, wheel_reading
from stereo_sfm.drivers.mcap.topics import ChosenTopics
from stereo_sfm.drivers.mcap.video import KEYFRAMES_NS, VideoDecoder
from stereo_sfm.drivers.unreadable import Unreadable
from stereo_sfm.log.reader import Record

STEP_BACK_NS = 200_000_000  # messages of several threads may be out of order by less
_WAITING_BYTES = 1 << 28  # of images of one camera that wait for the other: logs may be written in bursts


@dataclass
class StampedImage:
    """An image of one camera, not decoded."""

    stamp_ns: int
    message: ImageMessage


class ImagePairs:
    """Pairs of the left images with those of the other topic; an unpaired left image has None."""

    def __init__(
        self, reader: Recording, topics: ChosenTopics, clock: Clock, video: bool, unreadable: Unreadable
    ) -> None:
        """`video`: the images are parts of videos, of which each needs earlier ones. `unreadable`: takes what is not an
        image."""
        self._reader, self._topics, self._clock, self._video = reader, topics, clock, video
        self._names, self._unreadable = topics.images, unreadable

    def read(
        self, start_ns: int | None, until_ns: int | None, imu: list[ImuReading], wheel: list[WheelReading]
    ) -> Iterator[tuple[StampedImage, StampedImage | None]]:
        """Pairs logged in [start_ns, until_ns]. Samples are put into `imu` and `wheel`."""
        decoder = VideoDecoder()
        if start_ns is not None and self._video:
            self._decode_before(start_ns, decoder)
        lefts: deque[StampedImage] = deque()
        others: deque[StampedImage] = deque()
        for record in self._reader.messages([*self._names, *self._topics.samples], start_ns, until_ns):
            if self._put_sample(record, imu, wheel):
                continue
            image = self._shown(self.image_of(record), record.topic, decoder)
            if image is None:
                continue
            if len(self._names) == 1:
                yield image, None
                continue
            for waiting in (lefts, others):  # from before the clock was set back
                while waiting and waiting[0].stamp_ns - image.stamp_ns > STEP_BACK_NS:
                    waiting.popleft()
            (lefts if record.topic == self._names[0] else others).append(image)
            yield from self._paired(lefts, others)

    def _put_sample(self, record: Record, imu: list[ImuReading], wheel: list[WheelReading]) -> bool:
        """Whether a message is one of a sensor; what it measures is put into the list."""
        if record.topic in self._topics.imu:
            reading = imu_reading(record, self._topics)
            imu += [self._on_clock(reading, record)] if reading is not None else []
        elif record.topic == self._topics.wheel:
            turned = wheel_reading(record)
            wheel += [self._on_clock(turned, record)] if turned is not None else []
        else:
            return False
        return True

    def _paired(
        self, lefts: deque[StampedImage], others: deque[StampedImage]
    ) -> Iterator[tuple[StampedImage, StampedImage | None]]:
        """Take the pairs out of the images that wait, and what waits for too long."""
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

    def _decode_before(self, start_ns: int, decoder: VideoDecoder) -> None:
        """What a video's first image needs from before it."""
        for record in self._reader.messages(self._names, start_ns - KEYFRAMES_NS, start_ns - 1):
            self._shown(self.image_of(record), record.topic, decoder)

    def _shown(self, image: StampedImage | None, topic: str, decoder: VideoDecoder) -> StampedImage | None:
        """The image that a message of a video completes; others are as they are."""
        if image is None or not image.message.video:
            return image
        with suppress(*BAD_MESSAGE):
            found = decoder.decoded(topic, image.message, image.stamp_ns)
            return None if found is None else StampedImage(*found)
        return None

    def _on_clock(self, reading: Reading, record: Record) -> Reading:
        """A sample with its stamp on the clock of the images."""
        stamp_ns = self._clock.stamp(reading.stamp_ns, record.log_time)
        return reading if stamp_ns == reading.stamp_ns else replace(reading, stamp_ns=stamp_ns)

    def image_of(self, record: Record) -> StampedImage | None:
        """The image of a message on the clock that counts; None for a damaged one."""
        message = message_of(record, self._unreadable)
        return None if message is None else StampedImage(self._clock.stamp(message.stamp_ns, record.log_time), message)


def message_of(record: Record, unreadable: Unreadable) -> ImageMessage | None:
    """The image of a message; None for a damaged one, which `unreadable` takes."""
    try:
        return IMAGES[schema_name(record)](record.data)
    except BAD_MESSAGE as error:
        unreadable.skip(f"a message of {record.topic} cannot be read: {error}")
        return None
