"""The process that records: reads images from shared memory and messages from the service."""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass
from multiprocessing.connection import Connection

from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import Config
from stereo_sfm.errors import StereoSfmError, disk_is_full
from stereo_sfm.log.provenance import Opening
from stereo_sfm.pipeline.child import raise_priority
from stereo_sfm.pipeline.images import ImageLayout, ImageRing, SlotImage
from stereo_sfm.pipeline.watchdog import Heartbeat, HeartbeatThread
from stereo_sfm.recording.segment_recorder import Policy, RecorderState, SegmentRecorder
from stereo_sfm.recording.segment_writers import AGAIN_S, MESSAGES_WAITING
from stereo_sfm.recording.segments import Segment
from stereo_sfm.recording.upload import Uploader
from stereo_sfm.service.child import Send, run_child
from stereo_sfm.storage.remote import Remote
from stereo_sfm.types import StereoImage

STATE_S = 0.5
CLOSE_S = 2.0


@dataclass(frozen=True, eq=False)
class Begin:
    """A session begins: another recording."""

    policy: Policy
    rig: Rig
    config: Config
    source: str
    opening: Opening
    ring: tuple[ImageLayout, int, str]  # layout, slots, name


@dataclass(frozen=True)
class Mark:
    """Keep the recording around this moment."""

    text: str


@dataclass(frozen=True)
class Finish:
    """The session is over."""


@dataclass(frozen=True)
class Read:
    """An image was read: its slot is free."""

    number: int


def run_recorder(messages: Connection, to_main: Connection) -> None:
    """Body of the process."""
    raise_priority("logger")

    def work(send: Send) -> None:
        body = _Body(send)
        with HeartbeatThread("recorder", body.beat):
            while (message := _next(messages)) is not None:
                body.take(message)
            body.finish()

    run_child("recorder", to_main, work)


def _next(messages: Connection) -> object | None:
    """The next message; None when the service has closed the pipe."""
    try:
        return messages.recv()
    except (EOFError, OSError):
        return None


class _Body:
    """What the process does with each message."""

    def __init__(self, send: Send) -> None:
        self._send = send
        self._recorder: SegmentRecorder | None = None
        self._ring: ImageRing | None = None
        self._next_state_s = self._next_open_s = 0.0
        self._problem, self._full = "", False
        self._begin: Begin | None = None
        self._waiting: deque[object] = deque(maxlen=MESSAGES_WAITING)  # of a session whose folder cannot be made yet
        self._uploader: Uploader | None = None  # goes on between sessions

    def take(self, message: object) -> None:
        """Any message from the service."""
        if isinstance(message, tuple):
            number, image = message  # pyright: ignore[reportUnknownVariableType]
            self._image(number, image)  # pyright: ignore[reportUnknownArgumentType]
        elif isinstance(message, Begin):
            self.finish()
            self._begin = message
            self._send_to(message.policy)
            self._open(message)
        elif isinstance(message, Finish):
            self.finish()
        elif isinstance(message, Policy):
            self._send_to(message)
            if self._recorder is not None:
                self._recorder.change(message)
        elif isinstance(message, Mark):
            if self._recorder is not None:
                self._recorder.mark(message.text)
        elif self._recorder is not None:
            _put(self._recorder, message, "the recorder is slow")
        elif self._begin is not None:
            self._waiting.append(message)

    def _open(self, begin: Begin) -> None:
        self._next_open_s = time.monotonic() + AGAIN_S
        if self._ring is None:
            layout, slots, name = begin.ring
            try:
                self._ring = ImageRing(layout, slots, name)
            except FileNotFoundError:
                return  # the pipeline has died: the next one begins another recording
        try:
            self._recorder = SegmentRecorder(begin.policy, begin.rig, begin.config, begin.source, begin.opening)
        except OSError as error:
            self._problem, self._full = f"cannot record to {begin.policy.root}: {error.strerror}", disk_is_full(error)
            return
        except StereoSfmError as error:
            self._problem, self._full = str(error), False
            return
        for message in self._waiting:
            _put(self._recorder, message, self._problem)
        self._waiting.clear()
        self._problem, self._full = "", False

    def _send_to(self, policy: Policy) -> None:
        """Send recordings to the bucket of this policy."""
        if self._uploader is not None:
            self._uploader.close()
        self._uploader = None
        if policy.upload:
            black_box = policy.mode == "black_box"
            self._uploader = Uploader(
                policy.root, Remote.of(policy.upload), policy.upload_bytes_s, self._current, black_box
            )
            self._uploader.start()

    def _current(self) -> Segment | None:
        recorder = self._recorder
        return None if recorder is None else recorder.segment

    def _image(self, number: int, message: SlotImage) -> None:
        image = None
        if self._ring is not None and self._begin is not None:
            if self._recorder is None:
                self._open_again(self._begin)
            if self._recorder is not None:
                image = self._ring.read(message)
            else:
                self._waiting.append(message.image)
        self._send(Read(number))
        if image is not None and self._recorder is not None:
            self._recorder.image(image)

    def _open_again(self, begin: Begin) -> None:
        """The folder could not be made, or used: another attempt, once a second."""
        if time.monotonic() >= self._next_open_s:
            self._open(begin)

    def beat(self, beat: Heartbeat) -> None:
        """In the heartbeat's thread: the heartbeat, and the state."""
        self._send(beat)
        if time.monotonic() >= self._next_state_s:
            self._next_state_s = time.monotonic() + STATE_S
            recorder = self._recorder
            state = RecorderState("", "", 0, 0, self._problem, self._full)
            self._send(state if recorder is None else recorder.state())

    def finish(self) -> None:
        """Close the recording; a folder for what waits is tried once more."""
        if self._waiting and self._begin is not None:
            self._open(self._begin)
        recorder, self._recorder, self._begin = self._recorder, None, None
        self._waiting.clear()
        if recorder is not None:
            recorder.close(CLOSE_S)
        if self._ring is not None:
            self._ring.close()
            self._ring = None


def _put(recorder: SegmentRecorder, message: object, why: str) -> None:
    """A message of the run; an image comes without its pixels, which could not be had."""
    if isinstance(message, StereoImage):
        recorder.omit(message, why)
    else:
        recorder.put(message)
