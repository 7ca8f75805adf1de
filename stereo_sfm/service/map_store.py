"""The saved map of the service on disk.

While the service runs, two folders are beside the map's folder STORE: `.STORE.base`, the map that the session began
with, and `.STORE.session`, the session's own part as it was saved last. A process of low priority joins the two into
STORE as the session goes on, so that STORE is a complete map whenever the power fails. `.STORE.saved` holds the
checksum of STORE as it was written last. What was not joined at the end is joined at the next start, if STORE is still
that map. Else it is kept under another name. A service that changes STORE holds its lock as long as it runs:
`map update` and the like have to wait.
"""

from __future__ import annotations

import contextlib
import itertools
import logging
import shutil
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path

from stereo_sfm.config import Config
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.folder_lock import FolderLock
from stereo_sfm.input_file import read_text
from stereo_sfm.loop.vocabulary_file import configured_vocabulary
from stereo_sfm.maps.folders import MapFolders, map_sha256
from stereo_sfm.maps.growing import GrowingMap
from stereo_sfm.maps.replace_folder import recover, sync
from stereo_sfm.maps.saved_map import load_map, save_map
from stereo_sfm.maps.store import lock, lock_versioned
from stereo_sfm.maps.unfinished import copy_map, load_place, publish
from stereo_sfm.pipeline.allocator import release_memory, return_large_blocks, share_one_heap
from stereo_sfm.pipeline.child import raise_priority
from stereo_sfm.pipeline.fork_server import start_context
from stereo_sfm.pipeline.watchdog import STOPPED, process_state
from stereo_sfm.service.child import end_with_service, pipe, start_child

log = logging.getLogger("stereo_sfm")
LOOK_S = 0.1  # seconds between two looks whether a stop ends what a new session waits for
RESTING = 3.0  # seconds that the search for loops rests for each of processor time: a quarter of a core at most


@dataclass(frozen=True)
class Joined:
    """How a save ended: keyframes of the saved map, or why there is none."""

    keyframes: int = 0
    why: str = ""


