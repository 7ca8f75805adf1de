"""Files that no program of ours wrote: one line each, at once and in little memory."""

from __future__ import annotations

import shutil
import time
from pathlib import Path

import pytest

from stereo_sfm.calib.imu import Imu
from stereo_sfm.cli import main
from stereo_sfm.errors import StereoSfmError
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


@pytest.mark.parametrize("noise", [1e308, 1e-300, 0.0, float("nan")])
def test_noise_that_no_sensor_has(noise: float) -> None:
    with pytest.raises(StereoSfmError, match="out of range"):
        Imu(gyro_noise=noise)


def test_a_clock_before_1970_is_no_reason_not_to_record(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "a.mcap", clock=lambda: -(10**18)) as writer:
        writer.write(topics.LOG, foxglove.text(5, "INFO", "x"), 5)
    with LogReader(tmp_path / "a.mcap") as reader:
        assert [record.log_time for record in reader.messages([topics.LOG])] == [5]
