"""Part of a source: start time, duration, frame step, maximum number of frames."""

from __future__ import annotations

from collections.abc import Iterator

from stereo_sfm.drivers.source import Source
from stereo_sfm.drivers.wrapped import WrappedSource
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.types import StereoImage

MAX_DURATION_S = 1e9  # of any source


class SelectedFrames(WrappedSource):
    """A source that passes on some frames of another one. Frames skipped on purpose do not count as dropped."""

    def __init__(
        self,
        source: Source,
        start_s: float = 0.0,
        duration_s: float = float("inf"),
        frame_skip: int = 1,
        max_frames: int | None = None,
    ) -> None:
        """Args:
        source: the source of the frames; it is entered and left with this one.
        start_s: seconds after the first frame at which the part begins.
        duration_s: seconds that the part lasts.
        frame_skip: 1 passes every frame, 3 every third.
        max_frames: maximum number of frames.
        """
        if frame_skip < 1 or not start_s >= 0 or not duration_s > 0 or (max_frames is not None and max_frames < 1):
            raise StereoSfmError(
                "invalid part of a source: frame skip and frames must be at least 1, and times above 0"
            )
        if start_s > MAX_DURATION_S:
            raise StereoSfmError(f"invalid part of a source: start {start_s:g} s after the first frame")
        super().__init__(source)
        self.start_ns = round(start_s * 1e9)
        self.end_ns = None if duration_s > MAX_DURATION_S else self.start_ns + round(duration_s * 1e9)
        self.frame_skip = frame_skip
        self.max_frames = max_frames

    @property
    def frame_count(self) -> int | None:
        """Upper bound of the number of frames; None if it depends on stamps not read yet."""
        count = self.source.frame_count
        if count is None or self.start_ns or self.end_ns is not None:
            return self.max_frames
        count = -(-count // self.frame_skip)
        return count if self.max_frames is None else min(self.max_frames, count)

    def __iter__(self) -> Iterator[StereoImage]:
        passed, seen, dropped, since = 0, 0, 0, 0
        left_out: list[StereoImage] = []  # since the last frame that was passed on
        first_ns: int | None = None
        for image in self.source:
            first_ns = image.stamp_ns if first_ns is None else first_ns
            since = image.stamp_ns - first_ns
            if self.end_ns is not None and since >= self.end_ns:
                break
            early = since < self.start_ns
            seen += not early
            if early or (seen - 1) % self.frame_skip:
                left_out.append(image.without_pixels())
                dropped += 0 if early else image.dropped_before
                continue
            yield image.following(left_out, dropped)
            dropped, left_out = 0, []
            passed += 1
            if passed == self.max_frames:
                return
        if first_ns is not None and not seen:
            until = "" if self.end_ns is None else f" until {self.end_ns * 1e-9:g} s"
            raise StereoSfmError(
                f"no frames selected of {self.name}: none from {self.start_ns * 1e-9:g} s on{until}, "
                f"the last one read is at {since * 1e-9:.2f} s"
            )
