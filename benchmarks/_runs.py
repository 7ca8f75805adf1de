"""One recorded run of the system on a source, as most benchmarks need it."""

from __future__ import annotations

import cv2

from stereo_sfm.config import Config
from stereo_sfm.drivers.select import SelectedFrames
from stereo_sfm.drivers.source import Source, open_source
from stereo_sfm.eval.record import RunRecord
from stereo_sfm.pipeline.run import run
from stereo_sfm.types import Trajectory

ODOMETRY_ONLY = ("mapper.enabled=false", "loop.enabled=false")  # settings


def recorded(source: Source, config: Config) -> RunRecord:
    """What a run on all images of an open source recorded."""
    record = RunRecord.of(config)
    cv2.setRNGSeed(0)
    for _ in run(source, config, [record]):
        pass
    return record


def recorded_of(spec: str, config: Config, max_frames: int | None = None) -> tuple[RunRecord, Trajectory | None]:
    """The same of a source by its name, and its ground truth."""
    with SelectedFrames(open_source(spec), max_frames=max_frames) as source:
        return recorded(source, config), source.ground_truth
