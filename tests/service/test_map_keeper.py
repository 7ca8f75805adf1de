"""When the service's map is saved, without a pipeline: on request, early in a session, and at the end."""

from __future__ import annotations

import multiprocessing
import os
import shutil
import signal
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from multiprocessing import Pipe
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import psutil
import pytest

from stereo_sfm.config import Config
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.maps import unfinished
from stereo_sfm.maps.folders import MapFolders
from stereo_sfm.maps.saved_map import load_map, save_map
from stereo_sfm.maps.store import lock
from stereo_sfm.messages import MapSaved, SaveMap
from stereo_sfm.pipeline import map_saver
from stereo_sfm.pipeline.map_saver import MapSaver
from stereo_sfm.service import map_keeper, map_store
from stereo_sfm.service.child import end_with_service, start_child
from stereo_sfm.service.config import MapConfig
from stereo_sfm.service.map_keeper import ENDING, MapKeeper
from stereo_sfm.service.map_store import Joined, _search  # pyright: ignore[reportPrivateUsage]
from tests.maps.maps import small_map


class SlowSession:
    """Is asked to save and never replies."""

    def __init__(self) -> None:
        self.asked: list[Path] = []

    def save_map(self, folder: Path, urgent: bool = False) -> None:
        self.asked.append(folder)


def keeper(tmp_path: Path) -> MapKeeper:
    made = MapKeeper(MapConfig(str(tmp_path / "store")), Config())
    made.begin()
    return made


@pytest.mark.parametrize("written", [False, True])
def test_who_only_localizes_leaves_what_another_is_writing(tmp_path: Path, written: bool) -> None:
    store, draft = tmp_path / "store", tmp_path / ".store.partial"
    save_map(small_map()[1], store)
    held = lock(store)
    draft.mkdir()
    if not written:
        held.release()  # its writer was killed
    folders = MapKeeper(MapConfig(str(store), "localize"), Config()).begin()
    assert folders.map_in == store and draft.exists() == written


def test_the_service_is_the_only_writer_of_the_map_that_it_extends(tmp_path: Path) -> None:
    maps = keeper(tmp_path)
    with pytest.raises(StereoSfmError, match="stop the service"):
        lock(maps.folder)
    with pytest.raises(StereoSfmError, match="another run is writing"):
        MapKeeper(MapConfig(str(maps.folder)), Config()).begin()
    maps.switch(tmp_path / "other")
    maps.begin()
    lock(tmp_path / "store").release()
    with pytest.raises(StereoSfmError, match="stop the service"):
        lock(tmp_path / "other")
    maps.finish(time.monotonic(), True)
    lock(tmp_path / "other").release()


def left_over(tmp_path: Path) -> MapKeeper:
    """Before the first session of a service, whose last one was not joined."""
    made, saved = MapKeeper(MapConfig(str(tmp_path / "store")), Config()), small_map()[1]
    for name in ("store", ".store.base"):
        save_map(saved, tmp_path / name)
    unfinished.save_session(saved, None, tmp_path / ".store.session")
    return made


def _endless(*_: object) -> None:
    end_with_service()
    time.sleep(600.0)


