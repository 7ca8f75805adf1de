"""The process of the viewer, and main's side of it: images at a limited rate, dropped where the viewer is slow."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from stereo_sfm.pipeline.channels import DroppingOutbox, End, Inbox, Lost
from stereo_sfm.pipeline.child import Report, Setup, prepare
from stereo_sfm.pipeline.images import ImageRing, SlotImage
from stereo_sfm.viz.server import LOOPBACK

IMAGE_NS = 100_000_000  # shortest interval between images for the viewer


@dataclass(frozen=True)
class ViewerOptions:
    """How a run is shown."""

    mode: str  # spawn | serve | save
    path: Path | None = None  # of mode "save"
    address: str = LOOPBACK  # of mode "serve"


def run_viewer(to_main: Report, control: Connection, messages: Connection, options: ViewerOptions) -> None:
    """Send the messages from main to rerun."""
    from stereo_sfm.viz.sink import RerunSink

    setup = Inbox[Setup](control).take()
    prepare("viewer", setup)
    sink = RerunSink(setup.rig, setup.source_name, options.mode, options.path, setup.ground_truth, options.address)
    inbox = Inbox[Any](messages)
    with contextlib.suppress(Lost):
        while not isinstance(message := inbox.take(), End):
            sink.put(message)
    sink.close()


class ViewerLink:
    """Main's side: sends what the viewer can take, without waiting."""

    def __init__(self, connection: Connection) -> None:
        self._outbox = DroppingOutbox(connection)
        self._next_image_ns = 0

    def put(self, message: object, ring: ImageRing) -> None:
        """Any message of the run; images at most every `IMAGE_NS`."""
        if not isinstance(message, SlotImage):
            self._outbox.send(message)
        elif message.logged and message.image.stamp_ns >= self._next_image_ns:
            self._next_image_ns = message.image.stamp_ns + IMAGE_NS
            self._outbox.send(ring.read(message))

    def end(self) -> None:
        """After the last message of the run."""
        self._outbox.send(End("main"))
        self._outbox.close()

    def close(self) -> None:
        """Close the pipe to the viewer."""
        self._outbox.close()
