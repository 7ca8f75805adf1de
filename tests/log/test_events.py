"""The events of a run are reported once: loss of tracking, loops, corrections of the map, dropped frames."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from stereo_sfm.cli import main
from stereo_sfm.geometry import se3
from stereo_sfm.log.events import Events
from stereo_sfm.types import Dropped, Frame, LoopResult, MapUpdate, Observations, TrackState

NOBODY = np.zeros(0, np.int64)
PAIRS = np.zeros((0, 2), np.int64)


def frame(frame_id: int, state: TrackState, reason: str = "") -> Frame:
    identity = np.eye(4)
    return Frame(
        frame_id, frame_id * 100_000_000, identity, np.eye(6), state, reason, Observations.empty(), 0, identity
    )


def update(kf_id: int, metres: float) -> MapUpdate:
    place = se3.from_rotation_translation(np.eye(3), np.array([metres, 0.0, 0.0]))
    return MapUpdate(kf_id, kf_id, NOBODY, np.zeros((0, 4, 4)), NOBODY, np.zeros((0, 3)), NOBODY, PAIRS, place)


def told(*messages: object) -> list[tuple[str, str]]:
    events = Events()
    lines = [events.of(message) for message in messages]
    return [(line.level, line.text) for line in lines if line is not None]


def test_the_beginning_and_the_end_of_a_loss_are_reported() -> None:
    lost = TrackState.LOST
    states = [TrackState.OK, lost, lost, TrackState.RECOVERED, TrackState.OK, lost, TrackState.RESTARTED]
    reasons = ["", "dark", "dark", "", "", "too_few_points", ""]
    assert told(*(frame(i, s, r) for i, (s, r) in enumerate(zip(states, reasons, strict=True)))) == [
        ("WARNING", "frame 1 at 0.1 s: lost (dark)"),
        ("INFO", "frame 3 at 0.3 s: tracking recovered"),
        ("WARNING", "frame 5 at 0.5 s: lost (too few points)"),
        ("WARNING", "frame 6 at 0.6 s: tracking restarted in a new submap"),
    ]


def test_another_reason_is_reported() -> None:
    lost = TrackState.LOST
    assert [text for _, text in told(frame(0, lost, "dark"), frame(1, lost, "no_consensus"))] == [
        "frame 0 at 0.0 s: lost (dark)",
        "frame 1 at 0.1 s: lost (no consensus)",
    ]


def test_loops_and_rejected_loops_are_reported() -> None:
    accepted = LoopResult(9, 2, np.eye(4), np.eye(6), PAIRS, 87, 0.4, "")
    refused = LoopResult(10, -1, np.eye(4), np.eye(6), PAIRS, 3, 0.1, "too_few_inliers", ((1, 0.1, "x"), (2, 0.1, "x")))
    nothing = LoopResult(11, -1, np.eye(4), np.eye(6), PAIRS, 0, 0.0, "no_candidate")
    assert told(accepted, refused, nothing) == [
        ("INFO", "keyframe 9 sees keyframe 2 again, 87 inliers"),
        ("DEBUG", "no loop at keyframe 10, 2 rejected: too few inliers"),
    ]


def test_small_corrections_of_the_map_are_reported_once_they_add_up() -> None:
    steps = [update(k, 0.004 * k) for k in range(7)]
    assert [text for _, text in told(*steps)] == [
        "map corrected by 0.012 m, 0.00 deg at keyframe 3",
        "map corrected by 0.012 m, 0.00 deg at keyframe 6",
    ]


def test_dropped_frames_are_reported() -> None:
    assert told(Dropped(5, 0, "ring", "no free slot"), Dropped(8, 0, "sensor", "lost", 3)) == [
        ("WARNING", "1 frame dropped at 5: no free slot"),
        ("WARNING", "3 frames dropped at 8: lost"),
    ]


@pytest.mark.parametrize("verbose", [False, True])
def test_a_verbose_run_prints_them(verbose: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = "sim:aisle?size=212x200&rate=10&dark=1-1.5"
    options = ["--duration", "2", "--inline", "--log", "none", "-o", str(tmp_path), *(["-v"] if verbose else [])]
    assert main(["run", source, *options]) in (0, 4)
    message = capsys.readouterr().err
    assert ("tracker: frame 10 at 1.0 s: lost (dark)" in message) == verbose
    assert ("tracking recovered" in message) == verbose
