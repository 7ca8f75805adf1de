"""The capture process: it owns the driver and the image ring."""

from __future__ import annotations

import contextlib
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator, Set
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait

from stereo_sfm.calib.rig import Rig
from stereo_sfm.drivers.ascending import ascending
from stereo_sfm.drivers.checked_samples import checked_samples
from stereo_sfm.drivers.source import Source
from stereo_sfm.drivers.start_checked import RigChanged
from stereo_sfm.pipeline.channels import End, Outbox, pickled
from stereo_sfm.pipeline.depth_stage import IDLE, DepthSchedule
from stereo_sfm.pipeline.health import HealthMeter
from stereo_sfm.pipeline.images import ImageRing, SlotImage
from stereo_sfm.pipeline.stages import sensor_drop, source_counters, start_check
from stereo_sfm.pipeline.watchdog import HeartbeatThread
from stereo_sfm.types import LEFT_OUT, Dropped, StartCheck, StereoImage, Trajectory


@dataclass(frozen=True, eq=False)
class SourceInfo:
    """What the other stages need to know about the source before the first frame."""

    name: str
    rig: Rig
    ground_truth: Trajectory | None
    frame_count: int | None
    live: bool
    given_rig: Rig  # before a start check corrected it
    modules: tuple[str, ...] = ()  # that were loaded to open it

    @staticmethod
    def of(source: Source, before: Set[str] | None = None) -> SourceInfo:
        """Of an open source. Args: before, modules that were loaded before it was opened."""
        given = getattr(source, "given_rig", source.rig)
        modules = tuple(name for name in list(sys.modules) if before is not None and name not in before)
        return SourceInfo(source.name, source.rig, source.ground_truth, source.frame_count, source.live, given, modules)


@dataclass(frozen=True)
class OpenAgain:
    """A live camera's first images contradict the calibration: the run begins again with what they fit."""

    check: StartCheck


TRACKER_SLOTS = 4  # of the ring, reserved from the log in real time


class FreeSlots:
    """The free slots of the ring: the tracker and the log (or main in its place) return each slot.

    Live depth returns those that it was lent, and says when it can take another.
    """

    def __init__(self, count: int, tracker: Connection, log: Connection, depth: Connection | None = None) -> None:
        self._holds: dict[Connection, set[int]] = {tracker: set(), log: set()}
        if depth is not None:
            self._holds[depth] = set()
        self._tracker, self._log, self._depth = tracker, log, depth
        self._depth_idle = False  # it says so when it has loaded its code
        self._free = deque(range(count))
        self._log_share = max(count - TRACKER_SLOTS, 1)

    def take(self, block: bool) -> tuple[int, bool] | None:
        """A free slot for the tracker, and whether it is for the log as well; None if none is available.

        Args:
            block: wait for a slot (files) and omit nothing from the log; otherwise the log holds no more
                than its share of the slots, so that the tracker never waits for it.
        """
        self._collect(0)
        while not self._free:
            if not block or not self._holds:
                return None
            self._collect(None)
        slot, logged = self._free.popleft(), self._log in self._holds
        if not block:
            logged = logged and len(self._holds[self._log]) < self._log_share
        for reader in (self._tracker, self._log) if logged else (self._tracker,):
            if reader in self._holds:
                self._holds[reader].add(slot)
        return slot, logged

    def lend(self, slot: int, busy: bool) -> bool:
        """Whether live depth gets the slot that was taken last. Args: busy, also while it computes (files)."""
        depth = self._depth
        if depth is None or depth not in self._holds or not (self._depth_idle or busy):
            return False
        self._holds[depth].add(slot)
        self._depth_idle = False
        return True

    def _collect(self, timeout: float | None) -> None:
        while ready := wait(list(self._holds), timeout):
            timeout = 0
            for connection in ready:
                assert isinstance(connection, Connection)
                self._take_back(connection)

    def _take_back(self, connection: Connection) -> None:
        try:
            back: set[int] = {connection.recv()}
            if back == {IDLE}:
                self._depth_idle = True
                return
            self._holds[connection] -= back
        except (EOFError, OSError):
            back = self._holds.pop(connection)  # a dead reader reads its slots no more
        self._free.extend(sorted(k for k in back if not any(k in held for held in self._holds.values())))


