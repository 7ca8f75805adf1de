"""Short parts of real sequences, whose lenses, rectification, exposure and stamps are not perfect: never lost, as exact
as measured, and no sudden change of the rig, for there was none. Each from several starts: results jump with the start.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pytest

from stereo_sfm.config import Config
from stereo_sfm.drivers.select import SelectedFrames
from stereo_sfm.drivers.source import open_source
from stereo_sfm.eval.evaluate import evaluate
from stereo_sfm.eval.record import RunRecord
from stereo_sfm.pipeline.run import run

WALKING = 0.3, 2.0  # m/s


@dataclass(frozen=True)
class Part:
    """Of a sequence: so many frames, and the ATE that must be reached in metres."""

    folder: str
    frames: int
    ate_m: float | None
    rolling: bool = False  # shutter


PARTS = (
    Part("karlsruhe_part", 52, 0.25),  # a city, rows up to 0.6 px off; 0.17 m where it was not lost
    Part("library_walk", 80, None),  # 320 x 240, strong JPEG, between shelves
    Part("euroc_mh01", 60, 0.004),  # a drone, shaking
    Part("kitti", 40, 0.35),  # a city, 0.5 m between images
    Part("rgbd_dataset_freiburg1_xyz", 37, 0.006, True),  # a hand-held depth camera with a rolling shutter
)


def recorded(folder: Path, first: int, frames: int | None) -> tuple[RunRecord, float | None]:
    """The run on a part, and its ATE where there is ground truth."""
    with open_source(folder) as source:
        stamps = [image.stamp_ns for image, _ in zip(source, range(first + 1), strict=False)]
    record = RunRecord()
    begin_s = (stamps[first] - stamps[0]) * 1e-9
    with SelectedFrames(open_source(folder), start_s=begin_s, max_frames=frames) as source:
        for _ in run(source, Config(), [record]):
            pass
        truth = source.ground_truth
    mapped = record.mapped()
    return record, None if truth is None or mapped is None else evaluate(mapped, truth).ape_m.rmse


@pytest.mark.parametrize("first", [0, 1, 3])
@pytest.mark.parametrize("part", PARTS, ids=lambda part: part.folder)
def test_a_real_camera_is_never_lost_and_as_exact_as_measured(part: Part, first: int, data_root: Path) -> None:
    record, ate_m = recorded(data_root / part.folder, first, part.frames)
    without = int(part.rolling)  # the second image tells how fast a rolling shutter moves
    assert len(record.frames) == part.frames and record.tracked()[without:].all()
    assert not [c for c in record.calibrations if c.why == "step"]
    if part.ate_m is not None:
        assert ate_m is not None and ate_m < part.ate_m


def test_a_walk_through_a_library_has_the_speed_of_a_walk(data_root: Path) -> None:
    """Without ground truth: scale and tracking are right if a person walks."""
    record, _ = recorded(data_root / "library_walk", 0, 80)
    mapped = record.mapped()
    assert mapped is not None
    seconds = float(mapped.stamp_ns[-1] - mapped.stamp_ns[0]) * 1e-9
    assert WALKING[0] < mapped.length / seconds < WALKING[1]


@pytest.mark.slow
def test_a_whole_walk_through_a_library_is_tracked_and_closed(data_root: Path) -> None:
    """346 images; it ends near its start."""
    record, _ = recorded(data_root / "library_walk", 0, None)
    assert record.tracked().all()
    assert len(record.loops) >= 1