@dataclass
class MapStore:
    """One saved map and the session that continues it."""

    folder: Path
    mode: str  # of config.MAP_MODES
    config: Config
    saved_ns: int = 0  # Unix time of the last save
    _base: Path | None = None
    _process: BaseProcess | None = None
    _result: Connection | None = None
    _requests: Connection | None = None
    _waiting: int = 0  # requests to join without a result
    _died: bool = False  # the process ended by itself: the next request starts another one
    _done: Joined | None = None
    _fresh: bool = True  # no session has begun yet
    _asked: tuple[int, int] | None = None  # what was written when a join was requested last
    _joined: tuple[int, int] | None = None  # the same, of the last join that succeeded
    _lock: FolderLock | None = None  # of the saved map, from the first session on

    @property
    def saves(self) -> bool:
        """Whether this mode changes the saved map."""
        return self.mode in ("extend", "new")

    @property
    def session(self) -> Path:
        """The session's own part."""
        return self.folder.with_name(f".{self.folder.name}.session")

    @property
    def _base_folder(self) -> Path:
        """The map that the session began with."""
        return self.folder.with_name(f".{self.folder.name}.base")

    @property
    def whole(self) -> bool:
        """Whether all that the session has written is in the saved map."""
        return self.written() in (None, self._joined)

    def written(self) -> tuple[int, int] | None:
        """Tells the session's own part, as it was completely written last, from others; None if there is none."""
        try:
            file = (self.session / "map.json").stat()
        except OSError:
            return None
        return file.st_ino, file.st_mtime_ns

    def begin(self, stopped: Callable[[], bool] = lambda: False) -> MapFolders:
        """The maps of a new session; a session that an earlier run did not join is joined first.

        Args: stopped, no session begins any more: what is not joined stays for the next start. No maps are returned.

        Raises:
            StereoSfmError: there is no map to localize in, it is damaged, another process writes to it, or its folder
                cannot be used.
        """
        self.cancel()
        try:
            return self._begin(stopped)
        except OSError as error:
            raise StereoSfmError(f"cannot use map.folder {self.folder}: {error.strerror or error}") from None

    def _begin(self, stopped: Callable[[], bool]) -> MapFolders:
        base = self._base_folder
        if self.mode == "none":
            return MapFolders()
        if self.saves and self._lock is None:
            self._lock = lock(self.folder)
        if self.mode == "localize":
            with contextlib.suppress(StereoSfmError), lock_versioned(self.folder):  # else another process writes to it
                recover(self.folder)
            folders = MapFolders(map_in=self.folder, localize_only=True)
            folders.check()
            self.saved_ns = (self.folder / "map.json").stat().st_mtime_ns
            return folders
        for replaced in (self.folder, self.session, base):
            recover(replaced)
        self.folder.parent.mkdir(parents=True, exist_ok=True)
        if self._fresh:
            if not self._join_left_over(base, stopped):
                return MapFolders()
            if self.mode == "new" and (self.folder / "map.json").exists():
                self._set_aside()
        self._fresh = False
        self.finished()
        self._base, self._died = None, False
        if (self.folder / "map.json").exists():
            self.saved_ns = max(self.saved_ns, (self.folder / "map.json").stat().st_mtime_ns)
            copy_map(self.folder, base)
            self._base = base
        _remember(self.folder)
        return MapFolders(map_in=self._base, session=self.session)

    def _set_aside(self) -> None:
        """A new map begins: the one there is kept under another name."""
        log.warning("map.mode is new: the map %s is called %s now", self.folder, self._keep_aside(self.folder))

    def _keep_aside(self, folder: Path) -> Path:
        """Rename the saved map or the session; returns its new name."""
        name = f"{self.folder.name}_{time.strftime('%Y%m%d_%H%M%S')}"
        names = itertools.chain([name], (f"{name}_{k}" for k in itertools.count(2)))
        return folder.rename(next(to for to in map(self.folder.with_name, names) if not to.exists()))

    def _is_as_left(self) -> bool:
        """Whether the saved map is what was written last, or what the unfinished session began with.

        So it is taken to be where an older version left the session: it noted nothing.
        """
        try:
            return _checksum(self.folder) == read_text(_saved_file(self.folder))
        except FileNotFoundError:
            return True

    def _join_left_over(self, base: Path, stopped: Callable[[], bool]) -> bool:
        """In a process of its own, which a stop ends. Returns whether nothing is left to join."""
        if not (self.session / "map.json").exists():
            return True
        if not self._is_as_left():
            log.warning(
                "%s was changed since its last session, which is not added: it is %s now "
                "('stereo-sfm map update' adds it)", self.folder, self._keep_aside(self.session),
            )  # fmt: skip
            return True
        if (base / "map.json").exists():
            self._result, send = pipe()
            self._process = start_child("map saver", _join_once, base, self.session, self.folder, self.config, send)
            self._waiting = 1
        else:
            self._done = _published(None, self.session, self.folder, self.config)
        joined = None
        while joined is None and not stopped():
            joined = self.joined(LOOK_S)
        self.cancel()
        if joined is None:
            log.info("the unfinished last session is added to the saved map at the next start")
        elif not joined.why:
            log.info("the unfinished last session was added to the saved map")
        else:
            kept = f"; it is {self._keep_aside(self.session)} now" if self._died else ""
            log.warning("the last session could not be added to the saved map: %s%s", joined.why, kept)
        return joined is not None

    def prepare(self) -> None:
        """Start the process that joins, which loads the map that the session began with."""
        if self._base is not None and self._process is None and not self._died:
            (requests, self._requests), (self._result, send) = pipe(), pipe()
            self._process = start_child(
                "map saver", _keep_joined, self._base, self.session, self.folder, self.config, requests, send,
                context=start_context(self.config.pipeline.threads),
            )  # fmt: skip

    def join(self) -> None:
        """Begin to write the saved map from the session's part as it is now."""
        self._asked = self.written()
        if self._base is None:
            self._done = _published(None, self.session, self.folder, self.config)
            return
        self._died = False
        self.prepare()
        self._waiting += 1
        self._request(True)

    def hurry(self) -> None:
        """The last part comes soon: search for no more loops until then."""
        self._request(False)

    def _request(self, join: bool) -> None:
        if self._requests is not None:
            with contextlib.suppress(OSError):  # it was killed: its result says so
                self._requests.send(join)

    @property
    def pid(self) -> int | None:
        """Of the process that joins, while there is one."""
        process = self._process  # which another thread may set to None
        return None if process is None else process.pid

    @property
    def joining(self) -> bool:
        """Whether the result of `join` has not been taken yet."""
        return self._waiting > 0 or self._done is not None

    def joined(self, timeout_s: float = 0.0) -> Joined | None:
        """The result of `join`, once; None while it runs."""
        result, self._done = self._done, None
        if result is None:
            process = self._process
            if process is not None and process.pid is not None and process_state(process.pid) in STOPPED:
                process.kill()  # it would never answer
            if self._result is None or not self._result.poll(timeout_s):
                return None
            try:
                result = self._result.recv()
            except (EOFError, OSError):
                waited, self._died = self._waiting > 0, True
                self.cancel()
                if not waited:
                    return None
                result = Joined(why="the process that saves the map was killed")
            self._waiting = max(self._waiting - 1, 0)
        assert result is not None
        if not result.why:
            self.saved_ns = time.time_ns()
            self._joined = None if self.joining else self._asked
        return result

    def cancel(self) -> None:
        """End the process that joins; the saved map stays as it is."""
        if self._process is not None:
            self._process.kill()
            self._process.join()
        for end in (self._result, self._requests):
            if end is not None:
                end.close()
        self._process = self._result = self._requests = None
        self._waiting = 0

    def release(self) -> None:
        """Let others write to the saved map."""
        if self._lock is not None:
            self._lock.release()
            self._lock = None

    def finished(self) -> None:
        """The session is in the saved map: nothing is left to do at the next start."""
        for folder in (self.session, self._base_folder):
            shutil.rmtree(folder, ignore_errors=True)
        with contextlib.suppress(OSError):
            _saved_file(self.folder).unlink()
        self._asked = self._joined = None


