"""What a first day stumbles on: a run that never starts, a run's own map and truth, numbers without a meaning."""

from __future__ import annotations

import dataclasses
import json
import logging
import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

import stereo_sfm as s
from stereo_sfm.calib import load_rig, save_rig
from stereo_sfm.cli import main
from stereo_sfm.config import Config
from stereo_sfm.drivers.folder_source import FolderSource
from stereo_sfm.drivers.source import Stamps
from stereo_sfm.eval.batch import BatchTask, run_one
from stereo_sfm.eval.evaluate import evaluate, table
from stereo_sfm.pixels import cut_off
from stereo_sfm.service.messages import ServiceState
from stereo_sfm.service.states import REMEDIES
from stereo_sfm.types import Trajectory


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


def copy_of(folder: Path, place: Path) -> Path:
    shutil.copytree(folder, place)
    return place


def test_info_finds_an_inverted_extrinsic(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    place = copy_of(folder, tmp_path / "inverted")
    rig = load_rig(place / "rig.yaml")
    save_rig(dataclasses.replace(rig, left_T_right=np.linalg.inv(rig.left_T_right)), place / "rig.yaml")
    assert main(["info", f"images:{place}"]) == 0
    out = capsys.readouterr().out
    assert "problem: left_T_right is inverted" in out and "no problems found" not in out


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_info_finds_damaged_images(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], suffix: str
) -> None:
    place = copy_of(folder, tmp_path / "damaged")
    files = sorted((place / "left").iterdir())
    for path in files:
        pixels = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert pixels is not None
        path.unlink()
        cv2.imwrite(str(path.with_suffix(suffix)), pixels)
    whole = files[4].with_suffix(suffix)
    assert not cut_off(whole.read_bytes())
    whole.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])  # OpenCV would fill the rest with grey
    assert main(["info", f"images:{place}"]) == 0
    out = capsys.readouterr().out
    assert "problem: 1 of 9 sampled frames cannot be read" in out and "no problems found" not in out


def test_a_damaged_png_is_told_in_our_words(folder: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """OpenCV's library prints lines of its own."""
    place = copy_of(folder, tmp_path / "flipped")
    path = sorted((place / "left").iterdir())[4]
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0x10
    path.write_bytes(data)
    assert main(["info", f"images:{place}"]) == 0
    said = capfd.readouterr()
    assert "problem: 1 of 9 sampled frames cannot be read" in said.out and "libpng" not in said.out + said.err


def test_info_lists_what_readers_warn_about(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    first = FolderSource.stamps

    def warning(source: FolderSource) -> Stamps:
        logging.getLogger("stereo_sfm").warning("the encoding 'yuv9' is unknown")
        return first(source)

    monkeypatch.setattr(FolderSource, "stamps", warning)
    assert main(["info", f"images:{folder}"]) == 0
    out, err = capsys.readouterr()
    assert out.count("problem: the encoding 'yuv9' is unknown") == 1 and not err


def test_info_says_that_the_baseline_is_not_checked(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    place = copy_of(folder, tmp_path / "long")
    rig = load_rig(place / "rig.yaml")
    metres: list[float] = []
    for scale in (1.0, 10.0):
        left_T_right = rig.left_T_right.copy()
        left_T_right[:3, 3] *= scale
        save_rig(dataclasses.replace(rig, left_T_right=left_T_right), place / "rig.yaml")
        assert main(["info", f"images:{place}"]) == 0
        found = re.search(r"cannot check the baseline of .* half within ([\d.]+) m", capsys.readouterr().out)
        assert found is not None
        metres.append(float(found[1]))
    assert 1 < metres[0] < 3 and metres[1] == pytest.approx(10 * metres[0], rel=0.05)


def test_ablation_of_a_source_without_truth_is_refused(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["ablation", f"images:{folder}", "-o", str(tmp_path / "a")]) == 2
    assert "has no ground truth to compare with" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["pairs2", "pirs", "runs/pairs2", "camera"])
def test_a_mistyped_folder_is_named_once(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for beside in ((), ("pairs",)):
        for folder in beside:
            (tmp_path / folder).mkdir()
        assert main(["run", name]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert f"no such file or folder: {name}" in line and len(line) < 150
        cell = run_one(BatchTask(name, str(tmp_path / "out" / "x"), Config(), map_out=False))["error"]
        assert cell in line
    assert ("did you mean pairs?" in line) == (name in ("pairs2", "pirs"))


def test_terms_on_the_screen_are_in_the_glossary() -> None:
    glossary = (Path(__file__).parents[2] / "docs" / "glossary.md").read_text("utf-8")
    for term in ("row error", "decentering", "not confirmed yet", "significant", "step", "refined", "drift"):
        assert any(term in line.split("|")[1] for line in glossary.splitlines() if line.startswith("| ")), term


def test_equations_of_a_thesis_are_no_row_of_eval() -> None:
    stamps = np.arange(4) * 10**8
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, 0, 3] = np.arange(4)
    path = Trajectory(stamps, poses)
    rows = table(evaluate(path, path, "origin"))
    assert rows and not any("thesis" in name for name, _ in rows)


def test_a_full_disk_names_the_settings_that_help() -> None:
    remedy = REMEDIES[ServiceState.DISK_FULL]
    assert "recording.quota_gb" in remedy and "recording.min_free_gb" in remedy
