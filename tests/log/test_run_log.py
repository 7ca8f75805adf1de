"""The run log: its content, independence of the order of arrival, and reading by other programs."""

from __future__ import annotations

import resource
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.Odometry_pb2 import Odometry
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from mcap.records import Message
from mcap.stream_reader import StreamReader

from stereo_sfm.calib.imu import Imu
from stereo_sfm.cli import main
from stereo_sfm.config import Config, from_dict
from stereo_sfm.drivers import open_source
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.log import foxglove, schema, topics
from stereo_sfm.log.diff import diff
from stereo_sfm.log.image_log import LEVEL_T_MAP, level_T_map
from stereo_sfm.log.map_view import MapView
from stereo_sfm.log.reader import LogReader
from stereo_sfm.log.recorded import messages, read_run
from stereo_sfm.log.run_log import RunLog
from stereo_sfm.log.track_stats import TrackStats, track_stats
from stereo_sfm.log.writer import LogWriter
from stereo_sfm.messages import Health, LogLine, SourceCounters, StageTimes
from stereo_sfm.types import (
    F64,
    Applied,
    CalibrationUpdate,
    Dropped,
    Frame,
    Keyframe,
    LiveDepth,
    LoopResult,
    MapUpdate,
    Observations,
    RowErrors,
    SensorUpdate,
    StartCheck,
    TrackState,
)
from tests.log.recordings import (
    PERIOD_NS,
    START_NS,
    MemorySource,
    fisheye_rig,
    sequence_truth,
    stereo_images,
    write_recording,
)

FRAMES = 60
KEYFRAME_EVERY = 6
LAG = 3  # frames after which an update is applied


DOWN = np.array([0.0, 0.96, 0.28])  # gravity in the map


def _map_T_odom(version: int) -> F64:
    return se3.exp(np.array([0.01 * version, 0.0, 0.0, 0.0, 0.002 * version, 0.0]))


def _odom_T_cam(frame_id: int) -> F64:
    return se3.exp(np.array([0.0, 0.0, 0.05 * frame_id, 0.0, 0.01 * frame_id, 0.0]))


