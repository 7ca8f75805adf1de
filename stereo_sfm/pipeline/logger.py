"""The process that writes the log. It owns the file, and closes it whatever happens to the other processes."""

from __future__ import annotations

import contextlib
import queue
import threading
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.log.images import LoggedImage
from stereo_sfm.log.run_log import LeftOut, RunLog
from stereo_sfm.log.writer import LogWriter
from stereo_sfm.messages import LogEnded
from stereo_sfm.pipeline.channels import End, Inbox, Lost, Outbox
from stereo_sfm.pipeline.child import Report, Setup, prepare
from stereo_sfm.pipeline.images import ImageLayout, ImageRing, SlotImage

BACKLOG = 96  # messages, about a third of them images, that wait in this process for a slow disk


@dataclass(frozen=True)
class LogOptions:
    """The file of a run's log and what it contains."""

    path: Path
    image_format: str = "png"  # png | raw | jpeg | none


class LogSink:
    """A log that may end before its run does: a full disk is reported once, and later messages are ignored."""

    def __init__(self, log: RunLog, report: Callable[[LogEnded], None]) -> None:
        self._log, self._report = log, report
        self._ended = False

    def put(self, message: object) -> None:
        """Take any message of a run."""
        if not self._ended and not isinstance(message, LogEnded):
            self._attempt(lambda: self._log.put(message))

    def close(self, *, early: bool = False) -> None:
        """See `RunLog.close`."""
        if not self._ended:
            self._attempt(lambda: self._log.close(early=early))

    def _attempt(self, action: Callable[[], None]) -> None:
        try:
            action()
        except StereoSfmError as error:
            if not self._log.refused:
                raise
            self._ended = True
            self._report(LogEnded(str(error)))


def run_logger(
    to_main: Report, control: Connection, messages: Connection, release: Connection, options: LogOptions
) -> None:
    """Write the messages from main to the MCAP file."""
    setup = Inbox[Setup](control).take()
    prepare("logger", setup)
    ring = ImageRing(ImageLayout.of(setup.rig), setup.config.pipeline.ring_slots, setup.ring_name)
    writer = LogWriter(options.path, compress=options.image_format != "raw")
    log = RunLog(
        writer, setup.rig, setup.config, source=setup.source_name, mode="realtime" if setup.realtime else "lockstep",
        image_format=options.image_format, ground_truth=setup.ground_truth, opening=setup.opening,
    )  # fmt: skip
    sink = LogSink(log, to_main.send)
    arrived: queue.Queue[Any] = queue.Queue(BACKLOG)
    receiver = _Receiver(Inbox(messages), ring, Outbox(release), options.image_format != "none")
    threading.Thread(target=receiver.run, args=(arrived,), daemon=True).start()
    early = True
    try:
        while not isinstance(message := arrived.get(), End):
            to_main.pulse.begin()
            sink.put(message)
            to_main.pulse.end()
        early = message.early
    finally:
        sink.close(early=early)


class _Receiver:
    """Receives messages at once, so that a slow disk does not hold slots of the ring."""

    def __init__(self, inbox: Inbox[Any], ring: ImageRing, free: Outbox, pixels: bool) -> None:
        self._inbox, self._ring, self._free, self._pixels = inbox, ring, free, pixels

    def run(self, arrived: queue.Queue[Any]) -> None:
        """Run until main sends `End` or has ended; what has arrived is kept."""
        message: Any = None
        while not isinstance(message, End):
            message = End("main", early=True)
            with contextlib.suppress(Lost):
                message = self._inbox.take()
            arrived.put(self._image(message) if isinstance(message, SlotImage) else message)

    def _image(self, message: SlotImage) -> object:
        if not message.logged:
            return LeftOut(message.image)
        if not self._pixels:
            self._free.send(message.slot)
            return message.image
        image = self._ring.read(message)
        self._free.send(message.slot)
        if message.encoded is not None:
            return LoggedImage(image, *message.encoded, "jpeg")
        return image
