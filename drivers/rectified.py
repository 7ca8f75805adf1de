"""A source seen through a rectification: the same frames, the rectified rig."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from types import TracebackType
from typing import Self

from calib.rectification import PROJECTIONS, rectify
from drivers.source import Source
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.types import StereoImage, Trajectory


class RectifiedSource:
    """Wraps a source and is entered with it; `rig`, images and ground truth are those of the rectified pair."""

    def __init__(
        self,
        source: Source,
        projection: str = "epipolar",
        hfov_deg: float | None = None,
        size: tuple[int, int] | None = None,
    ) -> None:
        self._source, self._how = source, (projection, hfov_deg, size)
        self._adopt()

    def _adopt(self) -> None:
        source = self._source
        self._source_rig = source.rig
        self.rectification = rectify(source.rig, *self._how)
        self.rig = self.rectification.rig
        self.name = source.name
        self.frame_count = source.frame_count
        self.live = source.live
        truth = source.ground_truth
        self.ground_truth = None if truth is None else self._turned(truth)

    def _turned(self, truth: Trajectory) -> Trajectory:
        return Trajectory(truth.stamp_ns.copy(), truth.poses @ self.rectification.cam_T_rect)

    @property
    def counters(self) -> dict[str, float]:
        """What a live source counts about itself (drivers.live.counters); empty for files."""
        return getattr(self._source, "counters", {})

    def __enter__(self) -> Self:
        self._source.__enter__()
        if self._source.rig is not self._source_rig:
            self._adopt()  # a camera tells its calibration when it is open
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._source.__exit__(kind, error, trace)

    def __iter__(self) -> Iterator[StereoImage]:
        for image in self._source:
            if image.right is None:
                raise StereoSfmError(f"frame {image.frame_id} of {self.name} has no right image to rectify")
            left, right = self.rectification.apply(image.left, image.right)
            yield replace(image, left=left, right=right)


def rectified(
    source: Source,
    projection: str = "none",
    hfov_deg: float | None = None,
    size: tuple[int, int] | None = None,
) -> Source:
    """The source itself for "none", else the source through that rectification."""
    if projection not in PROJECTIONS:
        raise StereoSfmError(f"unknown projection '{projection}' (choose {', '.join(PROJECTIONS)})")
    return source if projection == "none" else RectifiedSource(source, projection, hfov_deg, size)
