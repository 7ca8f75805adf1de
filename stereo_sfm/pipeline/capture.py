"""The capture process: it owns the driver and the image ring."""

from __future__ import annotations

import contextlib
import threading
import time
from collections import deque
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait

from calib.rig import Rig
from drivers.source import Source
from stereo_sfm.pipeline.channels import End, Outbox
from stereo_sfm.pipeline.health import HealthMeter
from stereo_sfm.pipeline.images import ImageRing, SlotImage
from stereo_sfm.pipeline.stages import sensor_drop, source_counters
from stereo_sfm.types import Dropped, StereoImage, Trajectory


@dataclass(frozen=True, eq=False)
class SourceInfo:
    """What the others need to know of the source before the first frame."""

    name: str
    rig: Rig
    ground_truth: Trajectory | None
    frame_count: int | None
    live: bool


class FreeSlots:
    """Which slots of the ring are free: every reader gives each slot back once."""

    def __init__(self, count: int, readers: list[Connection]) -> None:
        self._readers = list(readers)
        self._out = [0] * count
        self._free = deque(range(count))

    def take(self, block: bool) -> int | None:
        """A free slot; None when there is none and `block` is False, or when no reader is left."""
        self._collect(0)
        while not self._free:
            if not block or not self._readers:
                return None
            self._collect(None)
        slot = self._free.popleft()
        self._out[slot] = len(self._readers)
        return slot

    def _collect(self, timeout: float | None) -> None:
        for connection in wait(self._readers, timeout):
            assert isinstance(connection, Connection)
            try:
                slot: int = connection.recv()
            except (EOFError, OSError):
                self._readers.remove(connection)
                continue
            self._out[slot] -= 1
            if self._out[slot] == 0:
                self._free.append(slot)


class StopFlag:
    """Set when main says stop, or is gone: a thread waits for it."""

    def __init__(self, control: Connection, asked: bool = False) -> None:
        self.asked = asked
        self._control = control
        threading.Thread(target=self._wait, daemon=True).start()

    def _wait(self) -> None:
        with contextlib.suppress(EOFError, OSError):
            self._control.recv()
        self.asked = True


@dataclass
class CaptureStage:
    """Reads the source into the ring and tells the tracker and main."""

    source: Source
    ring: ImageRing
    slots: FreeSlots
    to_tracker: Outbox
    to_main: Outbox
    stop: StopFlag
    realtime: bool
    jpeg: bool
    _last: int = -1  # frame id

    def run(self) -> None:
        """Until the source ends or somebody asks to stop."""
        try:
            self._read()
        finally:
            self._count(self._last)  # above all when the source failed
            self.to_tracker.send(End("capture"))  # what was read until then is finished
            self.to_tracker.close()

    def _read(self) -> None:
        meter = HealthMeter("capture", self.to_main.send)
        for image in self.source:
            if self.stop.asked:
                break
            begin = time.monotonic()
            drop = sensor_drop(image)
            if drop is not None:
                self.to_main.send(drop)
            slot = self.slots.take(block=not self.realtime)
            if slot is None:
                meter.dropped += 1
                self.to_main.send(Dropped(image.frame_id, image.stamp_ns, "ring", "no free slot: a stage is too slow"))
                continue
            message = self._put(slot, image, begin)
            self.to_tracker.send(message)
            self.to_main.send(message)
            self._last = image.frame_id
            if meter.add(self._last, (time.monotonic() - begin) * 1e3, self.to_tracker.waiting()):
                self._count(self._last)
        meter.report()

    def _count(self, frame_id: int) -> None:
        """Tell what the source has counted until now."""
        counters = source_counters(self.source, frame_id)
        if counters is not None:
            self.to_main.send(counters)

    def _put(self, slot: int, image: StereoImage, begin: float) -> SlotImage:
        if not self.jpeg:
            return self.ring.write(slot, image, begin)
        from stereo_sfm.log.images import encode_pair

        logged = encode_pair(image, "jpeg")
        return self.ring.write(slot, logged.image, begin, (logged.left, logged.right))
