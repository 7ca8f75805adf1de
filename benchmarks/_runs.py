"""Recorded runs of the system on a source, as most benchmarks need them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import cv2

from stereo_sfm.config import Config
from stereo_sfm.drivers.select import SelectedFrames
from stereo_sfm.drivers.source import Source, open_source
from stereo_sfm.eval.record import RunRecord
from stereo_sfm.pipeline.inline import InlineRun
from stereo_sfm.pipeline.run import run
from stereo_sfm.types import StereoImage, Trajectory

ODOMETRY_ONLY = ("mapper.enabled=false", "loop.enabled=false")  # settings


def recorded(source: Source, config: Config) -> RunRecord:
    """What a run on all images of an open source recorded."""
    record = RunRecord.of(config)
    cv2.setRNGSeed(0)
    for _ in run(source, config, [record]):
        pass
    return record


def recorded_of(spec: str, config: Config, max_frames: int | None = None) -> tuple[RunRecord, Trajectory | None]:
    """The record of a run on a source given by its name, and its ground truth."""
    with SelectedFrames(open_source(spec), max_frames=max_frames) as source:
        return recorded(source, config), source.ground_truth


def recorded_together(
    source: Source, configs: Sequence[Config], images: Iterable[StereoImage] | None = None
) -> list[RunRecord]:
    """The records of several runs on each image in turn: a simulated source is rendered once.

    `images`: those to run on instead of all images of the source.
    """
    records = [RunRecord.of(config) for config in configs]
    runs = [InlineRun(source, config, [record]) for config, record in zip(configs, records, strict=True)]
    cv2.setRNGSeed(0)
    for image in source if images is None else images:
        for one in runs:
            one.step(image)
    for one in runs:
        one.finish()
    return records
