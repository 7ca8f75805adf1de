"""The ablation: its grid, a cell on a rendered store, failures, resuming, the report."""

from __future__ import annotations

import hashlib
import json
import signal
from concurrent.futures import Executor, Future
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stereo_sfm.cli import main
from stereo_sfm.eval.ablation import Cell, finished, grid, load_result, run_cell, save_result
from stereo_sfm.eval.ablation_report import COLUMNS, findings, overview, row_of, write_report

SIM = "sim:aisle?camera=pinhole&size=320x200&frames=5"
CELL = Cell(SIM, "grid", "orb", "pnp", "tracking", 0)


def cell_of(kind: str, method: str, ate: float, stage: str = "tracking", system: str = "grid", ms: float = 50) -> Any:
    """A made cell."""
    cell = Cell("kitti:07", system, kind, method, stage, 0)
    path = [[0.1 * i, 0.0, 0.2 * i] for i in range(5)]
    retail = {
        "relative_rotation_rad_mean": 0.01, "relative_rotation_rad_std": 0.02, "relative_translation_m2_mean": 0.1,
        "relative_translation_m2_std": 0.1, "absolute_rotation_rad": 0.3, "absolute_translation_m2": 4.0,
    }  # fmt: skip
    return {
        "schema": 1, "cell": vars(cell), "status": "ok", "reason": "", "frames": 5, "tracked": 4, "keyframes": 2,
        "loops": 0, "track_ms": ms, "frame_ms": ms, "monocular": False, "mean_error_m": ate, "source_name": "kitti:07",
        "metrics": {
            "retail": retail, "rpe_m": {"mean": 0.05, "std": 0.06}, "drift": None, "ape_m": {"rmse": ate},
            "ate_sim3_m": ate, "length_m": 12.0,
        },
        "path": path, "true_path": path,
    }  # fmt: skip


def test_the_grid_holds_every_combination_once() -> None:
    cells = grid(["a", "b"], systems=())
    assert len(cells) == 2 * 3 * 4 * 4 == len(set(cells))
    assert len({cell.file_name for cell in cells}) == len(cells)
    assert {cell.system for cell in grid(["a"])} == {
        "grid", "default", "retail-thesis", "sparse-localization", "cpp-course",
    }  # fmt: skip


def test_file_names_change_with_everything_that_changes_the_result() -> None:
    others = [
        replace(CELL, frames=3), replace(CELL, seed=1), replace(CELL, stage="mapping"), replace(CELL, source="x"),
    ]  # fmt: skip
    assert len({cell.file_name for cell in [CELL, *others]}) == 5
    assert CELL.file_name == replace(CELL).file_name


def test_stages_are_configurations() -> None:
    tracking, loops = CELL.config(), replace(CELL, stage="averaging").config()
    assert not tracking.mapper.enabled and not tracking.loop.enabled
    assert loops.mapper.enabled and loops.loop.enabled and loops.loop.correction == "averaging"
    assert tracking.odometry.method == "pnp" and tracking.features.kind == "orb"
    assert replace(CELL, system="cpp-course", stage="").config().odometry.monocular


def test_a_cell_is_run_judged_and_kept(tmp_path: Path) -> None:
    result = run_cell(CELL)
    assert result["status"] == "ok", result["reason"]
    assert result["frames"] == result["tracked"] == 5
    assert result["metrics"]["ape_m"]["rmse"] < 0.05
    row = row_of(result)
    assert row["rel trans mean [m]"] < 0.05
    save_result(tmp_path / "x.json", result)
    assert load_result(tmp_path / "x.json") == json.loads(json.dumps(result))
    damaged = (tmp_path / "x.json").read_text().replace('"frames": 5', '"frames": "5"')
    (tmp_path / "x.json").write_text(damaged)
    assert load_result(tmp_path / "x.json") is None
    (tmp_path / "x.json").write_text('{"schema": 1, "cel')
    assert load_result(tmp_path / "x.json") is None


def test_failed_cells_are_run_again_rejected_ones_are_not() -> None:
    assert not finished(None)
    assert not finished({"schema": 1, "status": "none", "reason": "internal error: x", "traceback": "..."})
    assert finished({"schema": 1, "status": "none", "reason": "weak_structure in 5 of 5 frames", "frames": 5})
    refused = replace(CELL, stage="pose_graph", settings=("loop.vocabulary=/no/such/file",))
    assert finished(run_cell(refused))  # whenever it is asked
    assert not finished(run_cell(replace(CELL, source="/no/such/folder")))  # perhaps it is not mounted now
    assert not finished({"schema": 1, "status": "none", "reason": "no such file or folder: /data"})


