"""Plots of a run, drawn without a display."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from stereo_sfm.calib.choice import NAMES, SCALES, UNITS
from stereo_sfm.eval.evaluate import Evaluation
from stereo_sfm.eval.record import RunRecord
from stereo_sfm.recording.describe import GAP
from stereo_sfm.types import F64, I64, TrackState, Trajectory

AXES = ("x", "y", "z")
NO_BREAKS: I64 = np.zeros(0, np.int64)
SHOWN_STAGES = 6  # the longest ones
MARGINS = {"left": 0.11, "right": 0.97, "bottom": 0.1, "top": 0.93}  # fixed: a constrained layout draws twice
FLAT = {"left": 0.09, "right": 0.97, "bottom": 0.17, "top": 0.9}


def _save(figure: Figure, path: Path) -> None:
    """As a picture, and as vectors, which `html_page.take_plots` puts into a page."""
    FigureCanvasAgg(figure)
    figure.savefig(path, dpi=110)
    with rc_context({"svg.hashsalt": path.stem, "svg.fonttype": "none"}):
        figure.savefig(path.with_suffix(".svg"), metadata={"Date": None})


def _plane(positions: F64) -> tuple[int, int]:
    """The two axes along which a path extends most, in the order they are drawn."""
    extent = np.ptp(positions, axis=0)
    a, b = sorted(np.argsort(-extent, kind="stable")[:2].tolist())
    return a, b


def _breaks(trajectory: Trajectory) -> I64:
    """(B,) the poses before which frames have none."""
    steps = np.diff(trajectory.stamp_ns)
    return np.flatnonzero(steps > GAP * np.median(steps)) + 1 if len(steps) else NO_BREAKS


def plot_trajectory(
    path: Path, estimates: dict[str, Trajectory], reference: Trajectory | None, every_frame: bool = False
) -> None:
    """Paths in the plane of their greatest extent, metres, the start marked.

    Args:
        path: of the picture.
        estimates: by name. reference: ground truth.
        every_frame: of a video: dashed where frames have no pose.
    """
    figure = Figure(figsize=(7, 6))
    axes = figure.subplots(gridspec_kw=MARGINS)
    shown = reference if reference is not None else next(iter(estimates.values()))
    a, b = _plane(shown.positions)
    if reference is not None:
        axes.plot(*reference.positions[:, [a, b]].T, color="0.55", linewidth=2.5, label="ground truth")
    for name, trajectory in estimates.items():
        path_xy, breaks = trajectory.positions[:, [a, b]], _breaks(trajectory) if every_frame else NO_BREAKS
        axes.plot(*np.insert(path_xy, breaks, np.nan, axis=0).T, linewidth=1.2, label=name)
        for k in breaks.tolist():
            label = f"{name}: no pose" if k == breaks[0] else None
            axes.plot(*path_xy[k - 1 : k + 1].T, linewidth=1.2, linestyle="--", color="tab:red", label=label)
    axes.plot(*shown.positions[0, [a, b]], marker="o", color="black", linestyle="none", label="start")
    axes.set(xlabel=f"{AXES[a]} [m]", ylabel=f"{AXES[b]} [m]", title="trajectory")
    axes.set_aspect("equal", adjustable="datalim")
    axes.grid(alpha=0.3)
    axes.legend()
    _save(figure, path)


def plot_errors(path: Path, evaluations: dict[str, Evaluation]) -> None:
    """Absolute position error and its parts along the axes over time."""
    figure = Figure(figsize=(8, 5))
    top, bottom = figure.subplots(2, sharex=True, gridspec_kw=MARGINS)
    angles = len(evaluations) > 1 and all(result.oriented for result in evaluations.values())
    begin_ns = min(result.estimate.stamp_ns[0] for result in evaluations.values())
    for name, result in evaluations.items():
        seconds = (result.estimate.stamp_ns - begin_ns) / 1e9
        error = 1e3 * (result.estimate.positions - result.reference.positions)
        top.plot(seconds, np.linalg.norm(error, axis=1), label=f"{name}: rmse {1e3 * result.ape_m.rmse:.1f} mm")
        if angles:
            bottom.plot(seconds, np.degrees(_angles(result)), label=name, linewidth=1)
        else:
            of = f"{name}: " if len(evaluations) > 1 else ""
            for axis in range(3):
                bottom.plot(seconds, error[:, axis], label=f"{of}{AXES[axis]}", linewidth=1)
    top.set(ylabel="position error [mm]", title="error after alignment")
    bottom.set(xlabel="time [s]", ylabel="rotation error [deg]" if angles else "error along axis [mm]")
    for axes in (top, bottom):
        axes.grid(alpha=0.3)
        axes.legend()
    _save(figure, path)


def _angles(result: Evaluation) -> F64:
    from stereo_sfm.eval.metrics import absolute_errors

    return absolute_errors(result.estimate.poses, result.reference.poses)[1]


def plot_tracking(path: Path, record: RunRecord) -> None:
    """Points used in each frame's pose, frames without a pose marked."""
    figure = Figure(figsize=(8, 3))
    axes = figure.subplots(gridspec_kw=FLAT)
    seconds = _seconds(record)
    axes.plot(seconds, record.frames.inliers, linewidth=1, label="points in the pose")
    lost = ~record.tracked()
    if lost.any():
        axes.plot(seconds[lost], np.zeros(int(lost.sum())), "x", color="tab:red", label="no pose")
    again = record.frames.state == TrackState.RESTARTED
    if again.any():
        axes.plot(seconds[again], np.zeros(int(again.sum())), "^", color="tab:orange", label="restarted")
    axes.set(xlabel="time [s]", ylabel="points", title="tracked points")
    axes.set_ylim(bottom=0)
    axes.grid(alpha=0.3)
    axes.legend()
    _save(figure, path)


