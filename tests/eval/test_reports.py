"""Reports as one HTML file, tables for other programs, and several runs on one page."""

from __future__ import annotations

import csv
import json
import shutil
import time
import xml.etree.ElementTree as ElementTree
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from stereo_sfm import timing
from stereo_sfm.cli import main
from stereo_sfm.config import Config
from stereo_sfm.drivers.choice import SourceChoice
from stereo_sfm.eval import plots
from stereo_sfm.eval.compare import ComparedRun, differences, names_of
from stereo_sfm.eval.evaluate import evaluate
from stereo_sfm.eval.headline import headline
from stereo_sfm.eval.html_page import take_plots, to_html
from stereo_sfm.eval.report import verdicts
from stereo_sfm.eval.tables import write_table
from stereo_sfm.geometry import se3
from stereo_sfm.kernel_cache import Compilation
from stereo_sfm.maps.folders import MapFolders
from stereo_sfm.pipeline.session import Session, Wiring
from stereo_sfm.types import Trajectory


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Two runs on the same images with other numbers of points."""
    root = tmp_path_factory.mktemp("runs")
    spec = "sim:aisle?size=212x200&frames=15&rate=15&seed=1"
    for name, points in (("a", 150), ("b", 80)):
        setting = f"tracker.max_features={points}"
        assert main(["run", spec, "-o", str(root / name), "--inline", "-q", "--set", setting]) in (0, 4)
    return root / "a", root / "b"


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as stream:
        return list(csv.DictReader(stream))


def figures(page: str) -> list[str]:
    return [part[: part.index("</svg>") + 6] for part in page.split("</figcaption>")[1:]]


def test_the_report_is_one_html_file_with_its_plots(runs: tuple[Path, Path]) -> None:
    page = (runs[0] / "report.html").read_text("utf-8")
    text = (runs[0] / "report.md").read_text("utf-8")
    assert page.count("<figure>") == text.count("![") >= 3
    assert "<h2>Verdict</h2>" in page and "src=" not in page
    ids: list[str] = []
    for svg in figures(page):
        ids += [i for e in ElementTree.fromstring(svg).iter() if (i := e.get("id"))]
    assert len(ids) == len(set(ids))
    assert not list(runs[0].glob("*.svg"))


def test_a_report_begins_with_one_sentence_and_the_picture(runs: tuple[Path, Path]) -> None:
    blocks = (runs[0] / "report.md").read_text("utf-8").split("\n\n")
    assert blocks[1].startswith(("**The camera's position is known for", "**This run failed**"))
    assert blocks[1].count("\n") == 0 and blocks[2] == "![trajectory](trajectory.png)" and blocks[3] == "## Verdict"
    assert "| latency |" not in "".join(blocks)  # a recording is read ahead


@pytest.fixture(scope="module")
def good(runs: tuple[Path, Path]) -> dict[str, Any]:
    """The numbers of a run without a warning."""
    stats = json.loads((runs[0] / "stats.json").read_text("utf-8"))
    return {**stats, "tracked": stats["frames"], "lost_percent": 0.0, "lost_intervals": [], "inliers_median": 200.0,
            "pieces": 1, "start_check": None, "sensors": {}, "warnings": [],
            "row_errors": {**stats["row_errors"], "warning": ""}}  # fmt: skip


def test_pass_is_more_than_poses(good: dict[str, Any]) -> None:
    (line,) = verdicts(good, {})
    assert line.startswith("**PASS**") and "200 points" in line and "row error" in line
    assert "is known for all 15 images" in headline(good, {}, 0) and "no true path" in headline(good, {}, 0)
    row_errors = {**good["row_errors"], "warning": "x"}
    for fault in ({"inliers_median": 20.0}, {"pieces": 2}, {"row_errors": row_errors}, {"unplaced": 3}):
        lines = verdicts({**good, **fault}, {})
        assert len(lines) == 1 and lines[0].startswith("**WARN**")
    odd = verdicts({**good, "warnings": ["a message cannot be read", "no IMU"]}, {})
    assert odd == ["**WARN**: a message cannot be read", "**WARN**: no IMU"]
    assert headline({**good, "tracked": 0}, {}, 0) == "**This run failed**: tracking never initialised."


def test_a_path_far_from_the_true_one_is_no_pass(good: dict[str, Any]) -> None:
    """Also where its length is right: it is bent."""
    stamps = np.arange(200) * 50_000_000
    true = np.tile(np.eye(4), (200, 1, 1))
    true[:, 0, 3] = np.linspace(0, 20, 200)
    true[:, 1, 3] = np.cos(np.linspace(0, np.pi, 200))
    bent = true.copy()
    bent[:, 2, 3] = 0.9 * np.sin(np.linspace(0, 3 * np.pi, 200))
    found = evaluate(Trajectory(stamps, bent), Trajectory(stamps, true))
    assert abs(found.sim3_scale - 1) < 0.02 and found.ate_percent > 2
    same = evaluate(Trajectory(stamps, true), Trajectory(stamps, true))
    assert verdicts(good, {"map": same})[0].startswith("**PASS**")
    (line,) = verdicts(good, {"map": found})
    assert line.startswith("**WARN**: map is off by") and "of the path" in line


def test_what_two_runs_differ_in_has_corrections_at_the_start(good: dict[str, Any]) -> None:
    """And says what the errors are against, where there is no ground truth."""
    path = Trajectory(np.arange(9) * 50_000_000, se3.exp(np.linspace(0, 1, 9)[:, None] * np.ones(6)))
    corrected = {**good, "start_check": {"text": "turned by 1.6 degrees", "shown": True, "corrected": True}}
    rows = {
        row[0]: row[1:]
        for row in differences([ComparedRun("a", corrected, path, None), ComparedRun("b", good, path, None)])
    }
    assert rows["corrections"] == ["at the start: turned by 1.6 degrees", "none"]
    assert rows["errors are against"] == ["a", "a"]


def test_the_plot_of_times_shows_what_it_draws(runs: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    """Compiling is in the age of a pose, which it leaves out."""
    stages, drawn = {"track": 5.0, "map": 2.0}, list[Figure]()
    record = SimpleNamespace(
        frames=SimpleNamespace(stamp_ns=np.arange(9) * 1_000_000_000),
        times=lambda: {**{name: np.full(9, ms) for name, ms in stages.items()}, "latency": np.full(9, 2e4)},
    )
    monkeypatch.setattr(plots, "_save", lambda figure, path: drawn.append(figure))
    plots.plot_times(Path("times.png"), record, list(stages))  # pyright: ignore[reportArgumentType]
    assert drawn[0].axes[0].get_ylim()[1] == pytest.approx(6.0)


def test_compiling_is_no_time_of_a_stage(monkeypatch: pytest.MonkeyPatch) -> None:
    counted = Compilation(lambda _: None)
    monkeypatch.setattr(timing, "_compilation", lambda: counted)
    spans = timing.Spans()
    with spans.span("track"):
        time.sleep(0.02)
        counted.seconds += 0.02
    assert 0 <= spans.take()["track"] < 20


def test_compiling_while_the_source_is_opened_is_no_time_of_the_run(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The run's time begins afterwards: it would be shorter than none."""
    counted = Compilation(lambda _: None)
    counted.seconds = 60.0
    monkeypatch.setattr("stereo_sfm.kernel_cache.listening", lambda _: nullcontext(counted))
    choice = SourceChoice("sim:aisle?size=64x48&frames=2")
    with Session(choice, Config(), [], Wiring(inline=True, log="none"), MapFolders(), tmp_path / "run") as session:
        assert session.waited_s(time.perf_counter()) == 0.0
        counted.seconds += 2.0
        assert session.waited_s(time.perf_counter()) == 2.0
        session.stop()
    session.close()