def test_failures_have_reasons() -> None:
    missing = run_cell(replace(CELL, source="/no/such/folder"))
    assert missing["status"] == "none" and "no such file" in missing["reason"]
    blind = run_cell(replace(CELL, source=f"{SIM}&size=64x40"))
    assert blind["status"] == "none" and "frames" in blind["reason"]


def test_findings_follow_the_numbers() -> None:
    made = [
        cell_of("sift", "em-r", 1.0), cell_of("akaze", "em-r", 2.0), cell_of("orb", "em-r", 3.0),
        cell_of("sift", "r-um", 2.0), cell_of("sift", "um", 5.0), cell_of("", "", 0.5, system="default", ms=10),
    ]  # fmt: skip
    text = "\n".join(findings(made))
    assert "SIFT best and ORB worst with em-r: yes" in text
    assert "EM-R best with sift: yes" in text
    assert "RANSAC needed with sift: yes" in text
    assert "more accurate than every cell, ATE: yes" in text and "faster than every cell: yes" in text
    worse = [
        cell_of("sift", "em-r", 3.0),
        cell_of("orb", "em-r", 1.0),
        cell_of("", "", 2.0, system="default", ms=90),
    ]
    text = "\n".join(findings(worse))
    assert "SIFT best and ORB worst with em-r: no" in text
    assert "more accurate than every cell, ATE: no" in text and "faster than every cell: no" in text


def test_the_report_has_tables_plots_csv_and_published_figures(tmp_path: Path) -> None:
    made = [cell_of("sift", "em-r", 1.0), cell_of("sift", "em-r", 0.5, "mapping")]
    refused = {"schema": 1, "cell": vars(Cell("kitti:07", "grid", "sift", "vp-r", "tracking", 0)), "status": "none",
               "reason": "weak_structure in 5 of 5 frames", "frames": 5, "tracked": 0}  # fmt: skip
    text = write_report(tmp_path, [*made, refused]).read_text()
    assert "weak_structure in 5 of 5 frames" in text
    assert "33.95" in text  # Table II of the thesis is on KITTI 07
    assert "| 2 |" in text  # absolute translation: the root of equation 24's square
    lines = (tmp_path / "ablation.csv").read_text().splitlines()
    assert lines[0].split(",") == ["source", *COLUMNS, "set"] and len(lines) == 4
    assert (tmp_path / "01-tracking-sift.png").stat().st_size > 5000
    assert (tmp_path / "01-stages-sift-em-r.png").stat().st_size > 5000