def plot_calibration(path: Path, record: RunRecord) -> None:
    """Row errors over time, and the corrections of self-calibration with their standard deviations."""
    figure = Figure(figsize=(8, 5))
    top, bottom = figure.subplots(2, sharex=True, gridspec_kw=MARGINS)
    first_ns, last_ns = record.frames.stamp_ns[[0, -1]]
    stamps, rows = np.array(record.row_error_px).reshape(-1, 2).T
    top.plot((stamps - first_ns) / 1e9, rows, linewidth=1)
    top.set(ylabel="row error [px]", title="calibration")
    top.set_ylim(bottom=0)
    changes = record.calibrations
    seconds = (np.array([first_ns, *(c.stamp_ns for c in changes), last_ns]) - first_ns) / 1e9
    terms = SCALES * np.array([np.zeros(len(NAMES)), *(c.terms for c in changes), changes[-1].terms])
    variances = [np.zeros(len(NAMES)), *(np.diag(c.terms_covariance) for c in [*changes, changes[-1]])]
    sigmas = SCALES * np.sqrt(variances)
    for k in np.flatnonzero(terms.any(0)):
        bottom.plot(seconds, terms[:, k], marker=".", drawstyle="steps-post", label=f"{NAMES[k]} [{UNITS[k]}]")
        lower, upper = terms[:, k] - sigmas[:, k], terms[:, k] + sigmas[:, k]
        bottom.fill_between(seconds, lower, upper, step="post", alpha=0.2)
    bottom.set(xlabel="time [s]", ylabel="correction")
    bottom.legend()
    for axes in (top, bottom):
        axes.grid(alpha=0.3)
    _save(figure, path)


def plot_times(path: Path, record: RunRecord, stages: Sequence[str]) -> None:
    """Milliseconds per frame of the longest stages."""
    figure = Figure(figsize=(8, 3))
    axes = figure.subplots(gridspec_kw={**FLAT, "right": 0.78})
    seconds, times = _seconds(record), record.times()
    shown = {stage: times[stage] for stage in stages[:SHOWN_STAGES]}
    for stage, ms in shown.items():
        axes.plot(seconds, ms, ".-", markersize=2, linewidth=1, label=stage)
    everything = np.concatenate([np.zeros(0), *(ms[np.isfinite(ms)] for ms in shown.values())])
    axes.set(xlabel="time [s]", ylabel="ms", title="time per stage")
    axes.set_ylim(0, 1.2 * float(np.percentile(everything, 99.5)) if len(everything) else 1)
    axes.grid(alpha=0.3)
    if stages:
        axes.legend(loc="center left", bbox_to_anchor=(1, 0.5))
    _save(figure, path)


def plot_stage_times(path: Path, runs: dict[str, dict[str, dict[str, float]]]) -> None:
    """Median milliseconds of the stages of several runs, beside each other.

    Args:
        path: of the picture.
        runs: `ms` of stats.json by the run's name.
    """
    figure = Figure(figsize=(8, 3))
    axes = figure.subplots(gridspec_kw=FLAT)
    stages = list(dict.fromkeys(stage for ms in runs.values() for stage in ms if stage != "latency"))[:SHOWN_STAGES]
    width = 0.8 / max(len(runs), 1)
    for k, (name, ms) in enumerate(runs.items()):
        heights = [ms[stage]["p50"] if stage in ms else 0.0 for stage in stages]
        axes.bar(np.arange(len(stages)) + k * width, heights, width, label=name)
    axes.set_xticks(np.arange(len(stages)) + 0.4 - width / 2, stages)
    axes.set(ylabel="ms, median", title="time per stage")
    axes.legend()
    _save(figure, path)


def _seconds(record: RunRecord) -> F64:
    stamps = record.frames.stamp_ns
    return (stamps - stamps[0]) / 1e9


def plot_trends(path: Path, columns: Sequence[str], rows: Sequence[Sequence[float | str | None]]) -> None:
    """Numbers of a fleet by night, one panel each, two beside each other.

    Args:
        path: of the picture. columns: "night" first. rows: one of each night, None for a missing value.
    """
    nights = [str(row[0])[5:] for row in rows]  # month and day
    count = len(columns) - 1
    lines = (count + 1) // 2
    figure = Figure(figsize=(11, 2 * lines))
    for k, name in enumerate(columns[1:]):
        axes = figure.add_subplot(lines, 2, k + 1)
        values = [np.nan if row[k + 1] is None else float(row[k + 1] or 0.0) for row in rows]
        axes.plot(range(len(nights)), values, ".-")
        axes.set_title(name, fontsize="medium", loc="left")
        axes.set_ylim(0, 1.1 * np.nanmax([*values, 1e-9]))  # 0 at the bottom also where all are 0 or missing
        axes.grid(alpha=0.3)
        shown = range(0, len(nights), max(-(-len(nights) // 8), 1))
        axes.set_xticks(list(shown), [nights[i] for i in shown] if k >= count - 2 else ["" for _ in shown])
    figure.tight_layout()
    _save(figure, path)