def _keep_joined(base: Path, session: Path, out: Path, config: Config, requests: Connection, send: Connection) -> None:
    """Body of the process: joins the session's part on request; a thread that mostly rests looks for its loops."""
    end_with_service()
    raise_priority("mapper")
    return_large_blocks()
    share_one_heap()
    try:
        growing = GrowingMap(load_map(base), configured_vocabulary(config.loop), config)
    except (StereoSfmError, OSError) as error:
        growing, why = None, str(error)
    else:
        why = ""
    step, free, work = threading.Lock(), threading.Event(), threading.Event()
    if growing is not None:
        threading.Thread(target=_search, args=(growing, step, free, work), daemon=True).start()
    hurried = False
    with contextlib.suppress(EOFError, OSError):
        while True:
            if not hurried:
                free.set()
            hurried |= not (join := requests.recv())
            free.clear()
            if hurried:
                raise_priority()  # there are no poses to delay any more
            if join:
                with step:
                    send.send(Joined(why=why) if growing is None else _grown(growing, session, out))
                    release_memory()  # maps of a day come and go
                work.set()


def _join_once(base: Path, session: Path, out: Path, config: Config, send: Connection) -> None:
    """Body of the process that joins what an earlier run left."""
    end_with_service()
    raise_priority()  # there are no poses to delay yet
    return_large_blocks()
    share_one_heap()
    send.send(_published(base, session, out, config))


def _search(growing: GrowingMap, step: threading.Lock, free: threading.Event, work: threading.Event) -> None:
    """Work on the map whenever no request is carried out.

    A thread of low priority would hold the map, and the interpreter, for seconds on a busy computer while a request
    waits for it. So this one rests instead.
    """
    while True:
        work.wait()
        free.wait()
        begun_s = time.thread_time()
        with step:
            work.clear()
            if growing.work():
                work.set()
        time.sleep(RESTING * (time.thread_time() - begun_s))


def _grown(growing: GrowingMap, session: Path, out: Path) -> Joined:
    try:
        growing.take(load_map(session), load_place(session))
        saved = growing.saved()
        save_map(saved, out, compress=False)  # a fifth larger, in a sixth of the processor time
        _remember(out)
    except (StereoSfmError, OSError) as error:
        return Joined(why=str(error))
    return Joined(len(saved))


def _published(base: Path | None, session: Path, out: Path, config: Config) -> Joined:
    try:
        keyframes = publish(base, session, out, config)
        _remember(out)
    except (StereoSfmError, OSError) as error:
        return Joined(why=str(error))
    return Joined(keyframes)


def _saved_file(folder: Path) -> Path:
    """Holds the checksum of the saved map as it was written last."""
    return folder.with_name(f".{folder.name}.saved")


def _checksum(folder: Path) -> str:
    """Identifies a map; "" where there is none."""
    return map_sha256(folder) if (folder / "map.json").exists() else ""


def _remember(folder: Path) -> None:
    """Note what was written; it survives a loss of power, as the map does."""
    file = _saved_file(folder)
    draft = file.with_name(f"{file.name}.partial")
    draft.write_text(_checksum(folder), encoding="utf-8")
    sync(draft)
    draft.replace(file)
    sync(file.parent)
