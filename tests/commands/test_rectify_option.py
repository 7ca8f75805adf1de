"""`--rectify`: the run uses rectified images, its log records it, and a replay from the source repeats it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Self

import numpy as np
import pytest

from stereo_sfm import read_trajectory
from stereo_sfm.calib import load_rig, save_rig
from stereo_sfm.calib.rig import Rig
from stereo_sfm.cli import main
from stereo_sfm.drivers.rectified import RectifiedSource, rectified
from stereo_sfm.drivers.source import BaseSource, open_source
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry.cameras import Pinhole
from stereo_sfm.log.reader import LogReader
from stereo_sfm.log.recorded import read_run
from stereo_sfm.types import StereoImage

SPEC = "sim:aisle?size=300x280&frames=14&rate=15&seed=1"


def run(folder: Path, *options: str) -> int:
    return main(["run", SPEC, "-o", str(folder), "--inline", "-q", "--rectify", *options])


@pytest.mark.parametrize("how", ["pinhole", "wide"])
def test_a_rectified_run_is_replayed_from_its_source(how: str, tmp_path: Path) -> None:
    assert run(tmp_path / "a", how, "--log", "lean") == 0
    with LogReader(tmp_path / "a" / "run.mcap") as reader:
        assert read_run(reader).opening.rectify == how
    rig = load_rig(tmp_path / "a" / "rig.yaml")
    assert isinstance(rig.left, Pinhole) == (how == "pinhole")
    assert rig.right is not None and np.allclose(rig.left_T_right[:3, :3], np.eye(3))
    again = ["replay", str(tmp_path / "a"), "-o", str(tmp_path / "b"), "--inline", "-q", "--check"]
    assert main(again) == 0


def test_a_full_log_holds_the_rectified_images(tmp_path: Path) -> None:
    assert run(tmp_path / "a", "pinhole", "--log", "full") == 0
    with open_source(tmp_path / "a" / "run.mcap") as logged, RectifiedSource(open_source(SPEC), "pinhole") as made:
        for a, b in zip(logged, made, strict=True):
            assert a.right is not None and b.right is not None
            assert np.array_equal(a.left, b.left) and np.array_equal(a.right, b.right)
    assert main(["replay", str(tmp_path / "a"), "-o", str(tmp_path / "b"), "--inline", "-q", "--check"]) == 0


def test_a_rectified_recording_can_be_run(tmp_path: Path) -> None:
    path = str(tmp_path / "a.mcap")
    assert main(["record", SPEC, "-o", path, "--rectify", "pinhole", "-q"]) == 0
    assert main(["run", path, "-o", str(tmp_path / "b"), "--inline", "-q"]) == 0
    assert run(tmp_path / "c", "pinhole") == 0
    poses = [read_trajectory(tmp_path / name / "trajectory_odom.tum").poses for name in "bc"]
    assert np.array_equal(*poses)


def test_the_trajectory_is_the_one_of_the_raw_images(tmp_path: Path) -> None:
    """In other axes (those of the rectified camera) the same sequence, to within the error of both."""
    assert run(tmp_path / "a", "none") == 0
    assert run(tmp_path / "b", "wide") == 0
    raw, wide = (read_trajectory(tmp_path / name / "trajectory_odom.tum") for name in "ab")
    assert raw.length > 0.05 and abs(wide.length / raw.length - 1) < 0.05


def test_a_replaced_calibration_is_replayed_too(tmp_path: Path) -> None:
    """Images in a folder without a calibration of their own."""
    images = tmp_path / "images"
    assert main(["rectify", SPEC, "-o", str(images / "pairs"), "--plain", "--frames", "14"]) == 0
    for side in ("left", "right"):
        (images / side).mkdir()
        for k, path in enumerate(sorted((images / "pairs").glob(f"*_{side}.png"))):
            path.rename(images / side / f"{k:06d}.png")
    rig = load_rig(images / "pairs" / "rig.yaml")
    (images / "pairs" / "rig.yaml").unlink()
    (images / "pairs").rmdir()
    save_rig(rig, tmp_path / "rig.yaml")
    options = ["--rig", str(tmp_path / "rig.yaml"), "--rectify", "pinhole", "--log", "lean", "--inline", "-q"]
    assert main(["run", f"images:{images}", "-o", str(tmp_path / "a"), *options, "--max-lost", "100"]) == 0
    (tmp_path / "rig.yaml").unlink()  # the log holds it
    assert main(["replay", str(tmp_path / "a"), "-o", str(tmp_path / "b"), "--inline", "-q", "--check"]) == 0


class LateRig(BaseSource):
    """A camera whose calibration is read when it is open."""

    def __init__(self, rig: Rig) -> None:
        self._source = open_source(SPEC)
        self.name, self.live = "late", True
        self.rig, self._true = rig, self._source.rig

    def __enter__(self) -> Self:
        self.rig = self._true
        return self

    def __iter__(self) -> Iterator[StereoImage]:
        return iter(self._source)


def test_the_calibration_of_a_camera_is_read_when_it_is_open() -> None:
    true = open_source(SPEC).rig
    late = LateRig(replace(true, left=replace(true.left, fx=1.05 * true.left.fx)))
    with rectified(late, "pinhole") as a, rectified(open_source(SPEC), "pinhole") as b:
        assert np.array_equal(a.rig.left.matrix, b.rig.left.matrix)
        assert np.array_equal(next(iter(a)).left, next(iter(b)).left)


def test_one_camera_cannot_be_rectified() -> None:
    true = open_source(SPEC).rig
    with pytest.raises(StereoSfmError, match="rectification needs two cameras"):
        rectified(LateRig(Rig(true.left)), "epipolar")
