"""`diff` finds the first topic, frame and field, and no difference of the wall clock."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stereo_sfm.cli import main
from stereo_sfm.config import Config
from stereo_sfm.drivers.memory import MemorySource
from stereo_sfm.log import topics
from stereo_sfm.log.diff import Difference, diff
from stereo_sfm.log.reader import LogReader
from stereo_sfm.log.writer import LogWriter
from stereo_sfm.types import Frame, Observations, StereoImage, TrackState
from tests.log.recordings import fisheye_rig, sequence_truth, stereo_images, write_recording


def _frames(count: int) -> list[Frame]:
    rng = np.random.default_rng(0)
    unseen, ages, used = np.full((5, 2), np.nan), np.zeros(5, np.int32), np.ones(5, bool)
    return [
        Frame(
            frame_id=i,
            stamp_ns=10**9 + i * 10**7,
            odom_T_cam=rng.normal(size=(4, 4)),
            covariance=np.eye(6),
            state=TrackState.OK,
            reason="",
            observations=Observations(np.arange(5), rng.normal(size=(5, 2)), unseen, ages, used),
            reference_kf_id=-1,
            kf_T_cam=np.eye(4),
            stats={"a": 1.0},
        )
        for i in range(count)
    ]


def _write(path: Path, frames: list[Frame], clock: Callable[[], int] = lambda: 0) -> Path:
    with LogWriter(path, overwrite=True, clock=clock) as writer:
        for frame in frames:
            writer.write(topics.FRAME, frame, frame.stamp_ns, frame.frame_id)
    return path


def _diff(a: Path, b: Path, **options: float) -> list[Difference]:
    with LogReader(a) as one, LogReader(b) as other:
        return diff(one, other, **options)  # pyright: ignore[reportArgumentType]


def test_the_same_run_at_another_time_of_day_is_identical(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ticks = iter(range(10**18, 10**19, 10**8))
    a = _write(tmp_path / "a.mcap", _frames(20))
    b = _write(tmp_path / "b.mcap", _frames(20), lambda: next(ticks))  # other chunks as well
    assert a.read_bytes() != b.read_bytes()
    assert main(["diff", str(a), str(b)]) == 0
    assert capsys.readouterr().out == "identical\n"


def test_the_first_frame_and_field_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    frames = _frames(20)
    pose = frames[7].odom_T_cam.copy()
    pose[1, 3] = np.nextafter(pose[1, 3], 9)
    changed = list(frames)
    changed[7] = replace(frames[7], odom_T_cam=pose)
    changed[9] = replace(frames[9], reason="later")
    a, b = _write(tmp_path / "a.mcap", frames), _write(tmp_path / "b.mcap", changed)
    assert main(["diff", str(a), str(b)]) == 3
    text = capsys.readouterr().out
    assert text.startswith(
        f"/frame frame 7 at {frames[7].stamp_ns} ns: odom_T_cam[7]: {float(frames[7].odom_T_cam[1, 3])!r} != "
    )
    (found,) = _diff(a, b, tolerance=1e-9)
    assert (found.frame_id, found.field, found.a, found.b) == (9, "reason", "''", "'later'")


def test_a_message_more_a_message_less(tmp_path: Path) -> None:
    frames = _frames(6)
    a, b = _write(tmp_path / "a.mcap", frames), _write(tmp_path / "b.mcap", frames[:4])
    (found,) = _diff(a, b)
    assert (found.topic, found.frame_id, found.a, found.b) == (topics.FRAME, 4, "present", "missing")
    (found,) = _diff(b, a)
    assert (found.frame_id, found.a, found.b) == (4, "missing", "present")
    c = _write(tmp_path / "c.mcap", [*frames[:2], *frames[3:]])
    (found,) = _diff(a, c)
    assert (found.frame_id, found.field, found.a, found.b) == (2, "frame id", "2", "3")


def test_nan_equals_nan_and_counts_are_named(tmp_path: Path) -> None:
    frames = _frames(3)
    short = replace(frames[1].observations, age=np.zeros(4, np.int32))
    a = _write(tmp_path / "a.mcap", frames)
    b = _write(tmp_path / "b.mcap", [frames[0], replace(frames[1], observations=short), frames[2]])
    (found,) = _diff(a, b)
    assert (found.field, found.a, found.b) == ("observations.age (count)", "5", "4")


def test_lossless_formats_are_the_same_images(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    images, truth = stereo_images(6, rng), sequence_truth(20, rng)
    for name in ("png", "raw"):
        write_recording(tmp_path / f"{name}.mcap", MemorySource(fisheye_rig(), images, truth), name)
    assert _diff(tmp_path / "png.mcap", tmp_path / "raw.mcap") == []
    assert main(["convert", str(tmp_path / "raw.mcap"), "-o", str(tmp_path / "again.mcap"), "-q"]) == 0
    assert _diff(tmp_path / "again.mcap", tmp_path / "raw.mcap") == []
    left = images[2].left.copy()
    left[5, 9] ^= 1
    other: list[StereoImage] = [*images[:2], replace(images[2], left=left), *images[3:]]
    write_recording(tmp_path / "other.mcap", MemorySource(fisheye_rig(), other, truth))
    (found,) = _diff(tmp_path / "raw.mcap", tmp_path / "other.mcap")
    assert (found.topic, found.frame_id, found.field) == ("/cam0/image", 2, "pixel (9, 5)")


def test_another_calibration_and_a_missing_topic_come_first(tmp_path: Path) -> None:
    images = stereo_images(3, np.random.default_rng(2))
    write_recording(tmp_path / "a.mcap", MemorySource(fisheye_rig(), images))
    still = [replace(image, imu=None) for image in images]
    write_recording(tmp_path / "b.mcap", MemorySource(replace(fisheye_rig(), name="other"), still))
    found = _diff(tmp_path / "a.mcap", tmp_path / "b.mcap")
    assert [(d.topic, d.field) for d in found[:3]] == [
        ("/imu", "messages"),
        ("calibration.yaml", "line"),
        ("/image_info", "imu_count"),
    ]


def test_chosen_topics_only(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    a, b = _write(tmp_path / "a.mcap", _frames(3)), _write(tmp_path / "b.mcap", _frames(2))
    assert main(["diff", str(a), str(b), "--topics", "/imu"]) == 2
    assert "neither file has the topic /imu" in capsys.readouterr().err
    assert main(["diff", str(a), str(b), "--topics", "/frame"]) == 3


def test_the_wall_clock_topics_do_not_count(tmp_path: Path) -> None:
    from stereo_sfm.log import foxglove

    for name, text in (("a", "one"), ("b", "two")):
        with LogWriter(tmp_path / f"{name}.mcap") as writer:
            writer.write(topics.LOG, foxglove.text(5, "INFO", text), 5)
            writer.write(topics.FRAME, _frames(1)[0], 10**9)
    assert _diff(tmp_path / "a.mcap", tmp_path / "b.mcap") == []


def test_a_changed_configuration_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from stereo_sfm.log.provenance import write_provenance

    for name, seed, count in (("a", 0, 3), ("b", 5, 2)):
        with LogWriter(tmp_path / f"{name}.mcap") as writer:
            write_provenance(writer, source="s", serial="", mode="inline", image_format="png", config=Config(seed=seed))
            for frame in _frames(count):
                writer.write(topics.FRAME, frame, frame.stamp_ns, frame.frame_id)
    assert main(["diff", str(tmp_path / "a.mcap"), str(tmp_path / "b.mcap")]) == 3
    assert "the configurations differ: seed = 0 -> seed = 5" in capsys.readouterr().out
