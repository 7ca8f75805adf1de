"""report.md: a run for people, with pictures, verdicts, and what to do next."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from stereo_sfm.eval import plots
from stereo_sfm.eval.calibration_results import calibration_table
from stereo_sfm.eval.evaluate import Evaluation, table
from stereo_sfm.eval.record import RunRecord
from stereo_sfm.eval.statistics import failure, summary, thousands
from stereo_sfm.types import Trajectory

ADVICE = {
    "dark": "images were dark: more light, or a longer exposure",
    "too_few_points": "too few points could be followed: look at the images (blur, bare walls, a covered lens)",
    "no_consensus": "points disagreed about the motion: people or carts in view, or a wrong calibration (`info`)",
}
FEW_INLIERS = 60  # median points a frame below which the pose hangs on little
LEAST_LENGTH_M = 1.0  # of a path whose length says something about the scale
BIG_SCALE_ERROR = 0.02  # Sim(3) scale off by more than this points at the baseline


def write_report(
    folder: Path,
    source_name: str,
    record: RunRecord,
    stats: dict[str, Any],
    estimates: dict[str, Trajectory],
    reference: Trajectory | None,
    evaluations: dict[str, Evaluation],
) -> None:
    """Write report.md and its pictures.

    Args:
        folder: the run's.
        source_name: what was run on.
        record, stats: of the run.
        estimates: trajectories by name ("odometry", "map").
        reference: ground truth in its own frame, or None.
        evaluations: of the estimates, by the same names, where there is ground truth.
    """
    pictures = _draw(folder, record, stats, estimates, evaluations)
    lines = [f"# {source_name}", "", *(f"* {line}" for line in summary(stats, evaluations)), "", "## Verdict", ""]
    lines += [f"* {verdict}" for verdict in verdicts(stats, evaluations)]
    for name, result in evaluations.items():
        lines += ["", f"## {name.capitalize()} against ground truth", "", "| | |", "|---|---|"]
        lines += [f"| {key} | {value} |" for key, value in table(result)]
    lines += calibration_table(stats)
    if reference is None:
        lines += ["", "The source has no ground truth: `stereo-sfm eval` compares the trajectory with one."]
    lines += ["", "## Time per stage", "", "| stage | p50 | p95 | p99 | frames |", "|---|---|---|---|---|"]
    for stage, ms in stats["ms"].items():
        count = thousands(int(ms["frames"]))
        lines.append(f"| {stage} | {ms['p50']:.2f} ms | {ms['p95']:.2f} ms | {ms['p99']:.2f} ms | {count} |")
    lines += ["", *(f"![{name}]({name}.png)\n" for name in pictures)]
    (folder / "report.md").write_text("\n".join(lines), encoding="utf-8")


def _draw(
    folder: Path,
    record: RunRecord,
    stats: dict[str, Any],
    estimates: dict[str, Trajectory],
    evaluations: dict[str, Evaluation],
) -> list[str]:
    """Draw what there is to draw; the pictures' names."""
    pictures: list[str] = []
    aligned = {name: result.estimate for name, result in evaluations.items()}
    shown = aligned or {name: t for name, t in estimates.items() if len(t)}
    if shown:
        truth = next(iter(evaluations.values())).reference if evaluations else None
        plots.plot_trajectory(folder / "trajectory.png", shown, truth)
        pictures.append("trajectory")
    if evaluations:
        plots.plot_errors(folder / "errors.png", evaluations)
        pictures.append("errors")
    if record.tracked().any():
        plots.plot_tracking(folder / "tracking.png", record)
        pictures.append("tracking")
    if len(record.frames):
        plots.plot_times(folder / "times.png", record, list(stats["ms"]))
        pictures.append("times")
    return pictures


def _drops(stats: dict[str, Any]) -> list[str]:
    """What is missing between the camera and the log."""
    lost, total = stats["dropped"] - stats["dropped_by_capture"], stats["frames"] + stats["dropped"]
    slow = "were dropped because the stages are too slow: try --frame-skip, or fewer points (tracker.max_features)"
    disk = "are not in the log, whose disk is too slow: take --image-format jpeg or --log lean"
    rows = (
        (stats["dropped_by_capture"], slow),
        (lost, "never arrived: check the cable, disk and files"),
        (stats["left_out_of_log"], disk),
    )
    out = [f"**WARN**: {n} frames ({100 * n / total:.1f} %) {what}" for n, what in rows if n]
    return out + ([f"**WARN**: {stats['log_ended']}"] if stats["log_ended"] else [])


def verdicts(stats: dict[str, Any], evaluations: dict[str, Evaluation]) -> list[str]:
    """What is good, what is not, and what to do about it."""
    out: list[str] = []
    failed = failure(stats)
    if failed:
        out.append(f"**FAIL**: {failed}")
    reasons = sorted({interval["reason"] for interval in stats["lost_intervals"]})
    if reasons:
        out += [f"**WARN**: lost ({reason}): {ADVICE.get(reason, 'see stats.json')}" for reason in reasons]
    elif stats["tracked"]:
        dropped = ", but for those that capture dropped" if stats["dropped_by_capture"] else ""
        out.append(f"**PASS**: every frame after the first pose has one{dropped}")
    if stats["pieces"] > 1:
        out.append(
            f"**WARN**: the walk is in {stats['pieces']} pieces: tracking began again, and no place of one piece was "
            "recognised in another; drive through a place again that was seen before tracking was lost"
        )
    out += _drops(stats)
    if stats["tracked"] and stats["inliers_median"] < FEW_INLIERS:
        out.append(
            f"**WARN**: only {stats['inliers_median']:.0f} points a frame: look at texture, exposure and calibration"
        )
    out += [text for name, result in evaluations.items() if (text := _length(name, result))]
    return out or ["nothing to say: no frames"]


def _length(name: str, result: Evaluation) -> str:
    """Whether a path is too long or too short; nothing of one too short to tell, or that has no scale of its own."""
    off = 1 / result.sim3_scale - 1
    if result.mode == "sim3" or result.length_m < LEAST_LENGTH_M or not abs(result.sim3_scale - 1) > BIG_SCALE_ERROR:
        return ""
    how = "long" if off > 0 else "short"
    return f"**WARN**: {name} is {abs(100 * off):.1f} % too {how}: check the baseline and the calibration"
