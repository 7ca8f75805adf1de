"""Main's side of the logger: messages go to it without waiting, and its file is closed whatever happens to it."""

from __future__ import annotations

import contextlib
import logging
import time
from multiprocessing.connection import Connection

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.pipeline.channels import End, Outbox
from stereo_sfm.pipeline.logger import LogOptions
from stereo_sfm.pipeline.stage_processes import StageProcesses
from stereo_sfm.types import Dropped, StereoImage

log = logging.getLogger("stereo_sfm")

BACKLOG = 20_000  # messages waiting for the logger in real time, beyond which the log is given up
GRACE_S = 1.2  # time for the logger to close its file after another stage died
STAGE = "logger"


class LoggerLink:
    """The process named "logger" of a run."""

    def __init__(self, options: LogOptions, connection: Connection, stages: StageProcesses) -> None:
        """Args: options, of the log; connection, to the logger; stages, with its process."""
        self._options, self._connection, self._stages = options, connection, stages
        self._outbox: Outbox | None = None
        self._omits = False  # images have been omitted

    def open(self, realtime: bool) -> None:
        """Send messages from now on; in real time, at most `BACKLOG` may wait."""
        self._outbox = Outbox(self._connection, BACKLOG if realtime else 0)

    @property
    def is_open(self) -> bool:
        """Whether messages are logged."""
        return self._outbox is not None

    def put(self, message: object) -> bool:
        """Send a message, or one that is pickled, without waiting; False if too many wait.

        The slots that the logger holds make a run wait.
        """
        return self._outbox is not None and self._outbox.offer(message, 0.0)

    def omitted(self, image: StereoImage) -> Dropped | None:
        """What is logged about an image for which the logger has no slot."""
        if not self.is_open or self._options.image_format == "none":
            return None
        if not self._omits:
            log.warning("the log is slower than the camera: some of the images are omitted")
        self._omits = True
        return Dropped(image.frame_id, image.stamp_ns, "log", "the log is slower than the camera")

    def end(self) -> None:
        """After the last message of the run."""
        if self._outbox is not None:
            self._outbox.send(End("main"))

    def end_early(self) -> None:
        """Another stage has died: let the logger close its file, or close it here."""
        if self._outbox is None:
            return
        process, until = self._stages.processes[STAGE], time.monotonic() + GRACE_S
        if process.is_alive():
            self._stages.resume(STAGE)
            self._outbox.offer(End("main", early=True), GRACE_S)
        process.join(max(until - time.monotonic(), 0.0))
        self._close_file()

    def give_up(self, why: str) -> str:
        """End the logger while the run continues; returns what to report."""
        self._stages.forget(STAGE)
        self._close_file()
        self.close()
        return f"{why}: {self._options.path} ends here"

    def close(self) -> None:
        """Close the pipe to the logger, which has ended."""
        if self._outbox is not None:
            self._outbox.close()
            self._outbox = None
        self._connection.close()

    def remains(self, died: str) -> str:
        """What is left of the log after a stage has died."""
        path = self._options.path
        if died == STAGE and not path.exists():
            return "there is no log"
        if self._is_unfinished():
            return f"the log {path} is not closed, but readable (stereo-sfm recover writes a clean copy)"
        return f"the log {path} is complete up to that point"

    def _close_file(self) -> None:
        process = self._stages.processes[STAGE]
        if process.is_alive():
            process.kill()
        process.join()
        if process.exitcode != 0 and self._is_unfinished():
            from stereo_sfm.log.provenance import ENDED_EARLY, METADATA
            from stereo_sfm.log.repair import finish_in_place

            with contextlib.suppress(OSError, StereoSfmError):  # no room for its index: it is readable nevertheless
                finish_in_place(self._options.path, (METADATA, ENDED_EARLY))

    def _is_unfinished(self) -> bool:
        from stereo_sfm.log.scan import is_closed

        return self._options.path.exists() and not is_closed(self._options.path)
