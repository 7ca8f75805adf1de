"""A source for tests of the service: the sliding wall again and again, about 30 images a second."""

from __future__ import annotations

from stereo_sfm.drivers.repeated import RepeatedSource
from tests.pipeline.test_pipeline import SlidingWall


def endless_wall(frames: int = 400, slow_s: float = 0.03) -> RepeatedSource:
    return RepeatedSource(SlidingWall(frames, slow_s=slow_s))
