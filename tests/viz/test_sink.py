"""What the viewer is sent: every part of a run under the entity where the blueprint shows it."""

from __future__ import annotations

import dataclasses
import logging
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rerun as rr

from stereo_sfm.geometry import se3
from stereo_sfm.messages import Health
from stereo_sfm.pipeline.inline import run_inline
from stereo_sfm.types import Dropped, LoopResult, Trajectory
from stereo_sfm.viz import sink
from stereo_sfm.viz.shapes import age_colors, spread_colors, strips, wire_cameras
from tests.pipeline.test_pipeline import CONFIG, SlidingWall

FRAMES = 60
EVERY_FRAME = ("map/camera", "map/camera/left/features", "map/camera/left/image", "points/tracked", "points/inliers",
               "right/disparity", "right/image", "ms/track")  # fmt: skip


class Recording:
    """Replaces a rerun stream and collects what is logged."""

    def __init__(self, *_: Any, **__: Any) -> None:
        self.logged: list[tuple[str, Any]] = []

    def log(self, entity: str, what: Any, static: bool = False) -> None:
        self.logged.append((entity, what))

    def of(self, entity: str) -> list[Any]:
        return [what for name, what in self.logged if name == entity]

    def save(self, *_: Any, **__: Any) -> None: ...
    def set_time(self, *_: Any, **__: Any) -> None: ...
    def flush(self, **__: Any) -> None: ...
    def disconnect(self) -> None: ...


@pytest.fixture(autouse=True)
def errors_are_raised() -> Iterator[None]:
    """Rerun only warns of arrays that it does not understand."""
    before = rr.strict_mode()
    rr.set_strict_mode(True)
    yield
    rr.set_strict_mode(before)


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sink.rr, "RecordingStream", Recording)
        source = SlidingWall(FRAMES)
        truth = Trajectory(np.arange(FRAMES), np.tile(np.eye(4), (FRAMES, 1, 1)))
        viewer = sink.RerunSink(source.rig, "wall", "save", tmp_path_factory.mktemp("shown") / "unused.rrd", truth)
        for _ in run_inline(source, CONFIG, [viewer]):
            pass
        for message in (Dropped(31, 0, "ring", "slow", 2), Health("tracker", 29, 30.0, 0, 1.0, 2.0, 3.0, 0)):
            viewer.put(message)
        none = np.zeros((0, 2), np.int64)
        viewer.put(LoopResult(2, 0, np.eye(4), np.eye(6), none, 40, 0.5, ""))
        viewer.put(LoopResult(3, -1, np.eye(4), np.eye(6), none, 0, 0.1, "too_few_inliers", ((0, 0.1, "x"),)))
        viewer.close()
        recording: Any = viewer._rec
        return recording


def test_every_frame_is_shown_with_its_tracks(shown: Recording) -> None:
    count = Counter(entity for entity, _ in shown.logged)
    series = {"points/tracked", "points/inliers", "ms/track"}  # their colours come once
    assert {entity: count[entity] - (entity in series) for entity in EVERY_FRAME} == dict.fromkeys(EVERY_FRAME, FRAMES)


