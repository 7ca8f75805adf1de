"""Saves the map during the run: the mapper takes a copy between two keyframes, a thread writes it.

The thread has the mapper's priority: one of low priority would hold the interpreter while others are served.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from multiprocessing.connection import Connection, wait
from pathlib import Path

from stereo_sfm.config import Config
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.mapping.protocol import AnyMapper
from stereo_sfm.maps.folders import saved_map_of
from stereo_sfm.maps.saved_map import SavedMap
from stereo_sfm.messages import MapSaved, Relocalize, SaveMap
from stereo_sfm.pipeline.channels import End, Inbox
from stereo_sfm.types import Keyframe, LoopResult


class MapSaver:
    """Handles main's requests to save the map between the mapper's steps, so that they change nothing in the map."""

    def __init__(self, mapper: AnyMapper, config: Config, send: Callable[[MapSaved], object]) -> None:
        self._mapper, self._config, self._send = mapper, config, send
        self._thread: threading.Thread | None = None
        self._requests_open = True
        self.changed = False  # since the last request

    def next(self, inbox: Inbox[Keyframe | End], control: Connection) -> Keyframe | End:
        """The next keyframe; requests that arrive before it are handled."""
        while self._requests_open:
            ready = wait([control, inbox.connection])
            if control in ready:
                self._handle(control)
            elif ready:
                break
        return inbox.take()

    def finish(self, folder: Path | None) -> None:
        """After the last keyframe: save what changed since the last request, and wait until everything is written."""
        if folder is not None and self.changed:
            self._save(SaveMap(folder))
        self._join()

    def _join(self) -> None:
        if self._thread is not None:
            self._thread.join()

    def _handle(self, control: Connection) -> None:
        try:
            request: SaveMap | Relocalize = control.recv()
        except (EOFError, OSError):
            self._requests_open = False
            return
        if isinstance(request, Relocalize):
            self._mapper.relocalize()
        else:
            self._save(request)

    def _save(self, request: SaveMap) -> None:
        self._join()
        self.changed = False
        saved, place = saved_map_of(self._mapper, self._config), self._mapper.place()
        if saved is None:
            self._send(MapSaved(str(request.folder), 0, "nothing is mapped yet"))
            return
        self._thread = threading.Thread(target=self._write, args=(saved, place, request))
        self._thread.start()

    def _write(self, saved: SavedMap, place: LoopResult | None, request: SaveMap) -> None:
        from stereo_sfm.maps.unfinished import save_session

        folder = request.folder
        try:
            save_session(saved, place, folder)
        except (StereoSfmError, OSError) as error:
            self._send(MapSaved(str(folder), 0, str(error)))
        else:
            self._send(MapSaved(str(folder), len(saved)))
