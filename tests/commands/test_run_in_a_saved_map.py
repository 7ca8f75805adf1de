"""`run --map-out`, then `--map-in` when a fifth of the products are others: placed in the map, or mapped and joined."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stereo_sfm.cli import main
from stereo_sfm.commands.map import describe
from stereo_sfm.drivers.ground_truth import read_tum
from stereo_sfm.drivers.source import open_source
from stereo_sfm.eval.associate import poses_at
from stereo_sfm.geometry import se3
from stereo_sfm.maps.saved_map import SavedMap, load_map
from stereo_sfm.types import F64

FIRST = "sim:loop?size=424x400&rate=10"
SECOND = f"{FIRST}&exchange=0.2"


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The map of the first five seconds."""
    folder = tmp_path_factory.mktemp("maps")
    run = ["run", FIRST, "--duration", "5", "--inline", "-q", "-o", str(folder / "run"), "--log", "none"]
    assert main([*run, "--map-out", str(folder / "store")]) == 0
    return folder / "store"


def world_T_map(spec: str = FIRST) -> F64:
    """A map begins at its first image."""
    with open_source(spec) as source:
        assert source.ground_truth is not None
        return source.ground_truth.poses[0]


def errors_in_the_map(run: Path) -> F64:
    """(N,) metres between the map trajectory of the second sequence and the truth in the first sequence's frame."""
    with open_source(SECOND) as source:
        assert source.ground_truth is not None
        estimate = read_tum(run / "trajectory_map.tum")
        truth, rows = poses_at(source.ground_truth, estimate.stamp_ns)
        truth = se3.inverse(world_T_map()) @ truth
        return np.linalg.norm(estimate.poses[rows, :3, 3] - truth[:, :3, 3], axis=1)


def second_sequence(tmp_path: Path, store: Path, *options: str) -> int:
    given = [
        "--map-in",
        str(store),
        "--start",
        "2",
        "--duration",
        "3",
        "--inline",
        "-q",
        "--log",
        "none",
        "-o",
        str(tmp_path / "run"),
    ]
    return main(["run", SECOND, *given, *options])


def test_the_map_holds_what_it_is_recognised_by(store: Path, capsys: pytest.CaptureFixture[str]) -> None:
    saved = load_map(store)
    described = len(np.unique(saved.snapshot.corner_kf))  # not where the view had hardly changed
    assert 7 <= described <= len(saved) >= 9
    assert main(["map", "info", str(store)]) == 0
    count = len(saved.snapshot.corner_kf)
    assert f"{count} corners for place recognition in {described} keyframes" in capsys.readouterr().out


def test_the_extent_of_a_map_leaves_out_what_is_far_off(store: Path) -> None:
    saved = load_map(store)
    points = saved.snapshot.points.copy()
    points[0] = 1e4
    said = describe(replace(saved, snapshot=replace(saved.snapshot, points=points)))
    sizes = [float(x) for x in re.findall(r"([\d.]+) m along [xyz]", "".join(said))]
    assert len(sizes) == 3 and max(sizes) < 100


def test_another_session_is_localized_in_the_map(
    tmp_path: Path, store: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert second_sequence(tmp_path, store, "--localize-only") == 0
    said = re.compile(r"localized in the saved map: \d+ of \d+ tracked frames, first found after \d\.\d s")
    assert said.search((tmp_path / "run" / "report.md").read_text())
    assert main(["export", str(tmp_path / "run"), "--format", "g2o"]) == 2
    assert "export the map given to --map-in" in capsys.readouterr().err
    errors = errors_in_the_map(tmp_path / "run")
    assert len(errors) >= 30 and np.median(errors) < 0.03 and errors.max() < 0.1


def test_another_session_is_merged_with_the_map(tmp_path: Path, store: Path) -> None:
    assert second_sequence(tmp_path, store, "--map-out", str(tmp_path / "both")) == 0
    both: SavedMap = load_map(tmp_path / "both")
    assert both.session_ids == [0, 1]
    assert len(both) > len(load_map(store))
    seen_by = [
        np.unique(both.snapshot.obs_pt[both.sessions[both.snapshot.obs_kf] == sequence])
        for sequence in both.session_ids
    ]
    assert len(np.intersect1d(*seen_by)) > 50
    assert np.median(errors_in_the_map(tmp_path / "run")) < 0.03


def test_another_tracker_is_placed_in_the_map_as_well(tmp_path: Path, store: Path) -> None:
    assert second_sequence(tmp_path, store, "--localize-only", "--odometry", "r-um", "--features", "orb") == 0
    assert np.median(errors_in_the_map(tmp_path / "run")) < 0.1


def test_without_recognition_there_is_no_place(tmp_path: Path, store: Path, capsys: pytest.CaptureFixture[str]) -> None:
    off = ["--set", "mapper.enabled=false", "--set", "loop.enabled=false"]
    assert second_sequence(tmp_path, store, "--localize-only", *off) == 2
    assert "set loop.enabled=true" in capsys.readouterr().err


def test_a_dark_recording_has_no_map_and_reports_why(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--duration", "1", "--inline", "-o", str(tmp_path / "run"), "--map-out", str(tmp_path / "map")]
    assert main(["run", "sim:aisle?size=212x200&rate=10&dark=0-20", *options]) == 4
    message = capsys.readouterr().err
    assert "nothing was mapped" in message
    assert "tracking never initialised" in message
    assert not (tmp_path / "map").exists()