def test_the_command_resumes_and_refuses_unknown_names(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    chosen = ["--features", "orb", "--odometry", "um", "--stages", "tracking", "--systems", "none"]
    command = ["ablation", "kitti:07", "-o", str(tmp_path), *chosen]
    cell = grid(["kitti:07"], ["orb"], ["um"], ["tracking"], ())[0]
    (tmp_path / "cells").mkdir()
    save_result(tmp_path / "cells" / cell.file_name, cell_of("orb", "um", 0.25))

    def never(*_: object) -> None:
        raise AssertionError("a finished cell was computed again")

    monkeypatch.setattr("stereo_sfm.commands.ablation._run_all", never)
    assert main(command) == 0
    assert "1 of 1 cells" in capsys.readouterr().out
    assert "0.25" in (tmp_path / "ablation.md").read_text()
    assert main([*command, "--features", "surf"]) == 2
    assert "orb, sift, akaze" in capsys.readouterr().err


def test_paths_are_in_the_frame_of_the_truth() -> None:
    result = run_cell(CELL)
    path, truth = np.array(result["path"]), np.array(result["true_path"])
    np.testing.assert_allclose(path[0], truth[0], atol=1e-3)
    assert np.linalg.norm(path - truth, axis=1).max() < 0.1


@pytest.mark.slow
def test_the_whole_command_in_two_processes(tmp_path: Path) -> None:
    command = ["ablation", SIM, "-o", str(tmp_path), "--jobs", "2", "--features", "orb", "--systems", "none", "-q"]
    assert main([*command, "--odometry", "em-r,r-um", "--stages", "tracking"]) == 0
    assert len(list((tmp_path / "cells").glob("*.json"))) == 2


def test_the_overview_has_a_column_for_each_feature_and_a_line_for_each_system() -> None:
    refused = {**cell_of("orb", "em-r", 9.0), "status": "none", "reason": "weak_structure in 5 of 5 frames"}
    made = [
        cell_of("sift", "em-r", 1.25),
        refused,
        cell_of("sift", "um", 2.0),
        cell_of("", "", 0.5, system="default"),
    ]
    lines = overview(made).splitlines()
    assert lines[0] == "| odometry | stage | sift | orb |"
    assert lines[2] == "| em-r | tracking | 1.25 m (1.25 m), 50 ms | weak_structure in 5 of 5 frames |"
    assert lines[3] == "| um | tracking | 2 m (2 m), 50 ms | - |"
    assert lines[4] == "| **default** | tracking | 0.5 m (0.5 m), 50 ms | |"
    assert len({line.count("|") for line in lines}) == 1


def test_ctrl_c_finishes_the_running_cell_and_starts_no_other(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    begun: list[Any] = []

    class OneThread(Executor):
        """Returns at once, with Ctrl-C pressed meanwhile."""

        def __init__(self, *_: object, **__: object) -> None: ...

        def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
            begun.append(args[0])
            assert signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, ())  # a process begun now never sees it
            signal.raise_signal(signal.SIGINT)
            save_result(args[1], cell_of("orb", "um", 0.25))
            done: Future[Any] = Future()
            done.set_result("ATE 0.25 m")
            return done

    monkeypatch.setattr("concurrent.futures.ProcessPoolExecutor", OneThread)
    chosen = ["--features", "orb", "--odometry", "em-r,r-um", "--stages", "tracking", "--systems", "none", "-q"]
    assert main(["ablation", SIM, "-o", str(tmp_path), *chosen]) == 130
    assert len(begun) == 1 and len(list((tmp_path / "cells").iterdir())) == 1
    assert "interrupted with 1 of 2 cells; run the same command to continue" in capsys.readouterr().err
    assert (tmp_path / "ablation.md").exists()


def test_what_is_named_twice_is_one_cell() -> None:
    assert grid(["a", "a"], ["orb", "orb"], ["um", "um"], ["tracking"] * 2, ["default"] * 2) == grid(
        ["a"], ["orb"], ["um"], ["tracking"], ["default"]
    )


def test_settings_are_part_of_a_cell_and_leave_the_names_of_others_alone(tmp_path: Path) -> None:
    plain = replace(CELL, settings=("odometry.refine=false", "odometry.inlier_sigmas=0"))
    assert not plain.config().odometry.refine and plain.config().odometry.inlier_sigmas == 0.0
    assert plain.config().odometry.method == "pnp"
    same = replace(CELL, settings=("odometry.refine=true",))  # the default, given explicitly
    assert len({CELL.file_name, plain.file_name, same.file_name}) == 3
    described = (1, (SIM, "grid", "orb", "pnp", "tracking", 0, 0), asdict(CELL.config()))
    assert hashlib.sha256(repr(described).encode()).hexdigest()[:8] in CELL.file_name  # as before there were settings
    made = cell_of("orb", "um", 0.25)
    made["cell"] = {**made["cell"], "settings": ["odometry.refine=false"]}
    assert "Set in every cell: `odometry.refine=false`." in write_report(tmp_path, [made]).read_text()
    assert (tmp_path / "ablation.csv").read_text().splitlines()[1].endswith(",odometry.refine=false")
    assert "Set in every cell" not in write_report(tmp_path, [cell_of("orb", "um", 0.25)]).read_text()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["/no/such/folder"], "no such file or folder: /no/such/folder"),
        ([SIM, "euroc:nowhere"], "no folder nowhere"),
        ([SIM, "--set", "odometry.refin=false"], "refin"),
        ([SIM, "--set", "odometry.method=um"], "use --odometry to choose the cells"),
    ],
)
def test_errors_are_reported_before_any_cell_runs(
    words: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["ablation", *words, "-o", str(tmp_path / "out"), "--features", "orb", "--systems", "none"]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and message in lines[0]
    assert not (tmp_path / "out").exists()
