"""ROS bags as sources: the same images, calibration and inertial samples as went into them, and the same poses."""

from __future__ import annotations

import functools
import json
import logging
import shutil
import sqlite3
import tempfile
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import zstandard
from rosbags import rosbag1, rosbag2

from stereo_sfm.cli import main
from stereo_sfm.drivers import open_source
from stereo_sfm.drivers.registry import recognise
from stereo_sfm.drivers.rosbag import unpacked
from stereo_sfm.drivers.source import Source
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.system import Tracker
from stereo_sfm.types import F64, StereoImage, WheelSamples
from tests.drivers.ros_bags import FRAMES, KINDS, BagWriter, compressed_bag, copied, write_bag
from tests.fuzz.formats import pack_messages

SIMULATED = "sim:loop?size=212x200&frames=12&start=40&imu=t265"


@functools.cache
def _simulated() -> tuple[Source, list[StereoImage]]:
    with open_source(SIMULATED) as source:
        return source, list(source)


@pytest.mark.parametrize(("kind", "packed"), [*((kind, False) for kind in KINDS), (KINDS[0], True)])
def test_a_bag_gives_what_was_written(kind: str, packed: bool, tmp_path: Path) -> None:
    source, images = _simulated()
    path = write_bag(tmp_path, kind, source.rig, images, packed)
    assert recognise(path) == "rosbag"
    with open_source(path) as bag:
        assert bag.frame_count == len(images) and bag.rig.imu is not None and source.rig.imu is not None
        np.testing.assert_array_equal(bag.rig.left.params, source.rig.left.params)
        np.testing.assert_allclose(bag.rig.left_T_right, source.rig.left_T_right, atol=1e-12)
        np.testing.assert_allclose(bag.rig.imu.left_T_imu, source.rig.imu.left_T_imu, atol=1e-12)
        read = list(bag)
    assert [image.stamp_ns for image in read] == [image.stamp_ns for image in images]
    for a, b in zip(read, images, strict=True):
        np.testing.assert_array_equal(a.left, b.left)
        np.testing.assert_array_equal(a.right, b.right)
        assert a.imu is not None and b.imu is not None
    for name in ("stamp_ns", "gyro", "accel"):
        both = [np.concatenate([getattr(i.imu, name) for i in some]) for some in (read, images)]
        np.testing.assert_array_equal(both[0], both[1][: len(both[0])])
        assert len(both[0]) >= len(both[1]) - 1  # a sample later than the last image has no image


@pytest.mark.parametrize("kind", [KINDS[0], KINDS[2]])
def test_a_folder_without_metadata(kind: str, tmp_path: Path) -> None:
    """As a recorder leaves it that was killed: its only file is read; of several none is chosen."""
    source, images = _simulated()
    folder = write_bag(tmp_path, kind, source.rig, images)
    (folder / "metadata.yaml").unlink()
    with open_source(folder) as bag:
        assert [image.stamp_ns for image in bag] == [image.stamp_ns for image in images]
    only = next(folder.iterdir())
    shutil.copy(only, only.with_name(f"second{only.suffix}"))
    with pytest.raises(StereoSfmError, match=r"2 files and no metadata\.yaml: 'ros2 bag reindex"):
        open_source(folder)


@pytest.mark.parametrize(
    "kind", ["nav_msgs/msg/Odometry", "geometry_msgs/msg/TwistStamped", "sensor_msgs/msg/JointState"]
)
def test_wheels_of_a_bag(kind: str, tmp_path: Path) -> None:
    source, images = _simulated()
    stamps = images[0].stamp_ns - 15_000_000 + 20_000_000 * np.arange(15)
    rng = np.random.default_rng(0)
    linear, angular, speeds = rng.normal(size=(15, 3)), rng.normal(size=(15, 3)), rng.normal(size=(15, 2))
    left_T_base = se3.exp(np.array([0.1, 0.7, -0.2, 1.2, -1.2, 1.2]))

    def extra(bag: BagWriter) -> None:
        bag.transform(FRAMES[0], "base_link", left_T_base, images[0].stamp_ns)
        for k in range(15):
            bag.wheels(kind, int(stamps[k]), linear[k], angular[k], speeds[k])

    path = write_bag(tmp_path, KINDS[0], source.rig, images, extra=extra)
    joints = kind == "sensor_msgs/msg/JointState"
    options = {"wheel": "/wheel_odom", "joints": "left_joint,right_joint"} if joints else {}
    with open_source(path, **options) as bag:
        parts = [image.wheel for image in bag if image.wheel is not None]
        wheel = bag.rig.wheel
    found = WheelSamples.joined(parts)
    n = len(found)
    np.testing.assert_array_equal(found.stamp_ns, stamps[:n])
    assert n >= 14 and found.stamp_ns[-1] <= images[-1].stamp_ns
    if joints:
        np.testing.assert_array_equal(found.speeds, speeds[:n])
        assert wheel is None and np.isnan(found.linear).all()
    else:
        np.testing.assert_array_equal(found.linear, linear[:n])
        np.testing.assert_array_equal(found.angular, angular[:n])
        assert wheel is not None and wheel.model == "twist"
        np.testing.assert_allclose(wheel.left_T_wheel, left_T_base, atol=1e-12)
    with pytest.raises(StereoSfmError, match="has no wheel odometry /nothing"):
        open_source(path, wheel="/nothing")


