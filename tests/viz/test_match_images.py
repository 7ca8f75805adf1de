"""The match display draws common points, and no image before the first keyframe."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from stereo_sfm.types import Frame, Keyframe, Observations, StereoImage, TrackState
from stereo_sfm.viz.match_images import MatchImages, common_rows, draw_matches

GREY = np.full((60, 80), 100, np.uint8)


def frame(frame_id: int, ids: list[int]) -> Frame:
    uv = np.array([[10.0 + 5 * i, 30.0] for i in ids]).reshape(-1, 2)
    seen = Observations(np.array(ids, np.int64), uv, uv * np.nan, np.ones(len(ids), np.int32), np.ones(len(ids), bool))
    return Frame(frame_id, 0, np.eye(4), np.eye(6), TrackState.OK, "", seen, 0, np.eye(4))


def keyframe(frame_id: int, ids: list[int]) -> Keyframe:
    uv = np.array([[12.0 + 5 * i, 40.0] for i in ids]).reshape(-1, 2)
    n = len(ids)
    return Keyframe(
        0, frame_id, 0, np.eye(4), np.array(ids, np.int64), uv, uv * np.nan, np.full((n, 3), np.nan),
        np.zeros((n, 32), np.uint8),
    )  # fmt: skip


def test_common_rows_pair_equal_ids() -> None:
    a, b = common_rows(np.array([5, 2, 9]), np.array([9, 7, 5]))
    assert sorted(zip(a.tolist(), b.tolist(), strict=True)) == [(0, 2), (2, 0)]


def test_lines_join_the_matches() -> None:
    picture = draw_matches(GREY, GREY, np.array([[10.0, 30.0]]), np.array([[20.0, 30.0]]), np.zeros((0, 2)), "")
    assert picture.shape == (60, 160, 3)
    coloured = (picture.max(axis=2) != picture.min(axis=2)).nonzero()
    assert coloured[1].min() <= 10 and coloured[1].max() >= 100  # from the left point to the right one
    assert set(coloured[0]) <= set(range(25, 36))


def test_an_image_for_every_second_frame_after_a_keyframe(tmp_path: Path) -> None:
    sink = MatchImages(2, tmp_path / "matches")
    for k in range(5):
        sink.put(StereoImage(k, 0, GREY))
        sink.put(frame(k, [1, 2, 3]))
        if k == 1:
            sink.put(keyframe(1, [2, 3, 8]))
    assert sorted(p.name for p in (tmp_path / "matches").iterdir()) == ["000002.png", "000004.png"]
    assert cv2.imread(str(tmp_path / "matches" / "000002.png")).shape == (60, 160, 3)
