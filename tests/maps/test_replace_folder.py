"""A folder is replaced as a whole, whenever the process that does it is killed."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.maps import unfinished
from stereo_sfm.maps.replace_folder import recover, replaced_folder
from stereo_sfm.maps.unfinished import copy_map

KILLED = """
import os, pathlib, signal, sys
from stereo_sfm.maps.replace_folder import replaced_folder
left = int(sys.argv[2])

def counted(name):
    original = getattr(pathlib.Path, name)
    def call(*arguments, **named):
        global left
        left -= 1
        if left < 0:
            os.kill(os.getpid(), signal.SIGKILL)
        return original(*arguments, **named)
    setattr(pathlib.Path, name, call)

for name in ("mkdir", "rename", "replace", "rmdir"):
    counted(name)
with replaced_folder(pathlib.Path(sys.argv[1]), frozenset("ab")) as draft:
    for file in "ab":
        (draft / file).write_text("new")
"""


def texts(folder: Path) -> dict[str, str]:
    return {path.name: path.read_text() if path.is_file() else "a folder" for path in folder.iterdir()}


@pytest.mark.parametrize("foreign", [{}, {"notes.txt": "mine"}])
def test_a_folder_is_the_old_or_the_new_one_wherever_its_writer_is_killed(
    foreign: dict[str, str], tmp_path: Path
) -> None:
    seen: set[str] = set()
    for step in range(20):
        folder = tmp_path / str(step) / "map"
        folder.mkdir(parents=True)
        for name, text in {"a": "old", "b": "old", **foreign}.items():
            (folder / name).write_text(text)
        child = subprocess.run([sys.executable, "-c", KILLED, str(folder), str(step)], env=dict(os.environ))
        recover(folder)
        found = texts(folder)
        assert {name: found.pop(name) for name in foreign} == foreign
        assert found in ({"a": "old", "b": "old"}, {"a": "new", "b": "new"})
        assert [path.name for path in folder.parent.iterdir()] == ["map"]
        seen.add(found["a"])
        if child.returncode == 0:
            break
        assert child.returncode == -9
    else:
        pytest.fail("it was killed at every step")
    assert seen == {"old", "new"} and step >= 3


def test_the_next_replacement_begins_with_what_a_killed_one_completed(tmp_path: Path) -> None:
    folder = tmp_path / "map"
    for name in (".map.old", ".map.partial"):  # killed between the two renames
        (tmp_path / name).mkdir()
        (tmp_path / name / "a").write_text(name)
    with pytest.raises(RuntimeError), replaced_folder(folder, frozenset("a")):
        raise RuntimeError
    assert texts(folder) == {"a": ".map.partial"} and [path.name for path in tmp_path.iterdir()] == ["map"]


@pytest.mark.parametrize("synced", [True, False])
def test_only_what_lasts_waits_for_the_disk(synced: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    waited = list[int]()
    monkeypatch.setattr(os, "fsync", waited.append)
    with replaced_folder(tmp_path / "map", frozenset("a"), synced) as draft:
        (draft / "a").write_text("new")
    assert len(waited) == (2 if synced else 0)
    assert texts(tmp_path / "map") == {"a": "new"}


def save(folder: Path, text: str) -> None:
    with replaced_folder(folder, frozenset("abc")) as draft:
        for name in "abc":
            (draft / name).write_text(text)


@pytest.mark.parametrize("foreign", [{}, {"notes.txt": "mine"}])
@pytest.mark.parametrize("links", [True, False])
def test_a_copy_has_the_files_of_one_save(
    foreign: dict[str, str], links: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Saved again before each of the first files is copied, and before the last."""
    folder, link, saves = tmp_path / "map", os.link, list[int]()
    save(folder, "0")
    for name, text in foreign.items():
        (folder / name).write_text(text)

    def busy(here: Path, there: Path) -> None:
        if len(saves) < 9:
            saves.append(1)
            save(folder, str(len(saves)))
        if not links:
            raise OSError("no links on this disk")
        link(here, there)

    monkeypatch.setattr(os, "link", busy)
    monkeypatch.setattr(unfinished, "map_files", lambda: frozenset("abc"))
    copy_map(folder, tmp_path / "copy")
    assert len(saves) == 9 and texts(tmp_path / "copy") == dict.fromkeys("abc", "9") | foreign
    save(folder, "later")
    for name in foreign:  # written in place, as a plan is
        (folder / name).write_text("later")
    assert texts(tmp_path / "copy") == dict.fromkeys("abc", "9") | foreign


def test_no_copy_is_made_while_the_files_are_moved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(unfinished, "PAUSE_S", 0.0)
    folder, replace, refused = tmp_path / "map", Path.replace, list[str]()
    save(folder, "old")
    (folder / "notes.txt").write_text("mine")

    def copied(path: Path, to: Path) -> Path:
        with pytest.raises(StereoSfmError, match="replaced again and again") as found:
            copy_map(folder, tmp_path / "copy")
        refused.append(str(found.value))
        return replace(path, to)

    monkeypatch.setattr(Path, "replace", copied)
    save(folder, "new")
    assert len(refused) == 3 and not (tmp_path / "copy").exists()
    copy_map(folder, tmp_path / "copy")
    assert texts(tmp_path / "copy") == {"a": "new", "b": "new", "c": "new", "notes.txt": "mine"}