def test_the_poses_are_those_of_the_images(tmp_path: Path) -> None:
    source, images = _simulated()
    path = write_bag(tmp_path, KINDS[0], source.rig, images)
    with open_source(path) as bag:
        found, expected = _positions(bag, list(bag)), _positions(source, images)
    truth = source.ground_truth
    assert truth is not None and truth.length > 0.1
    np.testing.assert_allclose(found, expected, atol=2e-3)
    error = np.linalg.norm(found[-1] - (np.linalg.inv(truth.poses[0]) @ truth.poses[-1])[:3, 3])
    assert error < 0.05 * truth.length


def _positions(source: Source, images: list[StereoImage]) -> F64:
    tracker = Tracker(source.rig)
    return np.array([tracker.step(i.left, i.right, i.stamp_ns).odom_T_cam[:3, 3] for i in images])


@pytest.mark.parametrize("kind", [KINDS[0], KINDS[3]])
def test_the_commands_take_bags(kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source, images = _simulated()
    path = write_bag(tmp_path, kind, source.rig, images)
    assert main(["info", str(path), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["images"]["count"] == len(images) and abs(found["images"]["hz"] - 30) < 0.5
    assert not found["problems"] and found["calibration"]
    assert any("imu" in row[0] for row in found["rows"])
    out = tmp_path / "run"
    assert main(["run", str(path), "--inline", "-o", str(out), "--log", "none"]) == 0
    lines = (out / "trajectory_odom.tum").read_text().splitlines()
    assert len([line for line in lines if not line.startswith("#")]) == len(images)
    assert main(["check-calib", str(path), "--windows", "1"]) in (0, 3)


def test_separate_topics_of_gyroscope_and_accelerometer(tmp_path: Path) -> None:
    """As from realsense-ros: -1 in the covariance of quantities that a message does not contain."""
    source, images = _simulated()
    nothing, start = np.full(3, np.nan), images[0].stamp_ns

    def halves(bag: object) -> None:
        for k in range(10):
            bag.imu(start + k * 10**7, np.array([1.0, 2.0, k]), nothing, "/camera/gyro/sample")  # pyright: ignore
            bag.imu(start + k * 10**7 + 1, nothing, np.array([0.0, k, 9.8]), "/camera/accel/sample")  # pyright: ignore

    plain = [StereoImage(i.frame_id, i.stamp_ns, i.left, i.right) for i in images]
    path = write_bag(tmp_path, KINDS[0], source.rig, plain, extra=halves)
    with open_source(path) as bag:
        samples = [i.imu for i in bag]
    gyro = np.concatenate([s.gyro for s in samples if s is not None])
    accel = np.concatenate([s.accel for s in samples if s is not None])
    assert len(gyro) == 20
    np.testing.assert_array_equal(gyro[::2, 2], np.arange(10))
    np.testing.assert_array_equal(accel[1::2, 1], np.arange(10))
    assert np.isnan(gyro[1::2]).all() and np.isnan(accel[::2]).all()


def test_a_sensor_of_another_clock_is_left_out_and_named(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    source, images = _simulated()
    up = np.array([0.0, 0.0, 9.8])

    def later(bag: BagWriter) -> None:
        for i in images:
            bag.imu(i.stamp_ns + 10**18, np.zeros(3), up, logged_ns=i.stamp_ns)

    plain = [StereoImage(i.frame_id, i.stamp_ns, i.left, i.right) for i in images]
    path = write_bag(tmp_path, KINDS[0], source.rig, plain, extra=later)
    with caplog.at_level(logging.WARNING, "stereo_sfm"), open_source(path) as bag:
        assert bag.rig.imu is None and all(image.imu is None for image in bag)
    why = "the stamps of /imu/data are 1e+09 s away from the images': another clock"
    assert why in caplog.text
    out = tmp_path / "run"
    assert main(["run", str(path), "--inline", "-q", "-o", str(out), "--log", "none"]) == 0
    assert why in (out / "report.md").read_text()  # although it was said before the run began


@pytest.mark.parametrize("kind", KINDS)
def test_bad_bags_are_one_line(kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source, images = _simulated()
    path = write_bag(tmp_path, kind, source.rig, images[:3])
    inside = path if path.is_file() else max(path.glob("bag*"), key=lambda p: p.stat().st_size)
    whole = inside.read_bytes()
    rng = np.random.default_rng(KINDS.index(kind))
    damaged = bytearray(whole)
    for at in rng.integers(200, len(whole), 2000):
        damaged[at] ^= 0xFF
    for data in (b"", whole[:100], whole[: len(whole) // 3], bytes(damaged)):
        inside.write_bytes(data)
        message = _error_of(path)
        assert "\n" not in message and (str(path) in message or len(data) == len(whole))  # flipped pixels are no damage
    inside.unlink()
    assert main(["info", str(path)]) == StereoSfmError.exit_code
    assert len(capsys.readouterr().err.strip().splitlines()) == 1


def _error_of(path: Path) -> str:
    """The error of reading a bag, "" if there is none."""
    try:
        with open_source(path) as bag:
            list(bag)
    except StereoSfmError as error:
        return str(error)
    return ""


def _rewritten(path: Path, kind: str) -> Path:
    """A bag with its chunks, or in a folder its messages, compressed."""
    if path.is_dir():
        pack_messages(path, zstandard.compress)
        return path
    writer = rosbag1.Writer(path.with_name(f"{kind}.bag"))
    writer.set_compression(rosbag1.Writer.CompressionFormat[kind])
    return copied(rosbag1.Reader(path), writer, "md5sum")


@pytest.mark.parametrize("kind", ["BZ2", "LZ4", "message"])
def test_compressed_bags_are_read_up_to_a_limit(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source, images = _simulated()
    path = _rewritten(write_bag(tmp_path, KINDS[0] if kind == "message" else ".bag", source.rig, images), kind)
    with open_source(path) as bag:
        for a, b in zip(bag, images, strict=True):
            np.testing.assert_array_equal(a.left, b.left)
    monkeypatch.setattr(unpacked, "MAX_BYTES", 10_000)
    assert "is damaged: a compressed part has more than 10000 bytes" in _error_of(path)


def test_files_that_are_compressed_as_wholes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    source, images = _simulated()
    path = write_bag(tmp_path, KINDS[0], source.rig, images)
    path = compressed_bag(path, rosbag2.CompressionMode.FILE, rosbag2.StoragePlugin.SQLITE3)
    before = set(tmp_path.iterdir())
    with open_source(path) as bag:
        for a, b in zip(bag, images, strict=True):
            np.testing.assert_array_equal(a.left, b.left)
        assert len(set(tmp_path.iterdir()) - before) == 1
    assert set(tmp_path.iterdir()) == before
    monkeypatch.setattr(unpacked.shutil, "disk_usage", lambda _: SimpleNamespace(free=2_000))
    assert "more than 0.0 MB; temporary files are in TMPDIR" in _error_of(path)
    monkeypatch.undo()
    name = next(path.glob("*.zstd"))
    name.write_bytes(zstandard.compress(bytes(50_000_000)))
    assert "unpacked, a file would have more than 0." in _error_of(path)
    name.unlink()
    assert f"its file {name.name} is missing" in _error_of(path)
    assert set(tmp_path.iterdir()) == before


def test_a_bomb_in_an_mcap_file_of_a_bag(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source, images = _simulated()
    path = write_bag(tmp_path, KINDS[2], source.rig, images)
    path = compressed_bag(path, rosbag2.CompressionMode.STORAGE, rosbag2.StoragePlugin.MCAP)
    assert _error_of(path) == ""
    monkeypatch.setattr(unpacked, "MAX_BYTES", 10_000)
    assert "a compressed part has more than 10000 bytes" in _error_of(path)


@pytest.mark.parametrize(
    ("column", "value"), [("timestamp", "'now'"), ("timestamp", 1.5), ("data", "NULL"), ("data", 7)]
)
def test_rows_of_something_else_are_one_line(column: str, value: object, tmp_path: Path) -> None:
    source, images = _simulated()
    path = write_bag(tmp_path, KINDS[0], source.rig, images[:3])
    with closing(sqlite3.connect(path / "bag.db3")) as base:
        base.executescript(
            "CREATE TABLE other(id INTEGER PRIMARY KEY, topic_id, timestamp, data);"
            "INSERT INTO other SELECT * FROM messages; DROP TABLE messages; ALTER TABLE other RENAME TO messages;"
            f"UPDATE messages SET {column} = {value} WHERE id > 5;"
        )
    assert _error_of(path) == f"{path} is damaged: a message without time or content"


@pytest.mark.parametrize("name", ["a?b", "a#b", "a%20b"])
def test_names_that_the_library_takes_for_others(name: str, tmp_path: Path) -> None:
    source, images = _simulated()
    path = write_bag(tmp_path, KINDS[0], source.rig, images[:3]).rename(tmp_path / name)
    assert "for another path: rename" in _error_of(path)


def test_a_missing_topic_and_a_missing_place_are_one_line(tmp_path: Path) -> None:
    source, images = _simulated()
    path = write_bag(tmp_path, KINDS[0], source.rig, images[:3])
    with pytest.raises(StereoSfmError, match="no image topic /x"):
        open_source(f"{path}?left=/x")
    with pytest.raises(StereoSfmError, match="no bag given"):
        open_source("rosbag:")
    with pytest.raises(StereoSfmError, match="no bag at"):
        open_source(f"rosbag:{tmp_path / 'nothing'}")
