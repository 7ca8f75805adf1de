"""Files that no program of ours wrote: one line each, at once and in little memory."""

from __future__ import annotations

import json
import os
import shutil
import sqlite3
import time
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from stereo_sfm.calib.imu import Imu
from stereo_sfm.cli import main
from stereo_sfm.config import Config, dump
from stereo_sfm.drivers import open_source
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.eval.batch import BatchTask, finished, table_row
from stereo_sfm.eval.compare import stats_of
from stereo_sfm.log import foxglove, topics
from stereo_sfm.log.reader import LogReader
from stereo_sfm.log.writer import LogWriter
from stereo_sfm.maps.saved_map import save_map
from tests.drivers.dataset_folders import make_euroc
from tests.maps.maps import small_map


def _one_line(capsys: pytest.CaptureFixture[str], command: list[str], *words: str) -> None:
    capsys.readouterr()
    begin = time.monotonic()
    assert main(command) == 2
    said = capsys.readouterr().err
    assert len(said.strip().splitlines()) == 1, said
    assert all(word in said for word in words), said
    assert time.monotonic() - begin < 30


@pytest.fixture(scope="module")
def a_map(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("maps") / "store"
    save_map(small_map()[1], folder)
    return folder


def test_labels_that_are_nested_for_ever(a_map: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    store = shutil.copytree(a_map, tmp_path / "store")
    (store / "store.yaml").write_text("[" * 100_000)
    _one_line(capsys, ["map", "versions", str(store)], "store.yaml is damaged")


def test_a_map_whose_points_are_a_device(a_map: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    store = shutil.copytree(a_map, tmp_path / "store")
    (store / "points.npz").unlink()
    (store / "points.npz").symlink_to("/dev/zero")
    _one_line(capsys, ["map", "info", str(store)], "store")


@pytest.mark.parametrize("stamp", [str(1 << 63), str(1 << 80), "-5", "9" * 5000])
def test_stamps_that_no_clock_has(stamp: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = make_euroc(tmp_path / "mh")
    for side in (0, 1):
        with (folder / "mav0" / f"cam{side}" / "data.csv").open("a") as file:
            file.write(f"{stamp},x.png\n")
    _one_line(capsys, ["run", str(folder), "--inline"], "line 6 is not 'stamp_ns,file'")


def test_a_bag_that_counts_in_words(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("rosbags")
    bag = tmp_path / "bag"
    bag.mkdir()
    (bag / "a.db3").write_bytes(b"")
    (bag / "metadata.yaml").write_text(
        "rosbag2_bagfile_information:\n  version: 5\n  storage_identifier: sqlite3\n  relative_file_paths: [a.db3]\n"
        "  duration: {nanoseconds: 1}\n  starting_time: {nanoseconds_since_epoch: 1}\n  message_count: 1\n"
        "  compression_format: ''\n  compression_mode: ''\n  topics_with_message_count:\n"
        "  - message_count: 'x'\n    topic_metadata: {name: /a, type: std_msgs/msg/String, serialization_format: cdr, "
        "offered_qos_profiles: ''}\n  files: []\n"
    )
    _one_line(capsys, ["info", str(bag)], "cannot be read as a ROS bag")


_QOS = "offered_qos_profiles: []"
_MERGED = "a0: &a0 {x: 1}\n" + "".join(f"a{i}: &a{i} {{<<: [*a{i - 1}, *a{i - 1}]}}\n" for i in range(1, 40))


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """By their kind."""
    pytest.importorskip("rosbags")
    from tests.drivers.ros_bags import KINDS, write_bag

    folder = tmp_path_factory.mktemp("bags")
    found: dict[str, Path] = {}
    with open_source("sim:loop?size=80x64&frames=3&imu=t265") as source:
        images = list(source)
        for number, kind in enumerate(KINDS):
            (folder / str(number)).mkdir()
            found[kind] = write_bag(folder / str(number), kind, source.rig, images)
    return found


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("a: " + "[" * 10_000, "nested too deeply"),
        (_MERGED, "values with every alias"),
        ("a: &a {<<: *a}", "contains itself"),
        ("a: [", "not YAML"),
    ],
)
@pytest.mark.parametrize("place", ["text", "text in the text", "text in the table"])
def test_metadata_of_a_bag_that_no_parser_should_see(
    text: str, says: str, place: str, bags: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = shutil.copytree(bags["folder of .db3"], tmp_path / "bag")
    about = bag / "metadata.yaml"
    if place == "text":
        about.write_text(about.read_text() + text)
    elif place == "text in the text":
        about.write_text(about.read_text().replace(_QOS, f"offered_qos_profiles: {json.dumps(text)}"))
    else:
        with closing(sqlite3.connect(bag / "bag.db3")) as base:
            base.execute("UPDATE topics SET offered_qos_profiles = ?", (text,))
            base.commit()
    _one_line(capsys, ["info", str(bag)], "bag", says)


def test_metadata_of_a_bag_that_is_a_film(
    bags: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = shutil.copytree(bags["folder of .mcap"], tmp_path / "bag")
    with (bag / "metadata.yaml").open("ab") as file:
        file.truncate(1 << 40)
    _one_line(capsys, ["info", str(bag)], "metadata.yaml", "more than 4")


@pytest.mark.parametrize("suffix", [".bag", ".db3", ".mcap"])
def test_a_bag_that_is_a_pipe(suffix: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("rosbags")
    pipe = tmp_path / f"drive{suffix}"
    os.mkfifo(pipe)
    _one_line(capsys, ["info", f"rosbag:{pipe}"], "it is not a file")
    _one_line(capsys, ["info", str(pipe)], "not a known kind")


_STATS: dict[str, Any] = {
    **dict.fromkeys(("frames", "lost_percent", "keyframes", "loops_accepted", "path_m", "frames_per_s"), 1.0),
    "dropped": 0, "pieces": 1, "fingerprint": "x", "lost_intervals": [], "calibration": [{"text": "x"}],
    "ms": {"track": {"p50": 1.0}}, "evaluation": {"map": {"ape_m": {"rmse": 0.1}}},
}  # fmt: skip


def _results(folder: Path, stats: Any) -> tuple[Any, Any]:
    """What `compare` and a batch that goes on read."""
    task = BatchTask("a.mcap", str(folder), Config(), False)
    result = {"ok": True, "recording": task.spec, "config": dump(task.config), "stats": stats}
    (folder / "stats.json").write_text(json.dumps(stats))
    (folder / "result.json").write_text(json.dumps(result))
    try:
        return stats_of(folder), finished(task)
    except StereoSfmError as error:
        return str(error), finished(task)


def test_numbers_of_a_run(tmp_path: Path) -> None:
    stats, result = _results(tmp_path, _STATS)
    assert stats == _STATS and table_row("a", result)[-1] == "x"


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("frames", "x"), ("frames", 1 << 70), ("path_m", None), ("ms", []), ("ms", {"track": 5.0}), ("pieces", {}),
        ("lost_intervals", 3), ("calibration", [1]), ("fingerprint", 7), ("evaluation", {"map": {}}),
    ],
)  # fmt: skip
def test_numbers_of_a_run_that_no_run_wrote(name: str, value: object, tmp_path: Path) -> None:
    for stats in ({**_STATS, name: value}, {key: v for key, v in _STATS.items() if key != name}, [value]):
        said, result = _results(tmp_path, stats)
        assert said == f"{tmp_path} is not the folder of a run: its stats.json cannot be read" and result is None


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("1403636579763555584,1e308,0,0,1,0,0,0", "beyond 1e"),
        ("1e9 0 0 0 0 0 0 1e300", "beyond 1e"),
        ("1 0 0 -1e200 0 1 0 0 0 0 1 0", "beyond 1e"),
        (f"{1 << 62},0,0,0,1,0,0,0", "too large for a time"),
        (f"{1 << 62} 0 0 0 0 0 0 1", "too large for a time"),
    ],
)
def test_poses_that_nothing_has(line: str, says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "path.txt").write_text(f"{line}\n{line}\n")
    _one_line(capsys, ["eval", str(tmp_path / "path.txt"), "--ref", str(tmp_path / "path.txt")], "path.txt", says)


@pytest.mark.parametrize("noise", [1e308, 1e-300, 0.0, float("nan")])
def test_noise_that_no_sensor_has(noise: float) -> None:
    with pytest.raises(StereoSfmError, match="out of range"):
        Imu(gyro_noise=noise)


def test_a_clock_before_1970_is_no_reason_not_to_record(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "a.mcap", clock=lambda: -(10**18)) as writer:
        writer.write(topics.LOG, foxglove.text(5, "INFO", "x"), 5)
    with LogReader(tmp_path / "a.mcap") as reader:
        assert [record.log_time for record in reader.messages([topics.LOG])] == [5]
