"""Files that a user names may be pipes, devices or of any size: all of them are opened by `stereo_sfm.input_file`."""

from __future__ import annotations

import ast
import os
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stereo_sfm import input_file
from stereo_sfm.calib import load_rig
from stereo_sfm.calib.mask import read_mask
from stereo_sfm.drivers import open_source
from stereo_sfm.drivers.folder_source import UnreadableImage, read_gray
from stereo_sfm.drivers.ground_truth import read_trajectory
from stereo_sfm.drivers.t265.firmware import extract
from stereo_sfm.drivers.text_file import nanoseconds
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.eval.compare import stats_of
from stereo_sfm.input_file import NotAFile, count_values, read_bytes, read_json, read_yaml
from stereo_sfm.loop.vocabulary_file import load_vocabulary
from stereo_sfm.maps.header import read_header
from stereo_sfm.maps.saved_map import load_map, save_map
from tests.maps.maps import small_map

ROOT = Path(__file__).parents[1]
# Files that open others themselves: those of the system, and those that this program has just written or brings along.
OWN = {
    "stereo_sfm/cli.py", "stereo_sfm/input_file.py", "stereo_sfm/log/machine.py", "stereo_sfm/same_code.py",
    "stereo_sfm/jobs.py", "stereo_sfm/service/health.py", "stereo_sfm/pipeline/watchdog.py",
    "stereo_sfm/service/page/app.py", "stereo_sfm/service/outputs/floor_grid.py", "stereo_sfm/eval/report.py",
    "stereo_sfm/eval/html_page.py", "stereo_sfm/eval/calibration_results.py", "stereo_sfm/commands/batch.py",
    "drivers/registry.py",
    "drivers/video/source.py", "drivers/rosbag/checked.py",  # they look at the file before
}  # fmt: skip
READERS = {"read_text", "read_bytes", "imread", "loadtxt", "genfromtxt", "VideoCapture"}
ARCHIVES = {"ZipFile", "is_zipfile"}  # which also read bytes, and write


def opens(call: ast.Call) -> bool:
    """Whether a call reads a file by its path, unchecked."""
    if isinstance(call.func, ast.Name):
        return call.func.id == "open"
    if not isinstance(call.func, ast.Attribute):
        return False
    if call.func.attr in READERS:
        return not (isinstance(call.func.value, ast.Name) and call.func.value.id == "input_file")
    if call.func.attr in ARCHIVES:
        return not any("BytesIO(" in ast.unparse(arg) or ast.unparse(arg) == "'w'" for arg in call.args)
    if ast.unparse(call.func) == "sqlite3.connect":
        return True
    mode = call.args[0].value if call.args and isinstance(call.args[0], ast.Constant) else ""
    return call.func.attr == "open" and mode in ("r", "rb")


def test_every_reader_goes_through_input_file() -> None:
    found: list[str] = []
    for folder in ("stereo_sfm", "drivers", "calib"):
        for path in sorted((ROOT / folder).rglob("*.py")):
            name = path.relative_to(ROOT).as_posix()
            if name in OWN:
                continue
            tree = ast.parse(path.read_text("utf-8"))
            found += [f"{name}:{n.lineno}" for n in ast.walk(tree) if isinstance(n, ast.Call) and opens(n)]
    assert not found, f"use stereo_sfm.input_file: {found}"


def test_what_the_search_finds() -> None:
    texts = {
        "open(path)": True, "path.open('rb')": True, "path.read_text()": True, "cv2.imread(name)": True,
        "zipfile.ZipFile(path)": True, "zipfile.is_zipfile(path)": True, "zipfile.ZipFile(io.BytesIO(data))": False,
        "zipfile.ZipFile(path, 'w', 8)": False, "cv2.VideoCapture(name)": True, "sqlite3.connect(uri)": True,
        "self.socket.connect(address)": False,
        "read_text(path)": False, "input_file.read_text(path)": False, "path.open('w')": False, "source.open()": False,
    }  # fmt: skip
    for text, wanted in texts.items():
        call = ast.parse(text, mode="eval").body
        assert isinstance(call, ast.Call) and opens(call) == wanted, text


def _read_rig_of_map(path: Path) -> object:
    folder = path.parent / "map"
    save_map(small_map()[1], folder)
    (folder / "rig.yaml").unlink()
    path.rename(folder / "rig.yaml")
    return load_map(folder)


def _read_bag(path: Path) -> object:
    """In a folder of which only one file is no file."""
    for name, text in (
        ("metadata.yaml", "rosbag2_bagfile_information: {topics_with_message_count: []}"),
        ("a.db3", ""),
    ):
        if not (path.parent / name).exists():
            (path.parent / name).write_text(text)
    return open_source(f"rosbag:{path.parent}")


