"""Sends the segments of recordings to a bucket, behind the recorder: slowly, again after a failure, each file once.

The local SHA256SUMS of a recording lists what has arrived. When a recording is over and all of it is up, the file goes
up as well: a recording in a bucket with a SHA256SUMS is complete.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from pathlib import Path

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.input_file import read_bytes
from stereo_sfm.log.whole_file import being_written
from stereo_sfm.recording.segments import (
    RECORDING,
    SENT,
    SENT_END,
    Segment,
    add_sent,
    recordings,
    segments,
    sent_lines,
    sent_whole,
)
from stereo_sfm.storage import objects
from stereo_sfm.storage.folders import SUMS, Pace, send_file, sha256, sums_text
from stereo_sfm.storage.remote import Remote

log = logging.getLogger("stereo_sfm")

LOOK_S = 2.0  # between two looks for finished segments
FIRST_PAUSE_S, LONGEST_PAUSE_S = 5.0, 300.0  # after a failure, doubled each time


class Uploader:
    """Sends the recordings of a folder until it is stopped. Several of them on one folder only repeat work."""

    def __init__(
        self,
        root: Path,
        to: Remote,
        bytes_s: float = 0.0,
        current: Callable[[], Segment | None] = lambda: None,
        black_box: bool = False,
    ) -> None:
        """Args:
        root: of the recordings. to: a folder in a bucket. bytes_s: most bytes a second, 0: no limit.
        current: of a recording that goes on, if any: others of it follow. What is being written waits in any case.
        black_box: images are sent of marked segments alone.
        """
        self.root, self.to, self._pace, self._current = root, to, Pace(bytes_s), current
        self._black_box = black_box
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._work, name="upload", daemon=True)
        self.problem = ""

    def start(self) -> None:
        """In a thread of its own."""
        self._thread.start()

    def close(self) -> None:
        """Stop; what was being sent is sent again next time."""
        self._over.set()
        self._thread.join(2.0)

    def _work(self) -> None:
        pause_s = FIRST_PAUSE_S
        while not self._over.is_set():
            try:
                self.send_all()
                self.problem, pause_s = "", FIRST_PAUSE_S
                self._over.wait(LOOK_S)
            except InterruptedError:
                return
            except (StereoSfmError, OSError) as error:
                if str(error) != self.problem:
                    self.problem = str(error)
                    log.warning("recordings are not sent: %s; they wait in %s", error, self.root)
                self._over.wait(pause_s)
                pause_s = min(2 * pause_s, LONGEST_PAUSE_S)

    def send_all(self) -> int:
        """Send every finished segment that is not up yet, the oldest first.

        Returns:
            Files that were sent.

        Raises:
            StereoSfmError: a file cannot be sent; those before it are up.
        """
        count = 0
        for folder in recordings(self.root):
            current = self._current()
            over = current is None or current.folder != folder
            for segment in segments(folder):
                if segment == current or being_written(segment.poses) or being_written(segment.images):
                    over = False
                else:
                    count += self._send(segment)
            if over and not sent_whole(folder):
                self._finish(folder)
        return count

    def _send(self, segment: Segment) -> int:
        count = 0
        for path in segment.unsent(self._black_box):
            if not path.is_file():  # the quota has deleted it meanwhile
                continue
            digest = sha256(path)
            send_file(path, self.to / path.parent.name / path.name, self._pace, self._over.is_set)
            add_sent(segment.folder, sums_text({path.name: digest}))
            count += 1
        return count

    def _finish(self, folder: Path) -> None:
        """All of a recording is up."""
        sent = sent_lines(folder)
        if not sent:
            return
        about = folder / RECORDING
        if about.is_file():
            objects.write(self.to / folder.name / RECORDING, read_bytes(about))
        objects.write(self.to / folder.name / SUMS, sent)
        add_sent(folder, SENT_END)
        if not segments(folder):  # the quota has removed them meanwhile
            for path in (about, folder / SENT):
                path.unlink(missing_ok=True)
            folder.rmdir()
