"""Run the system on an open source from Python."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from stereo_sfm.config import Config
from stereo_sfm.drivers.source import Source
from stereo_sfm.drivers.wrapped import WrappedSource
from stereo_sfm.messages import Sink
from stereo_sfm.types import Frame, StereoImage


class CheckedSource(WrappedSource):
    """Any source, with its images checked and converted to what the stages take."""

    def __iter__(self) -> Iterator[StereoImage]:
        from stereo_sfm.pipeline.image_input import ImageInput

        return map(ImageInput(self.rig).checked, self.source)


def run(source: Source, config: Config | None = None, sinks: Sequence[Sink] = ()) -> Iterator[Frame]:
    """Run on an open source in this process and yield a `Frame` for each image; the same input gives the same bits.

    `stereo_sfm.pipeline.processes.ProcessRun` does the same over processes, `stereo_sfm.System` image by image.

    Args:
        source: an open source, as `stereo_sfm.drivers.source.open_source` gives it.
        config: what decides the result; the defaults when omitted.
        sinks: each gets every message of the run.

    Raises:
        StereoSfmError: an image that does not fit the source's calibration.
    """
    from stereo_sfm.pipeline.inline import run_inline

    return run_inline(CheckedSource(source), config or Config(), sinks)
