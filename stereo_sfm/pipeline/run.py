"""The one way into a run, whichever way its stages are wired."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from drivers.source import Source
from stereo_sfm.config import Config
from stereo_sfm.messages import Sink
from stereo_sfm.types import Frame


def run(source: Source, config: Config | None = None, sinks: Sequence[Sink] = ()) -> Iterator[Frame]:
    """Run on an open source in this process and yield a `Frame` for each image; the same input gives the same bits.

    `stereo_sfm.pipeline.processes.ProcessRun` does the same over processes.

    Args:
        source: an open source, as `drivers.source.open_source` gives it.
        config: what decides the result; the defaults when omitted.
        sinks: each gets every message of the run.
    """
    from stereo_sfm.pipeline.inline import run_inline

    return run_inline(source, config or Config(), sinks)
