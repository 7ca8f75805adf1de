"""Several runs beside each other: one page with their trajectories, errors and times, and a table."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from stereo_sfm.config import parse_toml
from stereo_sfm.errors import StereoSfmError, printable
from stereo_sfm.eval import plots
from stereo_sfm.eval.evaluate import Evaluation, evaluate, length
from stereo_sfm.eval.html_page import take_plots, to_html
from stereo_sfm.eval.stats_file import checked_stats
from stereo_sfm.eval.tables import write_table
from stereo_sfm.input_file import read_json, read_text
from stereo_sfm.types import Trajectory

COLUMNS = (
    "run", "frames", "lost percent", "keyframes", "loops", "path m", "ATE m", "ATE Sim(3) m", "scale", "frames/s",
    "track ms", "map ms", "hash",
)  # fmt: skip
DIGITS = {"lost percent": ".1f", "path m": ".2f", "scale": ".5f", "frames/s": ".1f", "track ms": ".2f", "map ms": ".2f"}


@dataclass(frozen=True)
class ComparedRun:
    """One run.

    Attributes:
        name: shown.
        stats: of its stats.json.
        estimate: its map's trajectory, else its odometry.
        reference: its ground truth, or None.
    """

    name: str
    stats: dict[str, Any]
    estimate: Trajectory
    reference: Trajectory | None


def stats_of(folder: Path) -> dict[str, Any]:
    """The numbers of a run.

    Raises:
        StereoSfmError: not the folder of a run.
    """
    try:
        return checked_stats(read_json(folder / "stats.json"))
    except (OSError, ValueError):
        raise StereoSfmError(f"{folder} is not the folder of a run: its stats.json cannot be read") from None


def names_of(folders: Sequence[Path]) -> list[str]:
    """The names of folders, with as many of their parents as make them differ."""
    parts = [tuple(map(printable, folder.resolve().parts)) for folder in folders]
    longest = max(map(len, parts))
    taken = next((n for n in range(1, longest) if len({one[-n:] for one in parts}) == len(parts)), longest)
    return ["/".join(one[-taken:]) for one in parts]


def compare(runs: Sequence[ComparedRun], folder: Path) -> Path:
    """Write compare.html, compare.csv and compare.parquet into an existing folder.

    A run without ground truth is compared with the first run.

    Returns:
        The page.
    """
    reference = next((run.reference for run in runs if run.reference is not None), None)
    evaluations = _evaluations(runs, reference)
    rows = [_row(run, evaluations.get(run.name)) for run in runs]
    write_table(folder / "compare", COLUMNS, rows)
    aligned = {name: result.alignment for name, result in evaluations.items()}
    shown = {r.name: aligned[r.name].apply(r.estimate) if r.name in aligned else r.estimate for r in runs}
    plots.plot_trajectory(folder / "trajectory.png", shown, reference, every_frame=True)
    if evaluations:
        plots.plot_errors(folder / "errors.png", evaluations)
    plots.plot_stage_times(folder / "times.png", {run.name: run.stats["ms"] for run in runs})
    against = "ground truth" if reference is not None else f"the run {runs[0].name}: no run has ground truth"
    lines = [
        f"# {len(runs)} runs", "", f"Errors are after SE(3) alignment with {against}.", "",
        "| " + " | ".join(map(_title, COLUMNS)) + " |", "|---" * len(COLUMNS) + "|",
        *("| " + " | ".join(map(_text, COLUMNS, row)) + " |" for row in rows), "",
        "## Trajectories", "", "![trajectory](trajectory.png)", "",
        *(["## Errors", "", "![errors](errors.png)", ""] if evaluations else []),
        "## Time per stage", "", "![times](times.png)", "",
    ]  # fmt: skip
    page = folder / "compare.html"
    page.write_text(
        to_html("stereo-sfm compare", "\n".join(lines), take_plots(folder, ("trajectory", "errors", "times"))),
        encoding="utf-8", errors="replace",
    )  # fmt: skip
    return page


def differences(runs: Sequence[ComparedRun]) -> list[list[str]]:
    """Two runs as rows of text: what, the one, the other; the first row has their names."""
    reference = next((run.reference for run in runs if run.reference is not None), None)
    evaluations = _evaluations(runs, reference)
    columns = zip(*(_row(run, evaluations.get(run.name)) for run in runs), strict=True)
    rows = [
        [_title(name), *(_text(name, value) for value in values)] for name, values in zip(COLUMNS, columns, strict=True)
    ]
    more: dict[str, Callable[[dict[str, Any]], str]] = {
        "lost intervals": lambda stats: str(len(stats["lost_intervals"])),
        "dropped": lambda stats: str(stats["dropped"]),
        "submaps": lambda stats: str(stats["pieces"]),
        "corrections": lambda stats: "; ".join(_corrections(stats)) or "none",
    }
    rows += [[name, *(read(run.stats) for run in runs)] for name, read in more.items()]
    against = "ground truth" if reference is not None else runs[0].name
    return [*rows, ["errors are against", against, against]]


def _corrections(stats: dict[str, Any]) -> list[str]:
    """Of the calibration, at the start and by self-calibration."""
    at_start = stats.get("start_check")
    first = [f"at the start: {at_start['text']}"] if at_start and at_start["corrected"] else []
    return [*first, *(c["text"] for c in stats["calibration"])]


def changed_settings(folders: Sequence[Path]) -> list[list[str]]:
    """The settings in which two runs differ, as rows: name, the one, the other.

    Raises:
        StereoSfmError: a config.toml cannot be read.
    """
    one, other = (_settings(folder / "config.toml") for folder in folders)
    names = [*one, *(name for name in other if name not in one)]
    return [[n, one.get(n, "-"), other.get(n, "-")] for n in names if one.get(n) != other.get(n)]


def _settings(path: Path) -> dict[str, str]:
    """Values as text by dotted name."""
    try:
        tree = parse_toml(read_text(path))
    except (OSError, ValueError):
        raise StereoSfmError(f"{path} cannot be read: is this the folder of a run?") from None
    found: dict[str, str] = {}
    waiting: list[tuple[str, Any]] = [("", tree)]
    while waiting:
        name, value = waiting.pop()
        if isinstance(value, dict):
            items: dict[str, Any] = value
            waiting += [(f"{name}.{key}" if name else key, part) for key, part in reversed(items.items())]
        else:
            found[name] = str(value)
    return found


def _evaluations(runs: Sequence[ComparedRun], reference: Trajectory | None) -> dict[str, Evaluation]:
    """By name, of the runs that can be aligned."""
    found: dict[str, Evaluation] = {}
    others = runs if reference is not None else runs[1:]
    for run in others:
        truth = run.reference if run.reference is not None else reference
        try:
            found[run.name] = evaluate(run.estimate, runs[0].estimate if truth is None else truth)
        except StereoSfmError:  # too short, or no common time: its row says so by being empty
            continue
    return found


def _row(run: ComparedRun, result: Evaluation | None) -> list[Any]:
    stats = run.stats
    ms = stats["ms"]
    return [
        run.name, stats["frames"], stats["lost_percent"], stats["keyframes"], stats["loops_accepted"], stats["path_m"],
        None if result is None else result.ape_m.rmse, None if result is None else result.ate_sim3_m,
        None if result is None else result.sim3_scale, stats["frames_per_s"],
        *(ms[stage]["p50"] if stage in ms else None for stage in ("track", "map")), stats["fingerprint"],
    ]  # fmt: skip


def _title(name: str) -> str:
    """Of a column for people: an error names its own unit."""
    return name.removesuffix(" m") if name.startswith("ATE") else name


def _text(column: str, value: Any) -> str:
    if value is None:
        return ""
    if column.startswith("ATE"):
        return length(value)
    return format(value, DIGITS.get(column, "")) if not isinstance(value, str) else value
