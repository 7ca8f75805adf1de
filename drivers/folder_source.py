"""Base of dataset folders: a list of image files with stamps, a rig, and ground truth if available."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.drivers.source import BaseSource, Stamps
from stereo_sfm.drivers.text_file import nanoseconds
from stereo_sfm.drivers.unreadable import Unreadable
from stereo_sfm.drivers.used_bits import used_bits
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.input_file import read_bytes
from stereo_sfm.pixels import decode, decode_gray, eight_bits
from stereo_sfm.types import F32, U8, U16, ImuSamples, StereoImage, Trajectory

log = logging.getLogger("stereo_sfm")


@dataclass(frozen=True)
class FrameFiles:
    """The files of one frame."""

    stamp_ns: int
    left: Path
    right: Path | None = None
    depth: Path | None = None
    exposure_us: float = float("nan")
    right_stamp_ns: int = 0  # 0: same as the left


class UnreadableImage(Exception):
    """A file that is missing or that OpenCV cannot decode: the frame is dropped, the run goes on."""


def read_gray(path: Path) -> U8 | U16:
    """One image as (H, W) grey with the depth of the file.

    Raises:
        UnreadableImage: missing, or not decodable.
    """
    try:
        return decode_gray(read_bytes(path))
    except OSError:
        raise UnreadableImage(str(path)) from None
    except ValueError as error:
        raise UnreadableImage(f"{path} ({error})") from None


def read_depth(path: Path, scale: float) -> F32:
    """A sixteen-bit depth image as (H, W) f32 metres, NaN where it holds 0 or, as 7-Scenes' do, the largest number.

    Args:
        path: the file.
        scale: stored units per metre.

    Raises:
        UnreadableImage: missing, or not decodable.
    """
    try:
        image = decode(read_bytes(path), cv2.IMREAD_UNCHANGED)
    except (OSError, ValueError):
        raise UnreadableImage(str(path)) from None
    if image.ndim != 2:
        raise UnreadableImage(str(path))
    depth = image.astype(np.float32)
    depth[(image == 0) | (image == np.iinfo(np.uint16).max)] = np.nan
    depth /= np.float32(scale)
    return depth


class FolderSource(BaseSource):
    """Frames from files. A frame with an unreadable file is dropped with a warning and counted."""

    def __init__(
        self,
        name: str,
        rig: Rig,
        frames: Sequence[FrameFiles],
        ground_truth: Trajectory | None = None,
        depth_scale: float = 5000.0,
        imu: ImuSamples | None = None,
    ) -> None:
        """Args:
        name: for messages. rig: calibration of the images.
        frames: in their order, which numbers in names tell where a clock was set back while they were taken.
        ground_truth: world_T_cam0.
        depth_scale: stored units of a depth image per metre.
        imu: all inertial samples, ascending: each goes with the frame that ends its interval.
        """
        if not frames:
            raise StereoSfmError(f"{name}: its list names no images")
        nanoseconds([s for frame in frames for s in (frame.stamp_ns, frame.right_stamp_ns)], name)
        self.name = name
        self.rig = rig
        self.ground_truth = ground_truth
        self.frames = list(frames)
        self.depth_scale = depth_scale
        self.assumed_hz = 0.0  # of frames whose stamps nothing tells
        self._imu = imu
        self.frame_count = len(self.frames)
        self.bits = used_bits(name, self._sample)
        self._check_first()

    def __iter__(self) -> Iterator[StereoImage]:
        dropped, read, sampled = 0, 0, 0
        unreadable = Unreadable(self.name, "frames could not be read")
        if self.assumed_hz:
            log.warning(
                "%s: neither names nor times.txt give the stamps: %g images a second assumed (?fps=N)",
                self.name, self.assumed_hz,
            )  # fmt: skip
        for frame_id, frame in enumerate(self.frames):
            try:
                image = self._read(frame_id, frame, dropped)
            except UnreadableImage as error:
                dropped += 1
                unreadable.skip(f"cannot read {error}, frame {frame_id} is dropped")
                continue
            dropped = 0
            read += 1
            if self._imu is not None:
                until = int(np.searchsorted(self._imu.stamp_ns, frame.stamp_ns, side="right"))
                image, sampled = replace(image, imu=self._imu.part(slice(sampled, until))), until
            yield image
        unreadable.end()
        if not read:
            raise StereoSfmError(
                f"{self.name}: none of the {len(self.frames)} images can be read: copy or export them again"
            )

    def _read(self, frame_id: int, frame: FrameFiles, dropped: int) -> StereoImage:
        left = eight_bits(read_gray(frame.left), self.bits)
        right = eight_bits(read_gray(frame.right), self.bits) if frame.right is not None else None
        depth = read_depth(frame.depth, self.depth_scale) if frame.depth is not None else None
        self._check_size(frame.left, left, self.rig.left.size)
        if right is not None and self.rig.right is not None:
            self._check_size(frame.right, right, self.rig.right.size)
        if depth is not None:
            self._check_size(frame.depth, depth, self.rig.left.size)
        return StereoImage(
            frame_id,
            frame.stamp_ns,
            left,
            right,
            depth,
            right_stamp_ns=frame.right_stamp_ns if frame.right_stamp_ns != frame.stamp_ns else 0,
            exposure_us=frame.exposure_us,
            dropped_before=dropped,
        )

    def at(self, positions: Sequence[int]) -> Iterator[StereoImage]:
        for position in positions:
            with suppress(UnreadableImage):
                yield self._read(position, self.frames[position], 0)

    def stamps(self) -> Stamps:
        skews = [abs(s.right_stamp_ns - s.stamp_ns) for s in self.frames if s.right_stamp_ns]
        skew_ms = max(skews) / 1e6 if skews else float("nan")
        others = {} if self._imu is None else {"imu0": self._imu.stamp_ns}
        return Stamps(np.array([s.stamp_ns for s in self.frames], np.int64), skew_ms, others, self.assumed_hz)

    def _sample(self, count: int) -> Iterator[Any]:
        """The readable images of so many evenly spaced frames."""
        for i in sorted({k * (len(self.frames) - 1) // max(count - 1, 1) for k in range(count)}):
            for path in (self.frames[i].left, self.frames[i].right):
                with suppress(UnreadableImage):
                    if path is not None:
                        yield read_gray(path)

    def _check_first(self) -> None:
        """Raises StereoSfmError before the first frame if the images do not match the calibration."""
        try:
            self._read(0, self.frames[0], 0)
        except UnreadableImage:
            return

    def _check_size(self, path: Path | None, image: U8 | F32, size: tuple[int, int]) -> None:
        height, width = image.shape
        if (width, height) != size:
            raise StereoSfmError(
                f"{path} is {width}x{height} but the calibration is for {size[0]}x{size[1]}: "
                "use the calibration of these images (--rig FILE)"
            )


def by_stamp(frames: Iterable[FrameFiles]) -> list[FrameFiles]:
    """In stamp order, where nothing else tells an order."""
    return sorted(frames, key=lambda frame: frame.stamp_ns)


def folder_of(name: str, path: str) -> Path:
    """The folder given by the user.

    Raises:
        StereoSfmError: it does not exist.
    """
    folder = Path(path).expanduser()
    if not folder.is_dir():
        raise StereoSfmError(f"{name}: no folder {path or '(none given)'}")
    return folder


def need(path: Path, what: str) -> Path:
    """`path`, which must exist.

    Raises:
        StereoSfmError: it does not; `what` describes it.
    """
    if not path.exists():
        raise StereoSfmError(f"no {what} at {path}")
    return path
