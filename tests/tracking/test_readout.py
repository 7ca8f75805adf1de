"""Measurement of the readout of a rolling shutter."""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from stereo_sfm.calib import load_rig, save_rig
from stereo_sfm.calib.rig import Rig
from stereo_sfm.cli import main
from stereo_sfm.config import TrackerConfig
from stereo_sfm.drivers.sim.source import SimSource
from stereo_sfm.drivers.source import open_source
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import RadTan
from stereo_sfm.tracking.flow import readout
from stereo_sfm.tracking.flow.readout import MIN_PAIRS, Readout, ReadoutSearch
from stereo_sfm.tracking.flow.tracker import Tracker
from stereo_sfm.types import F64, StereoImage

SLOW = pytest.mark.slow  # four seconds each
AISLE = "sim:aisle?camera=pinhole&size=320x200&start=60&frames=40"


@functools.cache
def recorded(spec: str, most: int) -> tuple[Rig, list[StereoImage]]:
    """Rendered once for all tests."""
    with open_source(spec) as source:
        return source.rig, list(itertools.islice(source, most))


def search(
    spec: str, calibrated_s: float, change: Callable[[Rig], Rig] = lambda rig: rig, most: int = 200, begin: int = 0
) -> Readout:
    """As measured with a calibration with readout `calibrated_s` that is wrong by `change`."""
    rig, images = recorded(spec, most)
    rig = change(dataclasses.replace(rig, readout_s=calibrated_s))
    found = ReadoutSearch(rig)
    tracker = Tracker(TrackerConfig(), rig, readout=found)
    for image in images[begin:]:
        tracker.step(image)
    return found.measured


def skew(points: F64) -> F64:
    """(N, 3, 3) matrices of the cross products with points (N, 3)."""
    return np.cross(points[:, :, None], np.eye(3)[None], axisa=1, axisb=1, axisc=1)


def turned(axis: int, degrees: float) -> Callable[[Rig], Rig]:
    """A calibration with a wrong rotation of the right camera."""
    xi = np.zeros(6)
    xi[3 + axis] = np.radians(degrees)
    return lambda rig: dataclasses.replace(rig, left_T_right=rig.left_T_right @ se3.exp(xi))


def bent(k1: float) -> Callable[[Rig], Rig]:
    """A calibration with a wrong distortion of both lenses."""

    def change(rig: Rig) -> Rig:
        left, right = (
            RadTan(c.width, c.height, c.fx, c.fy, c.cx, c.cy, (k1, 0.0, 0.0, 0.0))
            for c in (rig.left, rig.right)
            if c is not None
        )
        return dataclasses.replace(rig, left=left, right=right)

    return change


@pytest.mark.parametrize(("vibration", "seed"), [(1, 0), (4, 0), *(pytest.param(4, k, marks=SLOW) for k in (1, 2))])
def test_a_rolling_shutter_missing_in_the_calibration(vibration: int, seed: int) -> None:
    found = search(f"{AISLE}&vibration={vibration}&seed={seed}&readout=0.025", 0.0)
    assert found.differs and found.known
    assert found.best_s == pytest.approx(0.025, abs=0.004)
    assert found.sigma_s < 0.1 * found.measured_s + 0.0008


def test_rows_that_are_read_from_below() -> None:
    found = search(f"{AISLE}&vibration=4&seed=0&readout=-0.025", 0.025)
    assert found.differs and found.best_s == pytest.approx(-0.025, abs=0.004)


def test_a_global_shutter_and_a_calibrated_one() -> None:
    known = search(f"{AISLE}&vibration=4&seed=0&readout=0.025", 0.025)
    assert known.known and known.best_s == 0.025
    believed = search(f"{AISLE}&vibration=4&seed=1", 0.025)
    assert believed.differs and believed.best_s == pytest.approx(0.0, abs=0.002)


@pytest.mark.parametrize(
    "change",
    [
        lambda rig: rig,
        turned(1, 0.2),
        bent(0.03),
        *(pytest.param(turned(*by), marks=SLOW) for by in ((0, 0.2), (2, 0.3))),
    ],
)
def test_a_global_shutter_is_recognised_with_any_calibration(change: Callable[[Rig], Rig]) -> None:
    found = search(f"{AISLE}&vibration=4&seed=1", 0.0, change)
    assert found.known and not found.differs and found.best_s == 0.0
    assert abs(found.measured_s) < 0.003


def test_a_steady_drive_with_a_wrong_calibration_shows_no_readout() -> None:
    """In straight motion, wrong disparities have the same effect as a rolling shutter."""
    assert search(f"{AISLE}&frames=60&rate=10", 0.0, turned(1, -0.4)).best_s == 0.0