def _frame(i: int) -> Frame:
    rng = np.random.default_rng(i)
    n = 40
    obs = Observations(
        np.arange(n) + 10 * (i // KEYFRAME_EVERY),
        rng.uniform(0, 80, (n, 2)),
        np.where(rng.random((n, 1)) < 0.5, rng.uniform(0, 80, (n, 2)), np.nan),
        np.full(n, i % 40, np.int32),
        rng.random(n) < 0.8,
    )
    version = 0 if i < LAG else (i - LAG) // KEYFRAME_EVERY + 1
    stats = {"inliers": 30.0, "something_new": 1.5}
    return Frame(
        i, START_NS + i * PERIOD_NS, _odom_T_cam(i), np.eye(6) * 1e-4, TrackState.OK, "", obs, i // KEYFRAME_EVERY,
        np.eye(4), version, i % KEYFRAME_EVERY == 0, stats,
    )  # fmt: skip


def _keyframe(k: int) -> Keyframe:
    frame, rng = _frame(k * KEYFRAME_EVERY), np.random.default_rng(k)
    n = len(frame.observations)
    return Keyframe(
        k, frame.frame_id, frame.stamp_ns, frame.odom_T_cam.copy(), frame.observations.point_ids,
        frame.observations.uv_left, frame.observations.uv_right, rng.normal(size=(n, 3)),
        rng.integers(0, 256, (n, 32), np.uint8),
    )  # fmt: skip


def _calibration(k: int) -> CalibrationUpdate:
    terms = np.arange(8) * 1e-3
    return CalibrationUpdate(k + 1, k, START_NS, terms, np.diag(terms**2), 2, True, "step", "turned")


START_CHECK = StartCheck(0, START_NS, "the right camera is turned", "corrected", True, "stereo_sfm_rig: 1\n", -1)


def _sensors(k: int) -> SensorUpdate:
    return SensorUpdate(
        k + 1, k, START_NS, np.arange(4) * 1e-3, np.full(4, np.inf), np.arange(8) * 1e-3, np.ones(8), "wheels' scale"
    )


def _row_errors(k: int) -> RowErrors:
    return RowErrors(k, START_NS, np.linspace(-0.1, 0.1, 12), 0.1, -0.01, False)


def _answers(k: int) -> tuple[MapUpdate, LoopResult]:
    keyframe = _keyframe(k)
    map_T_odom = _map_T_odom(k + 1)
    update = MapUpdate(
        k + 1, k, np.array([k]), (map_T_odom @ keyframe.odom_T_cam)[None], keyframe.point_ids.copy(),
        np.random.default_rng(k + 99).normal(size=(len(keyframe.point_ids), 3)), np.array([10 * k]),
        np.zeros((0, 2), np.int64), map_T_odom, calibration=_calibration(k) if k == 6 else None,
        row_errors=_row_errors(k), sensors=_sensors(k) if k == 7 else None, down=DOWN,
    )  # fmt: skip
    accepted = k in (5, 8)
    loop = LoopResult(
        k, k - 4 if accepted else -1, np.eye(4), np.eye(6), np.zeros((0, 2), np.int64), 50 * accepted, 0.4,
        "" if accepted else "no_candidate", ((1, 0.5, "too_few_inliers"),),
    )  # fmt: skip
    return update, loop


def _streams() -> list[list[object]]:
    """Messages of capture, tracker, mapper and loop closer, each in its own order."""
    tracker: list[object] = []
    for i in range(FRAMES):
        tracker.append(_frame(i))
        if i % KEYFRAME_EVERY == 0:
            tracker.append(_keyframe(i // KEYFRAME_EVERY))
    answers = [_answers(k) for k in range(FRAMES // KEYFRAME_EVERY)]
    return [tracker, [u for u, _ in answers], [r for _, r in answers]]


def _write(path: Path, order: np.random.Generator | None, imu: Imu | None = None) -> None:
    """Without `order` each stream after the other's cause; with it, at random."""
    rig = replace(fisheye_rig(), imu=imu)
    log = RunLog(LogWriter(path, clock=lambda: 0), rig, Config(), source="test", mode="inline",
                 ground_truth=sequence_truth(30, np.random.default_rng(0)))  # fmt: skip
    log.image(stereo_images(1, np.random.default_rng(0))[0])
    streams = [list(reversed(s)) for s in _streams()]
    while any(streams):
        alive = [s for s in streams if s]
        log.put(alive[0 if order is None else order.integers(len(alive))].pop())
    log.put(Applied(1, 3))
    log.put(LiveDepth(5, START_NS, np.full((4, 6), 1500, np.uint16), np.ones(4), np.ones((2, 3), np.float32)))
    log.put(Dropped(9, START_NS, "ring", "full", 2))
    log.put(START_CHECK)
    log.put(Health("track", 5, 30.0, 1, 1.0, 2.0, 3.0, 0))
    log.put(StageTimes(5, {"track": 3.5}))
    log.put(SourceCounters(5, {"pairs": 6.0, "stalls": 1.0}))
    log.put(LogLine("tracker", "WARNING", "dark"))
    log.close()
    log.close()


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("run") / "run.mcap"
    _write(path, None)
    return path


def _all(path: Path, topic: str, kind: type) -> list:
    with LogReader(path) as reader:
        if hasattr(kind, "FromString"):
            return [kind.FromString(r.data) for r in reader.messages([topic])]
        return [schema.decoder(kind, r.schema.data)(r.data) for r in reader.messages([topic]) if r.schema]


def test_a_correction_of_six_terms_from_an_older_log_is_read() -> None:
    new, terms = _calibration(3), np.arange(6) * 1e-3
    old = replace(new)
    object.__setattr__(old, "terms", terms)
    object.__setattr__(old, "terms_covariance", np.diag(terms**2))
    read = schema.decoder(CalibrationUpdate, schema.schema_data(CalibrationUpdate))(schema.encode(old))
    assert np.array_equal(read.terms, np.concatenate([terms, np.zeros(2)]))
    assert np.array_equal(np.diag(read.terms_covariance), np.concatenate([terms**2, np.zeros(2)]))
    assert read.terms_covariance.shape == (8, 8)


def test_every_topic_of_the_table_that_a_run_has_is_there(run: Path) -> None:
    with LogReader(run) as reader:
        present = {t.topic: t.schema for t in reader.topics}
        assert set(present) == {t.name for t in topics.TABLE} - {topics.DEPTH_IMAGE, topics.WHEEL, topics.THUMBNAIL}
        assert all(name in topics.BY_NAME[t].schema.split("|") for t, name in present.items())
        assert b"[tracker]" in (reader.attachment("config.toml") or b"")
        assert len(reader.metadata("stereo_sfm")["config_sha256"]) == 12


@pytest.mark.parametrize("seed", range(6))
def test_the_order_of_arrival_changes_nothing(run: Path, tmp_path: Path, seed: int) -> None:
    _write(tmp_path / "b.mcap", np.random.default_rng(seed))
    with LogReader(run) as a, LogReader(tmp_path / "b.mcap") as b:
        assert [str(d) for d in diff(a, b)] == []
    times: dict[int, int] = {}
    with (tmp_path / "b.mcap").open("rb") as stream:  # in the order of the file
        for record in StreamReader(stream).records:
            if isinstance(record, Message):
                assert record.log_time >= times.get(record.channel_id, 0)
                times[record.channel_id] = record.log_time


def test_with_an_imu_the_level_comes_with_the_frames_whatever_the_order(tmp_path: Path) -> None:
    found = []
    for name, order in (("a.mcap", None), ("b.mcap", np.random.default_rng(1))):
        _write(tmp_path / name, order, Imu())
        tf = _all(tmp_path / name, topics.TF, FrameTransforms)
        found.append([t.SerializeToString() for t in tf])
        rows = [t for message in tf for t in message.transforms if t.parent_frame_id == "level"]
        first, last = (foxglove.matrix(t.translation, t.rotation) for t in (rows[0], rows[-1]))
        np.testing.assert_allclose(first, LEVEL_T_MAP, atol=1e-9)
        np.testing.assert_allclose(last[:3, :3] @ DOWN, [0, 0, -1], atol=1e-9)
        static = _all(tmp_path / name, topics.TF_STATIC, FrameTransforms)
        assert "level" not in {t.parent_frame_id for message in static for t in message.transforms}
    assert found[0] == found[1]


def test_poses_follow_the_map_version_that_the_frame_used(run: Path) -> None:
    rig = fisheye_rig()
    poses = _all(run, topics.MAP_POSE, PoseInFrame)
    assert len(poses) == FRAMES
    for i, message in enumerate(poses):
        frame = _frame(i)
        version = frame.map_version
        wanted = (_map_T_odom(version) if version else np.eye(4)) @ frame.odom_T_cam @ se3.inverse(rig.body_T_left)
        np.testing.assert_allclose(foxglove.matrix(message.pose.position, message.pose.orientation), wanted, atol=1e-12)
        assert foxglove.stamp_of(message) == frame.stamp_ns


def test_transforms_make_one_tree_from_level_to_the_right_camera(run: Path) -> None:
    rig = fisheye_rig()
    rows = {
        (t.parent_frame_id, t.child_frame_id): foxglove.matrix(t.translation, t.rotation)
        for topic in (topics.TF, topics.TF_STATIC)
        for message in _all(run, topic, FrameTransforms)
        for t in message.transforms
    }
    above = {("level", "map"), ("map", "truth"), ("map", "odom")}
    assert set(rows) == above | {("odom", "body"), ("body", "cam0"), ("cam0", "cam1")}
    np.testing.assert_allclose(rows["odom", "body"] @ rows["body", "cam0"], _odom_T_cam(FRAMES - 1), atol=1e-12)
    np.testing.assert_allclose(rows["cam0", "cam1"], rig.left_T_right, atol=1e-12)
    np.testing.assert_array_equal(rows["level", "map"][:3, :3] @ [0, -1, 0], [0, 0, 1])  # up in the image is z
    first = _all(run, topics.GROUND_TRUTH, PoseInFrame)[0]
    assert first.frame_id == "truth"
    truth_T_cam = foxglove.matrix(first.pose.position, first.pose.orientation)
    np.testing.assert_allclose(rows["map", "truth"] @ truth_T_cam, np.eye(4), atol=1e-12)


def test_covariance_turns_into_the_axes_of_odom() -> None:
    """Against sampled poses: positions of the body have the published covariance."""
    rig, frame = fisheye_rig(), _frame(17)
    rng = np.random.default_rng(0)
    root = rng.normal(size=(6, 6)) * 1e-4
    covariance = root @ root.T
    xi = rng.normal(size=(50_000, 6)) @ root.T
    bodies = frame.odom_T_cam @ se3.exp(xi) @ se3.inverse(rig.body_T_left)
    mean = frame.odom_T_cam @ se3.inverse(rig.body_T_left)
    turns = se3.so3_log(bodies[:, :3, :3] @ mean[:3, :3].T)
    sampled = np.cov(np.hstack([bodies[:, :3, 3] - mean[:3, 3], turns]).T)
    from tempfile import TemporaryDirectory

    with TemporaryDirectory() as folder:
        path = Path(folder) / "a.mcap"
        log = RunLog(LogWriter(path), rig, Config(), source="t", mode="inline", image_format="none")
        log.frame(replace(frame, covariance=covariance, map_version=0))
        log.close()
        (message,) = _all(path, topics.ODOMETRY, Odometry)
    published = np.reshape(message.pose_covariance, (6, 6))
    np.testing.assert_allclose(published, sampled, atol=0.05 * np.abs(published).max())


def test_points_trajectory_and_edges_are_the_map_at_the_end(run: Path) -> None:
    view = MapView()
    for k in range(FRAMES // KEYFRAME_EVERY):
        update, loop = _answers(k)
        view.keyframe(_keyframe(k), update.map_T_odom)
        view.loop(loop)
        view.update(update)
    cloud = _all(run, topics.POINTS, PointCloud)[-1]
    rows = np.frombuffer(cloud.data, np.dtype([("xyz", "<f4", 3), ("id", "<u4")]))
    expected: dict[int, np.ndarray] = {}
    for k in range(FRAMES // KEYFRAME_EVERY):
        update, _ = _answers(k)
        for point_id in update.culled_point_ids.tolist():
            expected.pop(point_id, None)
        expected.update(zip(update.point_ids.tolist(), update.points_map, strict=True))
    assert rows["id"].tolist() == sorted(expected)
    np.testing.assert_array_equal(rows["xyz"], np.float32([expected[i] for i in sorted(expected)]))
    poses = _all(run, topics.TRAJECTORY, PosesInFrame)[-1].poses
    positions = [[p.position.x, p.position.y, p.position.z] for p in poses]
    np.testing.assert_array_equal(positions, view.trajectory[1][:, :3, 3])
    scene = _all(run, topics.SCENE, SceneUpdate)[-1]
    lines = {e.id: [[p.x, p.y, p.z] for p in e.lines[0].points] for e in scene.entities}
    np.testing.assert_array_equal(lines["loops"], view.loop_lines)
    assert len(lines["loops"]) == 4  # two loops
    np.testing.assert_array_equal(lines["loops"][0], view.trajectory[1][1, :3, 3])
    assert len(lines["covisibility"]) == 2 * 9  # each keyframe shares 30 of 40 points with the one before


def test_complete_clouds_are_written_less_often_as_they_grow(tmp_path: Path) -> None:
    """A run of 1,000 keyframes, three a second: the trajectory's bytes a second do not grow."""
    path, identity = tmp_path / "a.mcap", np.eye(4)
    config = from_dict({"loop": {"enabled": False}})
    log = RunLog(LogWriter(path), fisheye_rig(), config, source="t", mode="inline", image_format="none")
    none, nothing = np.zeros(0, np.int64), np.zeros((0, 2))
    for k in range(1000):
        keyframe = replace(_keyframe(0), kf_id=k, stamp_ns=START_NS + k * 333_333_333, point_ids=none, uv_left=nothing)
        log.put(keyframe)
        pairs = nothing.astype(np.int64)
        log.put(
            MapUpdate(
                k + 1, k, np.array([k]), identity[None].copy(), none, np.zeros((0, 3)), none, pairs, identity.copy()
            )
        )
    log.close()
    shown = _all(path, topics.TRAJECTORY, PosesInFrame)
    stamps = np.array([foxglove.stamp_of(m) for m in shown[:-1]])
    sizes = np.array([len(m.poses) for m in shown[:-1]])
    assert np.diff(stamps)[0] <= 1_400_000_000 and np.diff(stamps)[-1] > 4_000_000_000
    rates = sizes[:-1] / (np.diff(stamps) / 1e9)
    assert rates.max() < 250 and len(shown[-1].poses) == 1000


def test_features_are_where_the_tracker_saw_them(run: Path) -> None:
    messages = _all(run, topics.FEATURES, ImageAnnotations)
    for i in (0, 31):
        (dots,) = messages[i].points
        np.testing.assert_array_equal([[p.x, p.y] for p in dots.points], _frame(i).observations.uv_left)
        assert len(dots.outline_colors) == len(dots.points)
    young, old = (
        messages[i].points[0].outline_colors[int(np.flatnonzero(_frame(i).observations.inlier)[0])] for i in (0, 39)
    )
    assert (young.b, young.r) == (1.0, 0.0) and (old.b, old.r) == (0.0, 1.0)


def test_messages_of_the_stages_are_read_back_completely(run: Path) -> None:
    for topic, kind, wanted in (
        (topics.FRAME, Frame, [_frame(i) for i in range(FRAMES)]),
        (topics.KEYFRAME, Keyframe, [_keyframe(k) for k in range(10)]),
        (topics.MAP_UPDATE, MapUpdate, [_answers(k)[0] for k in range(10)]),
        (topics.LOOP, LoopResult, [_answers(k)[1] for k in range(10)]),
        (topics.CALIBRATION, CalibrationUpdate, [_calibration(6)]),
        (topics.SENSORS, SensorUpdate, [_sensors(7)]),
        (topics.ROW_ERRORS, RowErrors, [_row_errors(k) for k in range(10)]),
    ):
        back = _all(run, topic, kind)
        assert [schema.encode(m) for m in back] == [schema.encode(m) for m in wanted]
    assert _all(run, topics.APPLIED, Applied) == [Applied(1, 3)]
    assert _all(run, topics.DROPPED, Dropped) == [Dropped(9, START_NS, "ring", "full", 2)]
    assert _all(run, topics.STAGE_TIMES, StageTimes) == [StageTimes(5, {"track": 3.5})]
    assert _all(run, topics.COUNTERS, SourceCounters) == [SourceCounters(5, {"pairs": 6.0, "stalls": 1.0})]


def test_stats_are_flat_and_keep_unknown_fields(run: Path) -> None:
    stats: TrackStats = _all(run, topics.STATS, TrackStats)[7]
    assert repr(stats) == repr(track_stats(_frame(7)))
    assert (stats.inliers, stats.other) == (30.0, {"something_new": 1.5})
    assert np.isnan(stats.tracked) and stats.observations == 40


def test_a_run_without_loops_or_mapping_does_not_wait(tmp_path: Path) -> None:
    config = from_dict({"loop": {"enabled": False}})
    log = RunLog(LogWriter(tmp_path / "a.mcap"), fisheye_rig(), config, source="t", mode="inline", image_format="none")
    for k in range(3):
        log.put(_keyframe(k))
        log.put(_answers(k)[0])
    log._writer.flush()
    with LogReader(tmp_path / "a.mcap") as reader:
        assert len(reader.stamps(topics.TRAJECTORY)) == 1 and len(reader.stamps(topics.MAP_UPDATE)) == 3
    log.close()


def test_text_of_a_stage_is_in_the_log(tmp_path: Path) -> None:
    log = RunLog(
        LogWriter(tmp_path / "a.mcap"), fisheye_rig(), Config(), source="t", mode="inline", image_format="none"
    )
    log.put(stereo_images(1, np.random.default_rng(0))[0])
    log.put(LogLine("tracker", "WARNING", "only 3 points"))
    log.close()
    log.put(LogLine("tracker", "WARNING", "after the end"))
    (line,) = _all(tmp_path / "a.mcap", topics.LOG, Log)
    assert (line.message, line.level, line.name) == ("only 3 points", 3, "tracker")
    assert foxglove.stamp_of(line) == START_NS


def test_the_path_is_where_the_keyframes_are(run: Path) -> None:
    (cloud,) = _all(run, topics.PATH, PointCloud)[-1:]
    (poses,) = _all(run, topics.TRAJECTORY, PosesInFrame)[-1:]
    names = [f.name for f in cloud.fields]
    assert names == ["x", "y", "z", "id", "red", "green", "blue", "alpha"] and cloud.point_stride == 20
    rows = np.frombuffer(cloud.data, np.dtype([("xyz", "<f4", 3), ("id", "<u4"), ("rgba", "u1", 4)]))
    assert rows["xyz"] == pytest.approx(np.array([[p.position.x, p.position.y, p.position.z] for p in poses.poses]))
    assert rows["rgba"].tolist() == [[70, 150, 255, 255]] * len(poses.poses)


def test_the_input_of_a_replay_is_read_back(run: Path) -> None:
    with LogReader(run) as reader:
        recorded = read_run(reader)
        kinds = {type(message).__name__ for _, message in messages(reader)}
    assert (recorded.source, recorded.mode, recorded.image_format) == ("test", "inline", "png")
    assert recorded.config == Config()
    assert recorded.applied == [Applied(1, 3)]
    assert recorded.dropped == [Dropped(9, START_NS, "ring", "full", 2)]
    assert recorded.start_check == START_CHECK
    assert {"Frame", "Keyframe", "TrackStats", "StageTimes", "CompressedImage", "PointCloud", "Log"} <= kinds


def test_a_run_of_a_version_with_other_settings_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("stereo_sfm.log.provenance.dump", lambda config: "[loop]\nan_old_setting = 1\n")
    path = tmp_path / "old.mcap"
    RunLog(LogWriter(path), fisheye_rig(), Config(), source="t", mode="inline", image_format="none").close()
    with LogReader(path) as reader, pytest.raises(StereoSfmError, match=r"written by another version.*an_old_setting"):
        read_run(reader)


def test_a_recording_is_not_a_run_and_a_run_without_images_names_their_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = MemorySource(fisheye_rig(), stereo_images(2, np.random.default_rng(0)))
    write_recording(tmp_path / "recording.mcap", source)
    with (
        LogReader(tmp_path / "recording.mcap") as reader,
        pytest.raises(StereoSfmError, match="is not the log of a run"),
    ):
        read_run(reader)
    path = tmp_path / "lean.mcap"
    log = RunLog(LogWriter(path), fisheye_rig(), Config(), source="a.mcap", mode="inline", image_format="none")
    log.image(source.images[0])
    log.close()
    with pytest.raises(StereoSfmError, match=r"a run without images: they are in a\.mcap"):
        open_source(path)
    assert main(["info", str(path)]) == 0
    text = capsys.readouterr().out
    assert "frames, without their images: 0" in text and "baseline 64.10 mm" in text and "problem: no frames" in text


def _put_frames(log: RunLog, count: int) -> None:
    for i in range(count):
        log.put(_frame(i))


def test_a_full_disk_during_a_run_is_one_error_and_a_readable_log(tmp_path: Path) -> None:
    path = tmp_path / "full.mcap"
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, hard))
    log = RunLog(LogWriter(path), fisheye_rig(), Config(), source="t", mode="inline", image_format="none")
    try:
        with pytest.raises(StereoSfmError, match="is closed and readable"):
            _put_frames(log, 1000)
        log.put(LogLine("main", "WARNING", "nobody may fail because of this"))
        with pytest.raises(StereoSfmError, match="is closed and readable"):
            log.put(_frame(1000))
        log.close()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    with LogReader(path) as reader:
        assert reader.truncated == "" and len(reader.stamps(topics.FRAME)) > 10


def test_an_unknown_message_is_an_error(tmp_path: Path) -> None:
    log = RunLog(LogWriter(tmp_path / "a.mcap"), fisheye_rig(), Config(), source="t", mode="inline")
    with pytest.raises(TypeError, match="no topic for str"):
        log.put("x")
    log.close()


def test_rerun_reads_every_channel(run: Path) -> None:
    rerun = shutil.which("rerun") or str(Path(__import__("sys").executable).parent / "rerun")
    done = subprocess.run([rerun, "mcap", "check", str(run)], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stdout + done.stderr
    rows = [line.split() for line in done.stdout.splitlines() if " /" in line and not line.startswith("/")]
    with LogReader(run) as reader:
        assert {row[3] for row in rows} == {t.topic for t in reader.topics}
    assert {row[0] for row in rows} == {"ok"}


def test_the_level_frame_follows_measured_gravity() -> None:
    np.testing.assert_array_equal(level_T_map(np.zeros(3)), LEVEL_T_MAP)
    np.testing.assert_allclose(level_T_map(np.array([0.0, 1.0, 0.0])), LEVEL_T_MAP, atol=1e-12)
    down = se3.so3_exp(np.array([0.2, 0.1, -0.3])) @ np.array([0.0, 1.0, 0.0])
    turn = level_T_map(down)[:3, :3]
    np.testing.assert_allclose(turn @ down, [0, 0, -1], atol=1e-12)
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
    ahead = turn @ [0.0, 0.0, 1.0]
    assert ahead[0] > 0.9 and abs(ahead[1]) < 1e-12
    np.testing.assert_array_equal(level_T_map(np.array([0.0, 0.0, 1.0])), LEVEL_T_MAP)  # it looks at the floor
