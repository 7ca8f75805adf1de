"""The capture process, with stages that are too slow."""

from __future__ import annotations

from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import numpy as np

from stereo_sfm.drivers.memory import MemorySource
from stereo_sfm.drivers.source import open_source
from stereo_sfm.pipeline.capture import CaptureStage
from stereo_sfm.types import Dropped, StereoImage


def test_samples_of_an_image_without_a_slot_come_with_the_next() -> None:
    """Inertial samples are integrated from image to image: where some are missing, nothing is known any more."""
    with open_source("sim:loop?size=212x200&rate=10&frames=5&imu=t265&wheel=differential") as source:
        rig, images = source.rig, list(source)
    written, told, free = list[StereoImage](), list[Any](), iter([(0, True), None, None, (0, True), (0, True)])

    def write(slot: int, image: StereoImage, begin: float, encoded: Any = None, logged: bool = True) -> int:
        written.append(image)
        return slot

    nothing = SimpleNamespace(send=told.append, close=nullcontext, waiting=lambda: 0)
    pulse = SimpleNamespace(begin=nullcontext, end=nullcontext)
    slots = SimpleNamespace(take=lambda block: next(free))
    stage: Any = CaptureStage(
        MemorySource(rig, images), SimpleNamespace(write=write), slots, nothing, nothing, pulse,  # type: ignore[arg-type]
        SimpleNamespace(requested=False), realtime=True, jpeg=False,  # type: ignore[arg-type]
    )  # fmt: skip
    stage.run()
    assert [image.frame_id for image in written] == [0, 3, 4]
    assert [drop.frame_id for drop in told if isinstance(drop, Dropped)] == [1, 2]
    for kind in ("imu", "wheel"):
        all_of_them = np.concatenate([getattr(image, kind).stamp_ns for image in images if getattr(image, kind)])
        passed_on = np.concatenate([getattr(image, kind).stamp_ns for image in written if getattr(image, kind)])
        np.testing.assert_array_equal(passed_on, all_of_them)
