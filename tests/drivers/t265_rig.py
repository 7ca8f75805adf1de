"""A simulated T265 on a simulated bus with the real driver on top, for the tests of this folder."""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import Any

import numpy as np

from stereo_sfm.drivers.live.source import Patience
from stereo_sfm.drivers.sim.rigs import fisheye
from stereo_sfm.drivers.t265.acquire import Access
from stereo_sfm.drivers.t265.camera import Settings
from stereo_sfm.drivers.t265.simulated.bus import SimulatedBus
from stereo_sfm.drivers.t265.simulated.camera import SimulatedCamera
from stereo_sfm.drivers.t265.simulated.content import Content
from stereo_sfm.drivers.t265.simulated.faults import Faults
from stereo_sfm.drivers.t265.simulated.source import FAST, SimulatedT265Source, checked_firmware
from stereo_sfm.types import F64, StereoImage


@functools.cache
def noise_content(frames: int = 6) -> Content:
    """Images that differ in every pixel, so that no frame can pass for another."""
    rng = np.random.default_rng(5)
    images = [
        (rng.integers(0, 256, (800, 848), np.uint8), rng.integers(0, 256, (800, 848), np.uint8)) for _ in range(frames)
    ]

    def still(seconds: F64) -> F64:
        return np.broadcast_to(np.eye(4), (len(seconds), 4, 4))

    return Content(fisheye(), images, still)


def open_camera(
    faults: Faults | None = None,
    content: Content | None = None,
    paced: bool = True,
    booted: bool = False,
    **options: Any,
) -> SimulatedT265Source:
    """The driver on a camera with these faults."""
    camera = SimulatedCamera(content or noise_content(), faults, paced)
    camera.booted = booted
    timing = replace(FAST, **options.pop("timing", {}))
    patience = Patience(**{"reconnect_s": 1.0, **options.pop("patience", {})})
    settings, queue = options.pop("settings", Settings()), options.pop("queue", 30)
    access = Access(SimulatedBus([camera]), firmware=checked_firmware, timing=timing, **options)
    return SimulatedT265Source(camera, access, settings, patience, queue)


def take(source: SimulatedT265Source, count: int) -> list[StereoImage]:
    """The next images; fewer when the source ends."""
    out: list[StereoImage] = []
    for image in source:
        out.append(image)
        if len(out) == count:
            break
    return out
