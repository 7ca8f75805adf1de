"""A source seen through a rectification: the same frames, the rectified rig."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Self

from stereo_sfm.calib.rectification import PROJECTIONS, rectify
from stereo_sfm.calib.rig import Rig
from stereo_sfm.drivers.source import Source, Stamps
from stereo_sfm.drivers.wrapped import WrappedSource
from stereo_sfm.errors import StereoSfmError, one_of
from stereo_sfm.types import StereoImage, Trajectory


class RectifiedSource(WrappedSource):
    """Wraps a source and is entered with it; `rig`, images and ground truth are those of the rectified pair."""

    def __init__(
        self,
        source: Source,
        projection: str = "epipolar",
        hfov_deg: float | None = None,
        size: tuple[int, int] | None = None,
    ) -> None:
        super().__init__(source)
        self._how = (projection, hfov_deg, size)
        self._adopt()

    def _adopt(self) -> None:
        self._source_rig = self.source.rig
        self.rectification = rectify(self._source_rig, *self._how)

    @property
    def rig(self) -> Rig:
        return self.rectification.rig

    @property
    def ground_truth(self) -> Trajectory | None:
        truth = self.source.ground_truth
        if truth is None:
            return None
        return Trajectory(truth.stamp_ns.copy(), truth.poses @ self.rectification.cam_T_rect, truth.oriented)

    def __enter__(self) -> Self:
        super().__enter__()
        if self.source.rig is not self._source_rig:
            self._adopt()  # the calibration of a camera is known once it is open
        return self

    def other_reading(self) -> tuple[str, Rig] | None:
        return None  # images that were not rectified with it would not be what is asked for

    def stamps(self) -> Stamps | None:
        return self.source.stamps()

    def at(self, positions: Sequence[int]) -> Iterator[StereoImage]:
        return map(self._seen, self.source.at(positions))

    def __iter__(self) -> Iterator[StereoImage]:
        return map(self._seen, self.source)

    def _seen(self, image: StereoImage) -> StereoImage:
        if image.right is None:
            raise StereoSfmError(f"frame {image.frame_id} of {self.name} has no right image to rectify")
        left, right = self.rectification.apply(image.left, image.right)
        return replace(image, left=left, right=right)


def rectified(
    source: Source,
    projection: str = "none",
    hfov_deg: float | None = None,
    size: tuple[int, int] | None = None,
) -> Source:
    """The source itself for "none", else the rectified source."""
    one_of(projection, PROJECTIONS, "projection")
    return source if projection == "none" else RectifiedSource(source, projection, hfov_deg, size)
