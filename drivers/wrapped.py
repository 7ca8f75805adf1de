"""Base of sources that wrap another source."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from types import TracebackType
from typing import Self

from stereo_sfm.calib.rig import Rig
from stereo_sfm.drivers.source import Source, Stamps, chosen_frames
from stereo_sfm.types import StartCheck, StereoImage, Trajectory


class WrappedSource:
    """Another source, entered and left with this one; subclasses override what differs."""

    def __init__(self, source: Source) -> None:
        self.source = source

    @property
    def name(self) -> str:
        return self.source.name

    @property
    def rig(self) -> Rig:
        return self.source.rig

    @property
    def ground_truth(self) -> Trajectory | None:
        return self.source.ground_truth

    @property
    def frame_count(self) -> int | None:
        return self.source.frame_count

    @property
    def live(self) -> bool:
        return self.source.live

    @property
    def counters(self) -> Mapping[str, float]:
        return self.source.counters

    @property
    def start_check(self) -> StartCheck | None:
        """What the first images said about the calibration, where they were compared with it and contradict it."""
        return getattr(self.source, "start_check", None)

    @property
    def given_rig(self) -> Rig:
        """The calibration before a start check corrected it."""
        known = self.start_check is not None
        return self.source.given_rig if known and isinstance(self.source, WrappedSource) else self.rig

    def other_reading(self) -> tuple[str, Rig] | None:
        return self.source.other_reading()

    def stamps(self) -> Stamps | None:
        """The stamps of the frames passed on: unknown in advance, unless a subclass knows them."""
        return None

    def at(self, positions: Sequence[int]) -> Iterator[StereoImage]:
        return chosen_frames(iter(self), positions)

    def __enter__(self) -> Self:
        self.source.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.source.__exit__(kind, error, trace)

    def __iter__(self) -> Iterator[StereoImage]:
        return iter(self.source)
