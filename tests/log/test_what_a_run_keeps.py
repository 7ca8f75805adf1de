"""What main and the logger keep of a long run: a few bytes of each message, not the message."""

from __future__ import annotations

import gc
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np

from stereo_sfm.eval.record import RunRecord
from stereo_sfm.log import foxglove, topics
from stereo_sfm.log.map_view import MapView
from stereo_sfm.log.reader import LogReader
from stereo_sfm.log.writer import CHUNK_NS, LogWriter
from stereo_sfm.types import Corners, Keyframe, LoopResult, MapUpdate

POINTS = 400


def kept(put: Callable[[int], None], count: int = 300, before: int = 30) -> float:
    """Bytes that stay for each of `count` calls, after the first ones."""
    for k in range(before):
        put(k)
    gc.collect()
    tracemalloc.start()
    begin = tracemalloc.get_traced_memory()[0]
    for k in range(before, before + count):
        put(k)
    gc.collect()
    out = (tracemalloc.get_traced_memory()[0] - begin) / count
    tracemalloc.stop()
    return out


def loop(k: int) -> LoopResult:
    matches = np.stack([np.arange(POINTS), np.arange(POINTS) + 10**6], 1)
    return LoopResult(k, 0, np.eye(4), np.eye(6), matches, POINTS, 1.0, "", ((k, 0.5, "too_few_inliers"),))


def keyframe(k: int) -> Keyframe:
    uv, points = np.zeros((POINTS, 2)), np.zeros((POINTS, 3))
    return Keyframe(
        kf_id=k, frame_id=k, stamp_ns=k, odom_T_cam=np.eye(4), point_ids=np.arange(POINTS), uv_left=uv, uv_right=uv,
        points_cam=points, descriptors=np.zeros((POINTS, 32), np.uint8), corners=Corners.none(),
    )  # fmt: skip


def update(k: int) -> MapUpdate:
    """In a known place: the window moves a little, the previous keyframe is culled, no point is new."""
    none, window = np.zeros(0, np.int64), np.array([0, *range(-20, 0), k])
    return MapUpdate(
        version=k + 1, kf_id=k, kf_ids=window, map_T_kf=np.tile(np.eye(4), (len(window), 1, 1)), point_ids=none,
        points_map=np.zeros((0, 3)), culled_point_ids=none, fused_point_ids=np.zeros((0, 2), np.int64),
        map_T_odom=np.eye(4), culled_kf_ids=np.array([k - 1]), carrier_kf_ids=np.array([0]),
        carrier_T_kf=np.eye(4)[None],
    )  # fmt: skip


def test_the_record_keeps_no_matches_of_loops_and_no_points_of_keyframes() -> None:
    record = RunRecord()

    def put(k: int) -> None:
        for message in (keyframe(k), loop(k), update(k)):
            record.put(message)

    assert kept(put) < 3000  # one message with matches has 8,000
    assert len(record.loops) == 330 and record.rejected == {"too_few_inliers": 330}


def test_the_logged_map_keeps_no_keyframes() -> None:
    view = MapView()

    def put(k: int) -> None:
        view.keyframe(keyframe(k), np.eye(4))
        view.update(update(k))
        if k % 10 == 0:
            assert len(view.covisibility_lines) <= 2 * 130

    assert kept(put, 100) < 2000


def test_the_index_of_the_log_is_kept_as_its_bytes(tmp_path: Path) -> None:
    def write(folder: Path, ours: bool) -> float:
        with LogWriter(folder / "a.mcap", clock=lambda: 0) as writer:
            if not ours:
                setattr(writer._mcap, "_Writer__chunk_indices", [])  # noqa: B010

            def put(k: int) -> None:
                text = foxglove.text(k * CHUNK_NS, 2, "x", "main")
                writer.write(topics.LOG, text, k * CHUNK_NS)

            return kept(put, 600)

    ours, theirs = write(tmp_path / "ours", True), write(tmp_path / "theirs", False)
    assert ours < 350 and ours < theirs / 2
    assert (tmp_path / "ours" / "a.mcap").read_bytes() == (tmp_path / "theirs" / "a.mcap").read_bytes()
    with LogReader(tmp_path / "ours" / "a.mcap") as reader:
        assert len(list(reader.messages())) == 630