def test_other_files_of_the_folder_stay(tmp_path: Path) -> None:
    (tmp_path / "mine.svg").write_text("<svg/>")
    assert not take_plots(tmp_path, ["trajectory"]) and (tmp_path / "mine.svg").exists()


def test_markdown_is_escaped_and_formatted() -> None:
    page = to_html("t", "# A <b>\n\n| x | y |\n|---|---|\n| `1` | **2** |\n\n* one\n* two\n\n![gone](gone.png)", {})
    for part in ("<h1>A &lt;b&gt;</h1>", "<td><code>1</code></td><td><b>2</b></td>", "<li>one</li><li>two</li>"):
        assert part in page
    assert "gone" not in page


def test_numbers_stand_to_the_right_and_dates_are_not_broken() -> None:
    page = to_html("t", "| night | n | text |\n|---|---:|---|\n| 2026-11-25 | 2 | it-is two |", {})
    for part in ("<td class=word>2026-11-25</td>", "<td class=right>2</td>", "<td>it-is two</td>", "<th class=right>n"):
        assert part in page


def test_tables_have_empty_cells_for_what_is_missing(tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    write_table(tmp_path / "t", ("name", "n", "x"), [["a", 1, float("nan")], ["b", None, 0.1 + 0.2], ["", 3, None]])
    assert (tmp_path / "t.csv").read_text().splitlines() == ["name,n,x", "a,1,", "b,,0.30000000000000004", ",3,"]
    columns = parquet.read_table(tmp_path / "t.parquet").to_pydict()
    assert columns == {"name": ["a", "b", None], "n": [1, None, 3], "x": [None, 0.1 + 0.2, None]}


def test_eval_writes_the_error_of_every_frame(
    runs: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    truth = "sim:aisle?size=212x200&frames=15&rate=15&seed=1"
    assert main(["eval", str(runs[0]), "--ref", truth, "--table", str(tmp_path / "errors"), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    rows = rows_of(tmp_path / "errors.csv")
    errors = np.array([float(row["error_m"]) for row in rows])
    assert len(rows) == result["frames"]
    assert np.sqrt((errors**2).mean()) == pytest.approx(result["ape_m"]["rmse"], rel=1e-9)


def test_runs_are_compared_on_one_page(runs: tuple[Path, Path], tmp_path: Path) -> None:
    assert main(["compare", *map(str, runs), "-o", str(tmp_path)]) == 0
    page = (tmp_path / "compare.html").read_text("utf-8")
    assert len(figures(page)) == 3 and page.count("<tr>") == 3
    rows = rows_of(tmp_path / "compare.csv")
    assert [row["run"] for row in rows] == ["a", "b"]
    assert all(0 < float(row["ATE m"]) < 0.2 for row in rows) and rows[0]["hash"] != rows[1]["hash"]


def test_two_runs_differ_as_a_table(
    runs: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["diff", *map(str, runs), "-o", str(tmp_path)]) == 3
    rows = {line.split("  ")[0]: line.split() for line in capsys.readouterr().out.splitlines()}
    assert rows["run"][1:] == ["a", "b"] and rows["tracker.max_features"][1:] == ["150", "80"]
    assert rows["hash"][1] != rows["hash"][2] and {"ATE", "lost intervals", "corrections"} <= rows.keys()
    assert not any(name.startswith("/") for name in rows)  # no topic
    assert (tmp_path / "compare.html").is_file()
    assert main(["diff", *map(str, runs), "--all"]) == 3 and "/" in capsys.readouterr().out
    same = tmp_path / "same"
    shutil.copytree(runs[0], same)
    assert main(["diff", str(runs[0]), str(same)]) == 0 and "settings that differ" not in capsys.readouterr().out
    assert main(["diff", str(runs[0]), str(runs[1] / "run.mcap")]) == 2


def test_what_is_no_run_is_said(runs: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["compare", str(runs[0]), str(tmp_path), "-o", str(tmp_path / "out")]) == 2
    assert "is not the folder of a run" in capsys.readouterr().err
    assert main(["compare", str(runs[0]), str(runs[0]), "-o", str(tmp_path / "out")]) == 2


def test_names_differ() -> None:
    assert names_of([Path("/x/a"), Path("/x/b")]) == ["a", "b"]
    assert names_of([Path("/x/1/run"), Path("/x/2/run")]) == ["1/run", "2/run"]


def test_without_a_desktop_a_line_says_where_the_page_is(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    from stereo_sfm.commands._browser import show

    for name in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER"):
        monkeypatch.delenv(name, raising=False)
    show(tmp_path / "report.html")
    assert str(tmp_path / "report.html") in capsys.readouterr().err
