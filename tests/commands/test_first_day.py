"""What a first day stumbles on: a run that never starts, a run's own map and truth, numbers without a meaning."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

import stereo_sfm as s
from stereo_sfm.calib import save_rig
from stereo_sfm.cli import main


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Nine pairs of the bundled recording as image folders, with a run of them."""
    root = tmp_path_factory.mktemp("pairs")
    with s.open_source(s.demo_recording()) as source:
        save_rig(source.rig, root / "rig.yaml")
        for number, image in zip(range(9), source, strict=False):
            for side, pixels in (("left", image.left), ("right", image.right)):
                (root / side).mkdir(exist_ok=True)
                cv2.imwrite(str(root / side / f"{image.stamp_ns}.png"), np.asarray(pixels))
            assert number < 9
    return root


def test_exchanged_cameras_are_reported(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    swapped = tmp_path / "swapped"
    swapped.mkdir()
    (swapped / "left").symlink_to(folder / "right")
    (swapped / "right").symlink_to(folder / "left")
    (swapped / "rig.yaml").write_bytes((folder / "rig.yaml").read_bytes())
    assert main(["run", "--inline", f"images:{swapped}", "-o", str(tmp_path / "out")]) == 4
    out, err = capsys.readouterr()
    assert "calibration at the start: left and right are swapped" in out
    assert "left and right are swapped" in err
    assert "left and right are swapped" in (tmp_path / "out" / "report.md").read_text()


def test_a_run_keeps_its_map_and_its_ground_truth(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    run = tmp_path / "run"
    assert main(["run", "--inline", "-q", "--max-frames", "9", "-o", str(run)]) == 0
    assert main(["export", str(run), "--format", "ply"]) == 0 and (run / "points.ply").is_file()
    assert main(["eval", str(run), "--json"]) == 0
    found = json.loads(capsys.readouterr().out.partition("\n")[2])
    assert found["frames"] == 9 and found["ape_m"]["rmse"] < 0.01
    assert main(["viz", str(run / "map"), "--save", str(tmp_path / "map.rrd")]) == 0
    assert f"written to {tmp_path / 'map.rrd'}" in capsys.readouterr().out
    assert (tmp_path / "map.rrd").stat().st_size > 10_000
    assert main(["run", "--inline", "-q", "--max-frames", "3", "--log", "none", "--overwrite", "-o", str(run),
                 "--set", "mapper.enabled=false"]) == 0  # fmt: skip
    assert not (run / "map" / "map.json").exists()  # of the run before
    assert main(["eval", str(run)]) == 2 and "contains no ground truth: give it with --ref" in capsys.readouterr().err


def test_ablation_of_a_source_without_truth_is_refused(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["ablation", f"images:{folder}", "-o", str(tmp_path / "a")]) == 2
    assert "has no ground truth to evaluate the cells against" in capsys.readouterr().err