READS: dict[str, Callable[[Path], Any]] = {
    "a.kitti": load_rig, "rig.yaml": load_rig, "mask.png": read_mask, "image.png": read_gray,
    "truth.csv": read_trajectory, "map.json": lambda p: read_header(p.parent, ()),
    "stats.json": lambda p: stats_of(p.parent), "words.npz": load_vocabulary, "of_a_map.yaml": _read_rig_of_map,
    "drive.bag": lambda p: open_source(f"rosbag:{p}"), "alone.db3": lambda p: open_source(f"rosbag:{p}"),
    "alone.mcap": lambda p: open_source(f"rosbag:{p}"), "in_a_folder.db3": _read_bag, "in_a_folder.mcap": _read_bag,
    "result.json": read_json, "pyrealsense2.whl": extract, "firmware.so": extract,
}  # fmt: skip


@pytest.mark.parametrize("name", READS)
@pytest.mark.parametrize("kind", ["pipe", "device"])
def test_a_pipe_or_a_device_is_one_line(name: str, kind: str, tmp_path: Path) -> None:
    """Reading a pipe would wait for a writer, /dev/zero has no end."""
    path = tmp_path / name
    if kind == "pipe":
        os.mkfifo(path)
    else:
        path.symlink_to("/dev/zero")
    with pytest.raises((StereoSfmError, UnreadableImage)) as error:
        READS[name](path)
    assert len(str(error.value).splitlines()) == 1


def test_a_refused_file_is_both_kinds_of_error(tmp_path: Path) -> None:
    with pytest.raises(NotAFile, match=f"^cannot read {tmp_path}: it is not a file$") as error:
        read_bytes(tmp_path)
    assert isinstance(error.value, OSError) and isinstance(error.value, StereoSfmError)
    assert str(pickle.loads(pickle.dumps(error.value))) == str(error.value)


def test_json_that_is_nested_too_deeply(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text("[" * 100_000)
    with pytest.raises(ValueError, match="nested too deeply"):
        read_json(tmp_path / "a.json")


def test_whole_numbers_that_no_array_holds(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_text(f'{{"a": [{"9" * 400}]}}')
    with pytest.raises(ValueError, match="too large"):
        read_json(path)
    path.write_text('{"a": -9223372036854775808, "b": true}')
    assert read_json(path) == {"a": -(2**63), "b": True}


def test_stamps_that_no_clock_can_tell() -> None:
    assert nanoseconds([1, 2**63 - 1], "a").dtype == np.int64
    with pytest.raises(StereoSfmError, match=r"a: a stamp of 9.22337e[+]09 s is later than the year 2262"):
        nanoseconds([1, 2**63], "a")


def test_values_of_yaml_are_counted_before_they_are_made(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    path.write_text("a: &a [1, 2]\nb: {<<: {c: 3}, d: [*a, *a]}\n")
    assert read_yaml(path, 100) == {"a": [1, 2], "b": {"c": 3, "d": [[1, 2], [1, 2]]}}
    assert count_values(path.read_text()) == 19 and count_values("", 5) == 5
    with pytest.raises(NotAFile, match="more than"):
        read_yaml(path, 10)


def _doubled(form: str) -> str:
    return "a0: &a0 {x: 1}\n" + "".join(f"a{i}: &a{i} {form.format(f'*a{i - 1}, *a{i - 1}')}\n" for i in range(1, 40))


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[" * 100_000, "nested too deeply"),
        ("{a: " * 100_000, "nested too deeply"),
        (_doubled("[{}]"), "more than 1000000 values"),
        (_doubled("{{<<: [{}]}}"), "more than 1000000 values"),
        ("a: &a {<<: *a}", "contains itself"),
        ("a: &a [*a]", "contains itself"),
        ("a: &a [1]\nb: &a [*a]", "contains itself"),
        ("a: *b", "contains itself"),
        ("a: [1" + ":59" * 100_000 + "]", "characters"),
        ("a: [1, 2\nb: 3", r"not YAML \(line 2\)"),
        ("a: !!python/object:os.system {}", "not YAML"),
        ("{[1]: 2}: 3", "not YAML"),
        (f"a: {'9' * 400}", "too large"),
        (f"a: [{{b: -0x{'f' * 40}}}]", "too large"),
        (f"{'9' * 30}: 1", "too large"),
        ("height: 9223372036854775808", "too large"),
        (f"a: !!pairs [b: {'9' * 30}]", "too large"),
        (f"a: !!set {{{'9' * 30}}}", "too large"),
        ("a: !!timestamp x", "not what its tag says"),
        ('a: !!int ""', "not what its tag says"),
    ],
)
def test_yaml_that_no_parser_should_see(text: str, says: str, tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text(text)
    with pytest.raises(ValueError, match=says):
        read_yaml(tmp_path / "a.yaml", input_file.MOST_TEXT)
