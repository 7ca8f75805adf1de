"""When the map of the running service is saved: every few minutes, on request, and at the end."""

from __future__ import annotations

import logging
import threading
import time
from pathlib import Path

from stereo_sfm.config import Config
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.maps.folders import MapFolders
from stereo_sfm.maps.unfinished import copy_map
from stereo_sfm.messages import MapSaved
from stereo_sfm.service.config import MapConfig
from stereo_sfm.service.map_store import Joined, MapStore
from stereo_sfm.service.publisher import Reply
from stereo_sfm.service.session import Session

log = logging.getLogger("stereo_sfm")

SAVE_S = 25.0  # for the reply to a request to save: the save itself goes on
ENDING = "the service is ending: the map is saved with it"
FIRST_SAVE_MIN = 1.0  # minutes to the first save of a session
SHARE_OF_AGE = 0.5  # of the age of a session until its next save, up to the interval of the configuration
SETTLE_S = 20.0  # for the map of a session to be saved before a restart on request


class MapKeeper:
    """The saved map over the sessions of a service."""

    def __init__(self, config: MapConfig, pipeline: Config) -> None:
        """Args: config, folder, mode and interval; pipeline, of the stages."""
        self.save_every_min = config.save_every_min
        self._store = MapStore(Path(config.folder).resolve(), config.mode, pipeline)
        self._next_folder: Path | None = None  # the map of the next session, if another one
        self.is_new = False  # the saved map begins with this session
        self._next_save_s = float("inf")
        self._began_ns, self._began_s = 0, 0.0  # Unix and monotonic time of the session's beginning
        self._session_saved = threading.Event()  # the session's part is complete on disk
        self._session = 0  # number of the one that runs
        self._asked = self._answered = 0  # requests to the session to write its part, and its replies, in order
        self._ended = 0  # of the requests: saved, or not
        self._again = False  # somebody asked while a save was under way: another one follows, for all of them
        self._failure = ""  # of the last one
        self._lock = threading.Condition(threading.Lock())  # of the store and of these, while they change
        self._copying = threading.Lock()  # of copies beside it: two requests may name the same one
        self._ending = False
        self._last = False  # the last save was requested
        self._before: tuple[int, int] | None = None  # what was written at that request
        self._taken: tuple[int, int] | None = None  # what was written when a join was requested last

    @property
    def mode(self) -> str:
        """One of `config.MAP_MODES`."""
        return self._store.mode

    @property
    def folder(self) -> Path:
        """Of the saved map."""
        return self._store.folder

    @property
    def saved_ns(self) -> int:
        """Unix time of the last save, 0 before it."""
        return self._store.saved_ns

    @property
    def exists(self) -> bool:
        """Whether there is a saved map."""
        return (self.folder / "map.json").exists()

    @property
    def _awaited(self) -> bool:
        """Whether the session has not replied to the last request."""
        return self._last and self._answered < self._asked

    @property
    def pid(self) -> int | None:
        """Of the process that writes the saved map, while there is one."""
        return self._store.pid

    # -- sessions, in the thread of the pipelines --------------------------------------------------------------------

    def settle(self) -> None:
        """Wait until the part of a session that has ended as requested is in the saved map; a stop ends that."""
        until = time.monotonic() + SETTLE_S
        while self._store.joining and not self._ending:
            if time.monotonic() > until:
                log.warning("the end of the last session is not in %s: saving takes too long", self.folder)
                return
            time.sleep(0.05)

    def begin(self) -> MapFolders:
        """The maps of a new session.

        Raises:
            StereoSfmError: there is no map to localize in, or it is damaged.
        """
        with self._lock:
            if self._next_folder is not None:
                self._leave_store()
                mode = "extend" if self._store.saves else self.mode  # a map that was chosen is continued
                self._store, self._next_folder = MapStore(self._next_folder, mode, self._store.config), None
            folders = self._store.begin(lambda: self._ending)
            self._asked = self._answered = self._ended = 0
            self._again, self._taken = False, None
            self._session += 1
            self._end_request("the pipeline was started again: save once more")
        self.is_new = folders.map_in is None
        self._began_ns, self._began_s = time.time_ns(), time.monotonic()
        self._session_saved.clear()
        self._schedule()
        return folders

    def _leave_store(self) -> None:
        """Others may write to the saved map; what of its session is not in it is joined when it is continued."""
        self._store.cancel()
        if self._store.saves and self._store.whole:
            self._store.finished()
        self._store.release()

    def session_saved(self, message: MapSaved) -> None:
        """The session's part is on disk, or cannot be: the saved map follows from it."""
        with self._lock:
            self._answered += 1
            if not message.why:
                self._session_saved.set()
                self._taken = self._store.written()
                self._store.join()
                return
            self._end_request(message.why)
        log.log(logging.WARNING if message.keyframes else logging.INFO, "the map was not saved: %s", message.why)

    def finish(self, until_s: float, complete: bool) -> None:
        """After the last session: add its part to the saved map until this monotonic time, else at the next start.

        Others may write to the saved map then.

        Args: complete, the session's mapper came to its end: it has written what there was, whether asked or not.
        """
        try:
            self._finish(until_s, complete)
        finally:
            self._store.cancel()  # its process would wait for another request, and the service for its end
            self._store.release()

    def _finish(self, until_s: float, complete: bool) -> None:
        written = self._awaited and self._store.written() not in (None, self._before)  # its message came too late
        if self._awaited and not (complete or written):
            self._log_lost()
            return
        if not (self._store.saves and (written or self._session_saved.is_set())):
            return
        if self._store.written() != self._taken or not self._store.joining:  # the mapper wrote once more at its end
            self._store.join()
        joined = self._store.joined(max(until_s - time.monotonic(), 0.0))
        while joined is not None and self._store.joining:  # an earlier one may have read a folder that was replaced
            joined = self._store.joined(max(until_s - time.monotonic(), 0.0))
        if joined is None:
            self._store.cancel()
            log.warning("the map of this session is added to %s at the next start", self.folder)
        elif joined.why:
            log.warning("the map of this session is not in %s: %s", self.folder, joined.why)
        else:
            self._store.finished()
            _log_saved(self.folder, joined)

    # -- from any thread ---------------------------------------------------------------------------------------------

    def save_last(self, session: Session | None) -> None:
        """Save a session that is about to end, if there is one with images; nothing else is saved from now on."""
        self._ending = True  # a session that is beginning holds the lock, and gives up
        with self._lock:
            self._end_request(ENDING)
            if self._store.saves and session is not None:
                self._last, self._before = True, self._store.written()
                self._store.hurry()
                self._ask(session, urgent=True)

    def check(self, session: Session | None) -> None:
        """Save when it is time, and report a save that has ended; call it regularly.

        Args: session, the one that runs; None while none has images.
        """
        if not self._lock.acquire(blocking=False):
            return  # a session is beginning or ending: it is checked next time
        try:
            if self._store.saves and not self._ending:
                self._save_when_due(session)
                joined = self._store.joined()
                if joined is not None:
                    self._report_joined(joined)
        finally:
            self._lock.release()

    def save_now(self, session: Session | None, name: str = "") -> Reply:
        """Save and wait for it; with a name also a copy beside the saved map.

        Raises:
            StereoSfmError: the name is not a plain one, or the copy cannot be made.
        """
        if not self._store.saves or session is None:
            return Reply(False, f"no map is saved: map.mode is {self.mode}, or no pipeline runs")
        copy = self.beside(name) if name else None
        if copy is not None and copy.exists() and not (copy / "map.json").exists():
            return Reply(False, f"{copy} is no map: choose another name")
        with self._lock:
            if self._ending:
                return Reply(False, ENDING)
            of, number = self._session, self._asked + 1  # the next one: a save under way may lack what was mapped last
            if self._ended < self._asked:
                self._again = True
            else:
                self._ask(session)
            if not self._lock.wait_for(lambda: self._ending or self._session != of or self._ended >= number, SAVE_S):
                without = f": there is no copy {name}" if name else ""
                return Reply(False, f"the map is still being saved after {SAVE_S:.0f} s{without}")
            if self._failure:
                return Reply(False, self._failure)
        if copy is not None:
            with self._copying:
                copy_map(self.folder, copy)
        return Reply(True, f"saved to {copy or self.folder}")

    def switch(self, folder: Path) -> None:
        """The next session begins with this map; what the running one has mapped goes into its own."""
        self._next_folder = folder

    def beside(self, name: str) -> Path:
        """The folder of a map next to the saved one.

        Raises:
            StereoSfmError: not a plain name.
        """
        if not name or name.startswith(".") or Path(name).name != name or "\\" in name:
            raise StereoSfmError(f"'{name}' is not a plain name: leave out / and \\, and do not begin with a dot")
        return self.folder.with_name(name)

    def _save_when_due(self, session: Session | None) -> None:
        """A save that takes longer than the interval is not interrupted by the next one."""
        if session is None or self._ended < self._asked:
            return
        due = time.monotonic() >= self._next_save_s
        if due:
            self._schedule()
        if due or self._again:
            self._again = False
            self._ask(session)
        self._store.prepare()

    def _ask(self, session: Session, urgent: bool = False) -> None:
        self._asked += 1
        session.save_map(self._store.session, urgent)

    def _report_joined(self, joined: Joined) -> None:
        self._end_request(joined.why)
        if joined.why:
            log.warning("the map was not saved: %s", joined.why)
        else:
            _log_saved(self.folder, joined)

    def _schedule(self) -> None:
        """The next save is the nearer, the younger the session is: each has about as much to add to what there is."""
        age_min = (time.monotonic() - self._began_s) / 60
        wait_min = min(max(FIRST_SAVE_MIN, SHARE_OF_AGE * age_min), self.save_every_min)
        self._next_save_s = time.monotonic() + 60 * wait_min

    def _log_lost(self) -> None:
        at = time.strftime("%H:%M:%S", time.localtime(self.saved_ns / 1e9))
        saved = self.saved_ns > self._began_ns
        kept = f"{self.folder} holds it as of {at}" if saved else "it had not been saved before"
        log.error("the map of this session was NOT saved: it could not be written in time; %s", kept)

    def _end_request(self, failure: str) -> None:
        """Those who wait for the save under way go on."""
        self._failure, self._ended = failure, self._asked
        self._lock.notify_all()


def _log_saved(folder: Path, joined: Joined) -> None:
    log.info("the map %s is saved: %d keyframes", folder, joined.keyframes)