@pytest.mark.usefixtures("beside")
@pytest.mark.parametrize("ended", ["stopped", "killed"])
def test_a_left_over_session_holds_no_stop_up_and_is_not_lost(
    ended: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(map_store, "_join_once", _endless, raising=False)
    maps = left_over(tmp_path)
    with ThreadPoolExecutor(1) as pool:
        begun = pool.submit(maps.begin)
        while (pid := maps.pid) is None and not begun.done():
            time.sleep(0.01)
        assert pid is not None, "it was joined in the thread of the pipelines"
        joiner = psutil.Process(pid)
        if ended == "stopped":
            maps.save_last(None)
        else:
            joiner.kill()
        folders = begun.result(60.0)
    assert not joiner.is_running() and maps.pid is None
    place = tmp_path / ".store.session"
    if ended == "stopped":
        assert folders == MapFolders()
        maps.finish(time.monotonic(), complete=False)
    else:
        assert folders.map_in == tmp_path / ".store.base" and not place.exists()
        (place,) = (path for path in tmp_path.glob("store_*"))
    assert len(load_map(place)) == len(load_map(tmp_path / "store")) == len(small_map()[1])


@pytest.mark.parametrize("based", [True, False])
def test_a_left_over_session_is_joined_before_the_next(based: bool, tmp_path: Path, caplog: Any) -> None:
    maps = left_over(tmp_path)
    if not based:
        for name in ("store", ".store.base"):
            shutil.rmtree(tmp_path / name)
    with caplog.at_level("INFO"):
        folders = maps.begin()
    said = "not found in the saved map" if based else "last session was added to the saved map"
    assert said in caplog.text and folders.map_in is not None and not (tmp_path / ".store.session").exists()
    assert len(load_map(folders.map_in)) == len(load_map(tmp_path / "store")) == len(small_map()[1])


@pytest.mark.parametrize("since", ["changed", "removed", "saved"])
def test_a_left_over_session_is_joined_only_with_the_map_that_it_continued(
    since: str, tmp_path: Path, caplog: Any
) -> None:
    store, saved = tmp_path / "store", small_map()[1]
    maps = keeper(tmp_path)
    session = maps._store.session  # pyright: ignore[reportPrivateUsage]
    unfinished.save_session(saved, None, session)
    maps.session_saved(MapSaved("", len(saved)))
    maps._store.release()  # pyright: ignore[reportPrivateUsage]
    if since != "saved":
        shutil.rmtree(store)
    if since == "changed":
        save_map(small_map(1)[1], store)
    before = map_store._checksum(store)  # pyright: ignore[reportPrivateUsage]
    with caplog.at_level("INFO"):
        folders = keeper(tmp_path)._store.begin()  # pyright: ignore[reportPrivateUsage]
    assert map_store._checksum(store) == before and not session.exists()  # pyright: ignore[reportPrivateUsage]
    aside = list(tmp_path.glob("store_*"))
    if since == "saved":
        assert not aside and "last session was added to the saved map" in caplog.text
    else:
        assert len(load_map(aside[0])) == len(saved) and f"it is {aside[0]} now" in caplog.text
    assert (folders.map_in is None) == (since == "removed")


def test_a_new_map_begins_after_the_left_over_session_is_joined(tmp_path: Path) -> None:
    unfinished.save_session(small_map()[1], None, tmp_path / ".store.session")
    maps = MapKeeper(MapConfig(str(tmp_path / "store"), "new"), Config())
    assert maps.begin().map_in is None
    (aside,) = tmp_path.glob("store_*")
    assert len(load_map(aside)) == len(small_map()[1])
    save_map(small_map()[1], tmp_path / "other")
    maps.switch(tmp_path / "other")
    assert maps.begin().map_in == tmp_path / ".other.base" and (tmp_path / "other").exists()


@pytest.mark.parametrize("whole", [True, False])
def test_who_leaves_a_map_leaves_what_is_not_in_it_only(whole: bool, tmp_path: Path) -> None:
    maps, saved = keeper(tmp_path), small_map()[1]
    unfinished.save_session(saved, None, tmp_path / ".store.session")
    maps.session_saved(MapSaved("", len(saved)))
    maps.check(None)
    if not whole:
        unfinished.save_session(saved, None, tmp_path / ".store.session")
    maps.switch(tmp_path / "other")
    maps.begin()
    beside = {".store.session", ".store.saved"}
    assert beside & {path.name for path in tmp_path.iterdir()} == (set() if whole else beside)


def test_a_requested_save_is_answered_in_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(map_keeper, "SAVE_S", 0.05)
    session: Any = SlowSession()
    reply = keeper(tmp_path).save_now(session, "copy")
    assert not reply.ok and "still being saved" in reply.text and "no copy copy" in reply.text and session.asked


def test_a_requested_save_is_answered_when_the_service_ends(tmp_path: Path) -> None:
    maps, session = keeper(tmp_path), SlowSession()
    asked: Any = session
    with ThreadPoolExecutor(2) as pool:
        replies = [pool.submit(maps.save_now, asked) for _ in range(2)]
        while not session.asked:
            time.sleep(0.01)
        maps.save_last(asked)
        assert {reply.result(5.0).text for reply in replies} == {ENDING}
    assert not maps.save_now(asked).ok


def test_a_requested_save_is_not_answered_by_an_earlier_one(tmp_path: Path) -> None:
    """One that is under way may lack what was mapped last: those who ask meanwhile share the next."""
    maps, session = keeper(tmp_path), SlowSession()
    asked: Any = session
    store, joined = maps._store, list[Joined]()  # pyright: ignore[reportPrivateUsage]
    store.join, store.joined = lambda: None, lambda timeout_s=0.0: joined.pop() if joined else None
    maps._next_save_s = 0.0  # pyright: ignore[reportPrivateUsage]
    maps.check(asked)
    maps.session_saved(MapSaved("", 1))
    assert len(session.asked) == 1
    with ThreadPoolExecutor(3) as pool:
        replies = [pool.submit(maps.save_now, asked) for _ in range(3)]
        while not maps._again:  # pyright: ignore[reportPrivateUsage]
            time.sleep(0.01)
        joined.append(Joined(1))  # of the periodic save
        maps.check(asked)
        with pytest.raises(TimeoutError):
            replies[0].result(0.2)
        maps.check(asked)
        assert len(session.asked) == 2
        maps.session_saved(MapSaved("", 2))
        joined.append(Joined(2))
        maps.check(asked)
        assert all(reply.result(5.0).ok for reply in replies) and len(session.asked) == 2


def test_two_copies_of_one_name_are_made_one_after_the_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    maps, session = keeper(tmp_path), SlowSession()
    asked: Any = session
    store, joined, copying = maps._store, list[Joined](), list[int]()  # pyright: ignore[reportPrivateUsage]
    store.join, store.joined = lambda: None, lambda timeout_s=0.0: joined.pop() if joined else None

    def copy_map(old: Path, new: Path) -> None:
        copying.append(1)
        time.sleep(0.05)
        assert sum(copying) == 1
        copying.append(-1)

    monkeypatch.setattr("stereo_sfm.service.map_keeper.copy_map", copy_map)
    with ThreadPoolExecutor(3) as pool:
        replies = [pool.submit(maps.save_now, asked, "backup") for _ in range(3)]
        while not all(reply.done() for reply in replies):
            maps.session_saved(MapSaved("", 1))
            joined.append(Joined(1))
            maps.check(asked)
            time.sleep(0.01)
        assert all(reply.result().ok for reply in replies)
    assert len(copying) == 6


def test_a_folder_that_cannot_be_used_is_said_in_a_line() -> None:
    with pytest.raises(StereoSfmError, match=r"^cannot use map.folder /dev/null/store: Not a directory$"):
        MapKeeper(MapConfig("/dev/null/store"), Config()).begin()


def test_a_session_is_first_saved_after_a_minute(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    maps, session = keeper(tmp_path), SlowSession()
    asked: Any = session
    for now[0], saves in ((159.0, 0), (161.0, 1), (300.0, 1)):
        maps.check(asked)
        assert len(session.asked) == saves
    for now[0], saves in ((301.0, 2), (401.0, 2), (402.0, 3), (10_000.0, 4), (10_299.0, 4), (10_301.0, 5)):
        maps.session_saved(MapSaved("", 0, "nothing is mapped yet"))
        maps.check(asked)
        assert len(session.asked) == saves


@pytest.mark.parametrize("earlier", [False, True])
def test_a_map_that_could_not_be_written_is_said(earlier: bool, tmp_path: Path, caplog: Any) -> None:
    maps, session = keeper(tmp_path), SlowSession()
    asked: Any = session
    if earlier:
        maps._store.saved_ns = time.time_ns()  # pyright: ignore[reportPrivateUsage]
    maps.save_last(asked)
    maps.finish(time.monotonic(), complete=False)
    (line,) = (record.getMessage() for record in caplog.records if record.levelname == "ERROR")
    assert line.startswith("the map of this session was NOT saved: it could not be written in time; ")
    assert ("holds it as of" if earlier else "had not been saved before") in line


def test_a_session_without_a_map_is_not_a_loss(tmp_path: Path, caplog: Any) -> None:
    maps, session = keeper(tmp_path), SlowSession()
    asked: Any = session
    maps.save_last(asked)
    maps.session_saved(MapSaved("", 0, "nothing is mapped yet"))
    maps.finish(time.monotonic(), complete=True)
    assert not [record for record in caplog.records if record.levelname in ("ERROR", "WARNING")]


@pytest.mark.parametrize("complete", [True, False])
def test_a_session_that_was_written_but_did_not_reply_is_not_a_loss(
    complete: bool, tmp_path: Path, caplog: Any
) -> None:
    """Its mapper has come to its end before the request, or its reply comes too late."""
    maps, session = keeper(tmp_path), SlowSession()
    asked: Any = session
    store = maps._store  # pyright: ignore[reportPrivateUsage]
    store.join, store.joined = lambda: None, lambda timeout_s=0.0: Joined(7)
    if complete:
        maps.session_saved(MapSaved("", 7))
    maps.save_last(asked)
    if not complete:
        store.session.mkdir()
        (store.session / "map.json").touch()
    with caplog.at_level("INFO"):
        maps.finish(time.monotonic(), complete=complete)
    said = [record.getMessage() for record in caplog.records]
    assert not any("NOT saved" in line for line in said) and any("is saved: 7 keyframes" in line for line in said)


@pytest.mark.parametrize("once_more", [False, True])
def test_the_last_part_is_joined_while_the_stages_still_end(once_more: bool, tmp_path: Path) -> None:
    """A mapper that comes to its end may write once more; else the first join is the last."""
    maps, session = keeper(tmp_path), SlowSession()
    asked: Any = session
    store, joins = maps._store, list[Any]()  # pyright: ignore[reportPrivateUsage]

    def join() -> None:
        joins.append(store.written())
        store._waiting += 1  # pyright: ignore[reportPrivateUsage]

    def joined(timeout_s: float = 0.0) -> Joined:
        store._waiting -= 1  # pyright: ignore[reportPrivateUsage]
        return Joined(7)

    store.join, store.joined = join, joined
    maps.save_last(asked)
    store.session.mkdir()
    (store.session / "map.json").write_text("1")
    maps.session_saved(MapSaved("", 7))
    assert joins == [store.written()]
    if once_more:
        (store.session / "map.json").unlink()
        (store.session / "map.json").write_text("2")
    maps.finish(time.monotonic(), complete=True)
    assert len(joins) == 1 + once_more and not store.joining


def _service_that_dies(send: Any) -> None:
    child = start_child("map saver", _work)
    send.send(child.pid)
    os.kill(os.getpid(), signal.SIGKILL)


def _work() -> None:
    end_with_service()
    time.sleep(600.0)


@pytest.mark.usefixtures("beside")
def test_the_process_that_saves_ends_with_the_service() -> None:
    context = multiprocessing.get_context("spawn")
    receive, send = context.Pipe(False)
    service = context.Process(target=_service_that_dies, args=(send,))
    service.start()
    saver = psutil.Process(receive.recv())
    service.join()
    assert saver.wait(120.0) is None


@pytest.mark.skipif(not hasattr(os, "setpriority"), reason="no priorities of threads")
def test_a_save_is_written_without_yielding(monkeypatch: pytest.MonkeyPatch) -> None:
    written, replies = list[int](), list[MapSaved]()

    def save(saved: object, place: object, folder: Path) -> None:
        written.append(os.getpriority(os.PRIO_PROCESS, threading.get_native_id()))

    monkeypatch.setattr(unfinished, "save_session", save)
    monkeypatch.setattr(map_saver, "saved_map_of", lambda *_: [0])
    mapper: Any = SimpleNamespace(place=lambda: None)
    saver = MapSaver(mapper, Config(), replies.append)
    inbox, control = SimpleNamespace(connection=Pipe(False)[0], take=lambda: None), Pipe(False)
    control[1].send(SaveMap(Path("x")))
    control[1].close()
    any_inbox: Any = inbox
    threading.Thread(target=saver.next, args=(any_inbox, control[0])).start()
    while not replies:
        time.sleep(0.01)
    assert written == [os.getpriority(os.PRIO_PROCESS, 0)]


def test_the_search_for_loops_rests_between_its_steps() -> None:
    class Growing:
        begun: ClassVar[list[float]] = []

        def work(self) -> bool:
            self.begun.append(time.monotonic())
            until = time.thread_time() + 0.05
            while time.thread_time() < until:
                pass
            return True

    growing: Any = Growing()
    step, free, work = threading.Lock(), threading.Event(), threading.Event()
    free.set()
    work.set()
    threading.Thread(target=_search, args=(growing, step, free, work), daemon=True).start()
    while len(growing.begun) < 5:
        time.sleep(0.01)
    free.clear()  # a request is carried out: no further step begins
    with step:
        done = len(growing.begun)
        time.sleep(0.5)
        assert len(growing.begun) == done
    assert np.diff(growing.begun).min() > 4 * 0.05 - 0.01


def test_a_stop_that_was_announced_waits_for_no_search_for_loops(monkeypatch: pytest.MonkeyPatch) -> None:
    searched: Any = SimpleNamespace(work=lambda: steps.append(1) or True)
    steps = list[int]()
    for name in ("end_with_service", "load_map", "configured_vocabulary"):
        monkeypatch.setattr(map_store, name, lambda *_: None)
    raised = list[tuple[str, ...]]()
    monkeypatch.setattr(map_store, "raise_priority", lambda *stage: raised.append(stage))
    monkeypatch.setattr(map_store, "GrowingMap", lambda *_: searched)
    monkeypatch.setattr(map_store, "_grown", lambda *_: Joined(len(steps)))
    (requests, to_joiner), (results, answers) = (multiprocessing.Pipe(duplex=False) for _ in range(2))
    arguments: Any = (Path(), Path(), Path(), Config(), requests, answers)
    threading.Thread(target=map_store._keep_joined, args=arguments, daemon=True).start()  # pyright: ignore[reportPrivateUsage]
    to_joiner.send(True)
    results.recv()
    while not steps:
        time.sleep(0.01)
    to_joiner.send(False)
    to_joiner.send(True)
    done = results.recv().keyframes
    time.sleep(0.2)
    assert len(steps) == done and raised[:2] == [("mapper",), ()]
    to_joiner.close()