def test_masks_lie_over_the_images(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(sink.rr, "RecordingStream", Recording)
    rig = SlidingWall(1).rig
    used = np.ones((rig.left.height, rig.left.width), bool)
    used[-20:] = False
    viewer = sink.RerunSink(dataclasses.replace(rig, left_mask=used), "wall", "save", tmp_path / "unused.rrd")
    recording: Any = viewer._rec
    colors, shown = recording.of("map/camera/left/mask")
    assert isinstance(colors, rr.AnnotationContext)
    classes = np.array(shown.buffer.as_arrow_array().to_pylist()[0], np.uint8)
    np.testing.assert_array_equal(classes.reshape(used.shape), ~used)
    assert not recording.of("right/mask")


def test_the_map_is_shown(shown: Recording) -> None:
    assert len(shown.of("map/points")[-1].positions) > 50
    (line,) = shown.of("map/trajectory")[-1].strips.as_arrow_array().to_pylist()
    cameras = shown.of("map/keyframes")[-1].strips.as_arrow_array().to_pylist()
    assert len(line) == len(cameras) >= 3  # one pyramid at each corner of the line
    for corner, camera in zip(line, cameras, strict=True):
        assert camera[0] == pytest.approx(corner)
    assert len(shown.of("map/covisibility")[-1].strips) >= 2
    assert len(shown.of("map/loops")[-1].strips) == 1
    assert len(shown.of("map/ground_truth")) == 1


def test_the_log_has_loops_and_reasons_of_rejection(shown: Recording) -> None:
    texts = [what.text.as_arrow_array().to_pylist()[0] for what in shown.of("log")]
    assert texts[-2:] == ["loop: keyframe 2 sees keyframe 0 again, 40 inliers",
                          "loop: no loop at keyframe 3, 1 rejected: too few inliers"]  # fmt: skip


def test_drops_and_rates_are_series(shown: Recording) -> None:
    assert shown.of("points/dropped")[0].scalars.as_arrow_array().to_pylist() == [2.0]
    assert shown.of("rate/tracker")[0].scalars.as_arrow_array().to_pylist() == [30.0]


def test_matches_join_a_keyframe_with_a_later_frame(shown: Recording) -> None:
    lines = np.array(shown.of("matches/lines")[-1].strips.as_arrow_array().to_pylist())
    assert 10 < len(lines) <= sink.MATCHES_DRAWN
    width = SlidingWall(1).rig.left.width
    assert lines[:, 0, 0].max() < width <= lines[:, 1, 0].min()


def test_a_recording_without_a_run_shows_its_images(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(sink.rr, "RecordingStream", Recording)
    source = SlidingWall(70)
    viewer = sink.RerunSink(source.rig, "wall", "save", tmp_path / "unused.rrd")
    for image in source:
        viewer.put(image)
    viewer.close()
    recording: Any = viewer._rec
    assert len(recording.of("map/camera/left/image")) == len(recording.of("right/image")) == 70


def test_a_saved_recording_is_valid(tmp_path: Path) -> None:
    source = SlidingWall(5)
    viewer = sink.RerunSink(source.rig, "some/where/wall.mcap", "save", tmp_path / "run.rrd")
    for _ in run_inline(source, CONFIG, [viewer]):
        pass
    viewer.close()
    command = [sys.executable, "-m", "rerun", "rrd", "verify", str(tmp_path / "run.rrd")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert "verified without error" in done.stdout + done.stderr


def test_strips_are_what_rerun_makes_of_a_list_of_lines() -> None:
    rng = np.random.default_rng(0)
    flat, solid = rng.normal(size=(7, 2, 2)), rng.normal(size=(5, 11, 3))
    assert rr.LineStrips2D(strips(flat)).strips == rr.LineStrips2D(list(flat)).strips
    assert rr.LineStrips3D(strips(solid)).strips == rr.LineStrips3D(list(solid)).strips
    assert len(rr.LineStrips3D(strips(np.zeros((0, 2, 3)))).strips) == 0


def test_wire_cameras_face_along_z() -> None:
    pose = se3.exp(np.array([1.0, 2.0, 3.0, 0.0, np.pi / 2, 0.0]))
    (stroke,) = wire_cameras(pose[None], 2.0)
    local = se3.transform(se3.inverse(pose), stroke)
    assert np.allclose(local[0], 0)
    assert set(np.round(local[:, 2], 9)) == {0.0, 1.4}
    assert np.allclose(local[local[:, 2] > 0].mean(0)[:2], 0, atol=0.5)


def test_colors_run_from_blue_to_red() -> None:
    new, old = age_colors(np.array([0, 60], np.int32)).astype(int)
    assert new[2] > new[0] and old[0] > old[2]
    low, high = spread_colors(np.array([0.0, 100.0])).astype(int)
    assert low[2] > low[0] and high[0] > high[2]
    assert spread_colors(np.zeros(0)).shape == (0, 3)


def test_an_unresponsive_viewer_is_a_warning(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    def gone(self: Recording, timeout_sec: float) -> None:
        raise RuntimeError("deadline expired\nmore")

    monkeypatch.setattr(Recording, "flush", gone)
    monkeypatch.setattr(rr, "RecordingStream", Recording)
    monkeypatch.setattr(logging.getLogger("stereo_sfm"), "propagate", True)
    viewer = sink.RerunSink(SlidingWall(1).rig, "wall", "save", tmp_path / "run.rrd")
    viewer.close()
    assert "the viewer does not respond" in caplog.text and "more" not in caplog.text