@pytest.mark.parametrize("readout_s", [0.0, 0.02])
def test_distances_that_all_err_are_no_readout(readout_s: float) -> None:
    """On a road what is near is low in the image: flow that is wrong by distance looks like rows at other times."""
    rng = np.random.default_rng(0)
    camera = RadTan(1241, 376, 718.9, 718.9, 607.2, 185.2)
    points = np.column_stack([rng.uniform(-8, 8, 150), np.full(150, 1.6), rng.uniform(6, 60, 150)])
    velocity, change = np.array([0.3, 0.1, 10.0, 0.01, 0.4, 0.0]), np.array([0.5, 0.1, 1.0, 0.05, 0.1, 0.02])
    uv, by_point = camera.project_jacobian(points)
    row = uv[:, 1] / (camera.height - 1) - 0.5
    by_pose = np.einsum("nij,njk->nik", by_point, np.concatenate([np.tile(-np.eye(3), (150, 1, 1)), skew(points)], 2))
    wrong = 0.1 * 0.002 * np.linalg.norm(points, axis=1)  # of 0.1 s, with inverse distances 0.002 too large
    moved = wrong[:, None] * (by_pose[:, :, :3] @ velocity[:3])
    moved += readout_s * row[:, None] * (by_pose @ change) + rng.normal(0, 0.01, (150, 2))
    product, square = readout._readout(points, by_point, row, moved, velocity, change)  # pyright: ignore[reportPrivateUsage]
    assert product / square == pytest.approx(readout_s, abs=0.002)


@pytest.mark.slow
@pytest.mark.parametrize("yaw_deg", [-0.1, -0.05, 0.0, 0.05, 0.1])
def test_kitti_has_a_global_shutter(yaw_deg: float, data_root: Path) -> None:
    assert search(f"kitti:{data_root / 'kitti'}", 0.0, turned(1, yaw_deg), 100).best_s == 0.0


@pytest.mark.slow
@pytest.mark.parametrize("name", ["kitti", "euroc_mh01", "store_walk"])
def test_global_shutters_are_recognised(name: str, data_root: Path) -> None:
    found = search(str(data_root / name), 0.0)
    assert found.known and found.best_s == 0.0


@pytest.mark.slow
@pytest.mark.parametrize("begin", [0, 50, 100, 150])
def test_a_camera_that_hops_has_no_rolling_shutter(begin: int, data_root: Path) -> None:
    """The right one of Karlsruhe does, at 10 Hz: pairs of images are not independent, and few tell much."""
    for most in range(24, 60, 3):
        assert not search(str(data_root / "karlsruhe_part"), 0.0, most=begin + most, begin=begin).differs


@pytest.mark.slow
def test_the_colour_camera_of_tum_rgbd_reads_rows_one_after_the_other(data_root: Path) -> None:
    found = search(str(data_root / "rgbd_dataset_freiburg1_xyz"), 0.0)
    assert found.differs and found.best_s == pytest.approx(0.028, abs=2 * found.sigma_s)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("readout_s", [0.0, 0.01, 0.03])
@pytest.mark.parametrize("spec", ["sim:loop?size=424x400&start=200", "sim:sparse?size=424x400&start=90&rate=15"])
def test_fisheyes_in_stores(spec: str, readout_s: float, seed: int) -> None:
    found = search(f"{spec}&frames=60&seed={seed}&readout={readout_s}", 0.0)
    assert found.differs == (readout_s > 0)
    assert found.measured_s == pytest.approx(readout_s, abs=0.003 + 3 * found.sigma_s)


def test_too_few_frames_give_no_result() -> None:
    found = search(
        f"{AISLE}&vibration=4&frames={MIN_PAIRS + 3}", 0.0
    )  # two velocities need four images; the first has no motion
    assert np.isnan(found.measured_s)
    assert not found.known and found.best_s == 0.0


@pytest.mark.parametrize("seed", [0, *(pytest.param(k, marks=SLOW) for k in (1, 2))])
def test_steady_motion_does_not_determine_the_readout(seed: int) -> None:
    assert not search(f"{AISLE}&vibration=0&seed={seed}&readout=0.025", 0.0).known


def test_check_calib_reports_the_readout(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    source = f"{AISLE}&vibration=4&readout=0.025"
    assert main(["check-calib", source, "--correct", str(tmp_path / "corrected.yaml")]) in (0, 3)
    told = capsys.readouterr().out
    assert "shutter: rows read within 25 ms; points are off by" in told
    assert "cannot be judged with a rolling shutter" in told
    with open_source(source) as opened:
        rig = opened.rig
    corrected = load_rig(tmp_path / "corrected.yaml")
    assert corrected.left.fx == rig.left.fx  # of what cannot be judged nothing is changed
    assert corrected.left_T_right[1, 3] == pytest.approx(rig.left_T_right[1, 3], abs=1e-12)
    save_rig(dataclasses.replace(rig, readout_s=0.0), tmp_path / "silent.yaml")
    assert main(["check-calib", source, "--rig", str(tmp_path / "silent.yaml")]) == 0
    told = capsys.readouterr().out
    assert "WARN  shutter: all rows at once, but the motion shows rows read within" in told
    assert "set readout_s in rig.yaml" in told
    assert "cannot be judged with a rolling shutter" in told
    save_rig(dataclasses.replace(rig, readout_s=0.1), tmp_path / "long.yaml")
    assert main(["check-calib", source, "--rig", str(tmp_path / "long.yaml")]) == 0
    assert "check readout_s in rig.yaml" in capsys.readouterr().out


def test_check_calib_of_a_pair_that_misses_right_images(monkeypatch: pytest.MonkeyPatch) -> None:
    frame = SimSource.frame

    def without(self: SimSource, frame_id: int, dropped_before: int = 0) -> StereoImage:
        image = frame(self, frame_id, dropped_before)
        return dataclasses.replace(image, right=None) if frame_id % 15 == 0 else image

    monkeypatch.setattr(SimSource, "frame", without)
    assert main(["check-calib", f"{AISLE}&vibration=4"]) in (0, 3)
