"""Live depth as every wiring runs it, and its process: it holds no slot of the ring while it computes."""

from __future__ import annotations

import logging
import time
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING, Protocol

from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import Config
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.messages import StageTimes
from stereo_sfm.pipeline.channels import End, Inbox, Lost, Outbox
from stereo_sfm.pipeline.child import Report, Setup, prepare
from stereo_sfm.pipeline.health import HealthMeter
from stereo_sfm.pipeline.images import ImageLayout, ImageRing, SlotImage
from stereo_sfm.types import StereoImage

if TYPE_CHECKING:
    from stereo_sfm.dense.live import LiveDepthMaker

IDLE = -1  # sent in place of a slot: it is ready for an image


class DepthSchedule(Protocol):
    """Which images get a depth."""

    def due(self, image: StereoImage) -> bool:
        """Whether this one does."""
        ...

    def taken(self, image: StereoImage) -> None:
        """It does."""
        ...


def depth_schedule(config: Config, rig: Rig, frame_ids: frozenset[int] | None) -> DepthSchedule | None:
    """The images that get a live depth: by the configured rate, or those of an earlier run; None: none do."""
    if not config.dense.live or rig.second_camera is None:
        return None
    from stereo_sfm.dense.live import Chosen, Paced

    return Paced(config.dense.rate_hz) if frame_ids is None else Chosen(frame_ids)


def make_depth(config: Config, rig: Rig) -> LiveDepthMaker | None:
    """What makes live depth; None, with a warning, of a camera that has none: the poses matter more."""
    if not config.dense.live:
        return None
    from stereo_sfm.dense.live import LiveDepthMaker

    try:
        return LiveDepthMaker(rig, config.dense)
    except StereoSfmError as error:
        logging.getLogger("stereo_sfm").warning("%s; the run goes on without it", error)
        return None


def run_depth(to_main: Report, control: Connection, images: Connection, release: Connection) -> None:
    """The process: pairs from capture to `LiveDepth`."""
    setup = Inbox[Setup](control).take()
    delay = prepare("dense", setup)
    ring = ImageRing(ImageLayout.of(setup.rig), setup.config.pipeline.ring_slots, setup.ring_name)
    inbox, free = Inbox[SlotImage | End](images), Outbox(release)
    maker = make_depth(setup.config, setup.rig)
    meter = HealthMeter("dense", to_main.send)
    free.send(IDLE)
    while isinstance(message := _next(inbox), SlotImage):
        to_main.pulse.begin()
        image = ring.read(message)
        free.send(message.slot)
        delay()
        begin = time.monotonic()
        found = None if maker is None else maker.step(image)
        if found is not None:
            to_main.send(found)
        ms = (time.monotonic() - begin) * 1e3
        to_main.send(StageTimes(image.frame_id, {"depth": ms}))
        meter.add(image.frame_id, ms)
        free.send(IDLE)
        to_main.pulse.end()
    meter.report()
    ring.close()


def _next(inbox: Inbox[SlotImage | End]) -> SlotImage | End:
    """A live camera's capture process may be killed at the end: that is no fault here."""
    try:
        return inbox.take()
    except Lost:
        return End("capture")
