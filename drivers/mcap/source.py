"""MCAP files as a source: our own recordings, bit-exact; `stereo_sfm.drivers.mcap.foreign` reads other programs'."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import DecodeError

from stereo_sfm.calib.rig import Rig
from stereo_sfm.drivers.rig_option import RigOption, chosen_rig
from stereo_sfm.drivers.source import BaseSource, Source, Stamps
from stereo_sfm.drivers.unreadable import Unreadable
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.log import images, schema, topics
from stereo_sfm.log.attached import attached_rig, attached_truth
from stereo_sfm.log.provenance import METADATA
from stereo_sfm.log.reader import LogReader, Record
from stereo_sfm.log.samples import ImageInfo, ImuSample, WheelSample
from stereo_sfm.pixels import eight_bits
from stereo_sfm.storage.remote import Place, Remote, place
from stereo_sfm.types import F32, U8, ImuSamples, StereoImage, WheelSamples

if TYPE_CHECKING:
    from stereo_sfm.drivers.mcap import McapOptions

log = logging.getLogger("stereo_sfm")

_PARTS = (
    topics.IMAGE_INFO,
    topics.LEFT_IMAGE,
    topics.RIGHT_IMAGE,
    topics.DEPTH_IMAGE,
    topics.IMU,
    topics.WHEEL,
)
_MARGIN_NS = 1_000_000_000  # maximum distance of inertial samples from their frame
_WAITING = 8  # frames begun before an incomplete one is skipped


def open_mcap(path: str, options: McapOptions) -> Source:
    """Open a recording or a run.

    Args:
        path: the file.
        options: a calibration that replaces the one in the file; for files of other programs the image topics.

    Raises:
        StereoSfmError: no file, not MCAP, no images, no calibration, or images that do not fit the calibration.
    """
    if not path:
        raise StereoSfmError("no file given: use mcap:FILE.mcap")
    file = place(path)
    reader = LogReader(file if isinstance(file, Remote) else file.expanduser())
    try:
        if any(t.topic == topics.IMAGE_INFO and t.schema == "stereo_sfm.ImageInfo" for t in reader.topics):
            _refuse_topics(path, options)
            return McapSource(reader, options.rig)
        about = reader.metadata(METADATA)
        if about.get("image_format") == "none":
            raise StereoSfmError(f"{path} is a run without images: they are in {about.get('source')}")
        from stereo_sfm.drivers.mcap.foreign import ForeignSource

        return ForeignSource(reader, options)
    except BaseException:
        reader.close()
        raise


def _refuse_topics(path: str, options: McapOptions) -> None:
    """Our own files have fixed image topics: they cannot be chosen."""
    if options.left or options.right or options.depth:
        raise StereoSfmError(f"{path} is a recording of stereo-sfm: left, right, depth are for files of other programs")


def decode_image(record: Record) -> U8:
    """Pixels of a RawImage or CompressedImage record as (H, W) u8.

    Raises:
        ValueError: unknown encoding, or damaged bytes.
    """
    try:
        if record.schema is not None and record.schema.name == "foxglove.RawImage":
            m = RawImage.FromString(record.data)
            return eight_bits(images.decode_raw(m.data, m.width, m.height, m.step, m.encoding))
        return images.decode_file(CompressedImage.FromString(record.data).data)
    except DecodeError:
        raise ValueError("a damaged message") from None


def decode_depth(record: Record) -> F32:
    """Pixels of a depth RawImage record as (H, W) metres.

    Raises:
        ValueError: unsupported encoding, or damaged bytes.
    """
    try:
        m = RawImage.FromString(record.data)
        return images.decode_depth(m.data, m.width, m.height, m.step, m.encoding)
    except DecodeError:
        raise ValueError("a damaged message") from None


def check_size(path: Place, what: str, pixels: U8 | F32, size: tuple[int, int]) -> None:
    """Raises StereoSfmError when an image does not match its calibration."""
    height, width = pixels.shape
    if (width, height) != size:
        raise StereoSfmError(
            f"{path}: {what} images are {width}x{height} but the calibration is for {size[0]}x{size[1]}: "
            "use the calibration of these images (--rig FILE)"
        )


@dataclass
class _Parts:
    """The messages of one frame while it is read."""

    info: ImageInfo | None = None
    left: U8 | None = None
    right: U8 | None = None
    depth: F32 | None = None
    imu: list[ImuSample] = field(default_factory=list[ImuSample])
    wheel: list[WheelSample] = field(default_factory=list[WheelSample])

    def complete(self) -> bool:
        """Whether all images and samples announced by `info` have arrived."""
        i = self.info
        return (
            i is not None
            and self.left is not None
            and (self.right is not None or not i.has_right)
            and (self.depth is not None or not i.has_depth)
            and len(self.imu) >= i.imu_count
            and len(self.wheel) >= i.wheel_count
        )

    def image(self) -> StereoImage:
        assert self.info is not None and self.left is not None
        i = self.info
        imu = _imu(self.imu) if i.imu_count >= 0 else None
        wheel = _wheel(self.wheel) if i.wheel_count >= 0 else None
        return StereoImage(
            i.frame_id,
            i.stamp_ns,
            self.left,
            self.right,
            self.depth,
            right_stamp_ns=i.right_stamp_ns,
            exposure_us=i.exposure_us,
            gain=i.gain,
            dropped_before=i.dropped_before,
            imu=imu,
            wheel=wheel,
        )


def _imu(samples: list[ImuSample]) -> ImuSamples:
    gyro = [(s.gyro_x, s.gyro_y, s.gyro_z) for s in samples]
    accel = [(s.accel_x, s.accel_y, s.accel_z) for s in samples]
    stamps = np.array([s.stamp_ns for s in samples], np.int64)
    return ImuSamples(stamps, np.array(gyro, float).reshape(-1, 3), np.array(accel, float).reshape(-1, 3))


def _wheel(samples: list[WheelSample]) -> WheelSamples:
    linear = [(s.linear_x, s.linear_y, s.linear_z) for s in samples]
    angular = [(s.angular_x, s.angular_y, s.angular_z) for s in samples]
    stamps = np.array([s.stamp_ns for s in samples], np.int64)
    wheels = max((len(s.speeds) for s in samples), default=0)
    known = wheels and all(len(s.speeds) == wheels for s in samples)
    speeds = np.array([s.speeds for s in samples], float) if known else np.zeros((0, 0))
    return WheelSamples(stamps, np.array(linear, float).reshape(-1, 3), np.array(angular, float).reshape(-1, 3), speeds)


class McapSource(BaseSource):
    """A recording or a run of ours: the images of the sensor (or of the tracker), bit for bit."""

    def __init__(self, reader: LogReader, rig: RigOption = None) -> None:
        """Takes over the reader. `rig` replaces the recorded calibration."""
        self.reader = reader
        reader.by_time = False  # frames are written in their order; samples may be of another clock
        self.name = str(reader.path)
        self.rig = chosen_rig(rig, self._recorded_rig)
        self._check_cameras()
        self.ground_truth = attached_truth(reader)  # world_T_cam0
        self.frame_count = self._complete_count()
        self._incomplete = Unreadable(self.name, "frames were incomplete and skipped")
        self._decoders: dict[type[Any], Callable[[bytes], Any]] = {}

    def _check_cameras(self) -> None:
        """Raises StereoSfmError when the recording lacks the images of a camera of the calibration."""
        recorded = {t.topic for t in self.reader.topics if t.count}
        what, topic = ("depth", topics.DEPTH_IMAGE) if self.rig.depth else ("right", topics.RIGHT_IMAGE)
        if topics.LEFT_IMAGE in recorded and self.rig.stereo and topic not in recorded:
            raise StereoSfmError(f"{self.name} has no {what} images, but its calibration (or --rig) has that camera")

    def _recorded_rig(self) -> Rig:
        rig = attached_rig(self.reader)
        if rig is None:
            raise StereoSfmError(f"{self.name} has no calibration: give one with --rig FILE")
        return rig

    def _complete_count(self) -> int:
        """Number of frames with all images in the file."""
        counts = {t.topic: t.count for t in self.reader.topics}
        image_topics = (topics.LEFT_IMAGE, topics.RIGHT_IMAGE, topics.DEPTH_IMAGE)
        return min(counts[t] for t in (topics.IMAGE_INFO, *image_topics) if t in counts)

    def close(self) -> None:
        self.reader.close()

    def __iter__(self) -> Iterator[StereoImage]:
        return self.frames()

    def stamps(self) -> Stamps:
        """Stamps without skew, which is in `image_info`."""
        return Stamps(self.reader.stamps(topics.LEFT_IMAGE))

    def frames(self, start_ns: int | None = None, until_ns: int | None = None) -> Iterator[StereoImage]:
        """Frames with stamps in [start_ns, until_ns], without reading earlier ones.

        Raises:
            StereoSfmError: pixels that do not fit the calibration, or a damaged file.
        """
        first = None if start_ns is None else start_ns - _MARGIN_NS
        last = None if until_ns is None else until_ns + _MARGIN_NS
        for image in self._complete_frames(first, last):
            if until_ns is not None and image.stamp_ns > until_ns:
                return
            if start_ns is None or image.stamp_ns >= start_ns:
                self._check(image)
                yield image

    def _complete_frames(self, first_ns: int | None, last_ns: int | None) -> Iterator[StereoImage]:
        pending: dict[int, _Parts] = {}
        self._incomplete.begin()
        for record in self.reader.messages(_PARTS, first_ns, last_ns):
            self._add(pending.setdefault(record.sequence, _Parts()), record)
            yield from self._take(pending, _WAITING)
        yield from self._take(pending, 0, at_edge=first_ns is not None or bool(self.reader.truncated))
        self._incomplete.end()

    def _take(self, pending: dict[int, _Parts], waiting: int, at_edge: bool = False) -> Iterator[StereoImage]:
        """The complete frames at the front; a frame still incomplete after `waiting` others is skipped."""
        while pending:
            sequence = next(iter(pending))
            parts = pending[sequence]
            if not parts.complete() and len(pending) <= waiting:
                return
            del pending[sequence]
            if parts.complete():
                yield parts.image()
            elif not at_edge:
                self._incomplete.skip(f"frame {sequence} is incomplete and skipped")

    def _add(self, parts: _Parts, record: Record) -> None:
        try:
            if record.topic == topics.LEFT_IMAGE:
                parts.left = decode_image(record)
            elif record.topic == topics.RIGHT_IMAGE:
                parts.right = decode_image(record)
            elif record.topic == topics.DEPTH_IMAGE:
                parts.depth = decode_depth(record)
            elif record.topic == topics.IMAGE_INFO:
                parts.info = self._decode(record, ImageInfo)
            elif record.topic == topics.IMU:
                parts.imu.append(self._decode(record, ImuSample))
            else:
                parts.wheel.append(self._decode(record, WheelSample))
        except ValueError as error:
            log.warning("%s: %s of frame %d: %s", self.name, record.topic, record.sequence, error)

    def _decode(self, record: Record, cls: type[Any]) -> Any:
        if cls not in self._decoders:
            assert record.schema is not None
            self._decoders[cls] = schema.decoder(cls, record.schema.data)
        return self._decoders[cls](record.data)

    def _check(self, image: StereoImage) -> None:
        check_size(self.reader.path, "left", image.left, self.rig.left.size)
        if image.right is not None and self.rig.right is not None:
            check_size(self.reader.path, "right", image.right, self.rig.right.size)