class StopFlag:
    """Set by a thread when main sends stop or has ended."""

    def __init__(self, control: Connection, requested: bool = False) -> None:
        self.requested = requested
        self._control = control
        threading.Thread(target=self._wait, daemon=True).start()

    def _wait(self) -> None:
        with contextlib.suppress(EOFError, OSError):
            self._control.recv()
        self.requested = True


@dataclass
class CaptureStage:
    """Reads the source into the ring and notifies the tracker and main."""

    source: Source
    ring: ImageRing
    slots: FreeSlots
    to_tracker: Outbox
    to_main: Outbox
    pulse: HeartbeatThread
    stop: StopFlag
    realtime: bool
    jpeg: bool
    to_depth: Outbox | None = None
    depth: DepthSchedule | None = None  # which images it gets
    _last: int = -1  # frame id

    def run(self) -> None:
        """Run until the source ends or a stop is requested."""
        try:
            self._read()
        except RigChanged as found:
            self.to_main.send(OpenAgain(found.check))
        finally:
            self._count(self._last)  # also when the source failed
            self.to_tracker.send(End("capture"))  # what was read so far is processed
            self.to_tracker.close()
            if self.to_depth is not None:
                self.to_depth.send(End("capture"))
                self.to_depth.close()

    def _read(self) -> None:
        meter = HealthMeter("capture", self.to_main.send)
        left_out: deque[StereoImage] = deque(maxlen=LEFT_OUT)
        for image in self._images():
            if self.stop.requested:
                break
            begin = time.monotonic()
            drop = sensor_drop(image)
            if drop is not None:
                self.to_main.send(drop)
            free = self.slots.take(block=not self.realtime)
            if free is None:
                meter.dropped += 1
                self.to_main.send(Dropped(image.frame_id, image.stamp_ns, "ring", "no free slot: a stage is too slow"))
                left_out.append(image.without_pixels())
                continue
            message = pickled(self._put(*free, image.following(left_out), begin))
            left_out.clear()
            self.to_tracker.send(message)
            self.to_main.send(message)
            self._send_depth(image, free[0], message)
            self._last = image.frame_id
            if meter.add(self._last, (time.monotonic() - begin) * 1e3, self.to_tracker.waiting()):
                self._count(self._last)
        meter.report()

    def _images(self) -> Iterator[StereoImage]:
        """The images of the source; the watchdog measures how long each takes."""
        self.pulse.begin()
        images = checked_samples(ascending(self.source, self.source.name))
        self.pulse.end()
        checked = start_check(self.source)
        if checked is not None:
            self.to_main.send(checked)
        while True:
            self.pulse.begin()
            image = next(images, None)
            self.pulse.end()
            if image is None:
                return
            yield image

    def _send_depth(self, image: StereoImage, slot: int, message: bytes) -> None:
        """Live depth gets the images that its schedule wants; a camera's images do not wait for it."""
        if self.to_depth is None or self.depth is None or not self.depth.due(image):
            return
        if self.slots.lend(slot, busy=not self.realtime):
            self.depth.taken(image)
            self.to_depth.send(message)

    def _count(self, frame_id: int) -> None:
        """Send the source's counters."""
        counters = source_counters(self.source, frame_id)
        if counters is not None:
            self.to_main.send(counters)

    def _put(self, slot: int, logged: bool, image: StereoImage, begin: float) -> SlotImage:
        if not self.jpeg:
            return self.ring.write(slot, image, begin, logged=logged)
        from stereo_sfm.log.images import encode_pair

        encoded = encode_pair(image, "jpeg")
        return self.ring.write(slot, encoded.image, begin, (encoded.left, encoded.right), logged=logged)
