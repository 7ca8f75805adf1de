"""report.md and report.html: the results of a run with plots, verdicts and advice."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from stereo_sfm.eval import plots
from stereo_sfm.eval.calibration_results import calibration_table
from stereo_sfm.eval.evaluate import Evaluation, table
from stereo_sfm.eval.headline import headline, passed
from stereo_sfm.eval.html_page import take_plots, to_html
from stereo_sfm.eval.record import RunRecord
from stereo_sfm.eval.sensor_results import sensor_lines
from stereo_sfm.eval.statistics import failure, loop_errors, summary, thousands, without_images
from stereo_sfm.types import Trajectory

ADVICE = {
    "dark": "images were dark: use more light or a longer exposure",
    "too_few_points": "too few points could be tracked: check the images (blur, bare walls, a covered lens)",
    "no_consensus": "points did not agree on one motion: people or carts in view, or a wrong calibration",
    "first_image": "a rolling shutter needs a second image that tells how fast the camera moves",
    "not_found": "the camera saw no known place: clear its view, or drive back to where tracking last worked",
}
SHOWN_ROWS = 50  # of a table
# Why a loop candidate was rejected (`LoopResult.rejected`).
REJECTIONS = {
    "too_few_matches": "too few corners have a similar descriptor",
    "no_pose": "the matches fit no pose",
    "too_few_inliers": "too few matches fit one pose",
    "not_spread": "the inliers cover too small a part of the image",
    "same_direction": "views to the side fit, but other corners do not, though the camera looks in the same direction",
    "against_odometry": "the pose contradicts the odometry by more than drift can explain",
    "out_of_reach": "the camera cannot have moved there while tracking was lost",
    "better_elsewhere": "another candidate of the same keyframe has many more inliers",
    "ambiguous": "another place fits as well, and no odometry decides between them",
    "not_confirmed_yet": "not enough successive keyframes agree on the loop yet",
}
FEW_INLIERS = 60  # median points per frame below which the pose is poorly constrained
MIN_LENGTH_M = 1.0  # shortest path whose length is compared
BIG_ERROR = 0.02  # of the path's length, above which it is a warning; of its scale the baseline is suspected


def write_report(
    folder: Path,
    source_name: str,
    record: RunRecord,
    stats: dict[str, Any],
    estimates: dict[str, Trajectory],
    reference: Trajectory | None,
    evaluations: dict[str, Evaluation],
    go_on: Callable[[], bool] = lambda: True,
) -> None:
    """Write report.md, then its plots, then both as report.html.

    Args:
        folder: of the run.
        source_name: name of the source.
        record, stats: of the run.
        estimates: trajectories by name ("odometry", "map").
        reference: ground truth in its own frame, or None.
        evaluations: of the estimates, by the same names, where there is ground truth.
        go_on: called before each plot; when it returns False, the remaining ones are omitted.
    """
    drawings = _plots_by_name(folder, record, stats, estimates, evaluations)
    judged = verdicts(stats, evaluations)
    warnings = sum(line.startswith("**WARN**") for line in judged)
    lines = [f"# {Path(source_name).name}", "", headline(stats, evaluations, warnings), ""]
    lines += ["![trajectory](trajectory.png)", ""] if "trajectory" in drawings else []
    lines += ["## Verdict", "", *(f"* {verdict}" for verdict in judged), ""]
    lines += ["## Summary", "", f"* source: {source_name}", *(f"* {line}" for line in summary(stats, evaluations))]
    for name, result in evaluations.items():
        lines += ["", f"## {name.capitalize()} against ground truth", "", "| | |", "|---|---|"]
        lines += [f"| {key} | {value} |" for key, value in table(result)]
    lines += calibration_table(stats)
    if reference is None:
        lines += [
            "",
            "The source has no ground truth. `stereo-sfm eval RUN --ref TRUTH` compares the trajectory with one.",
        ]
    lines += _lost_intervals(stats["lost_intervals"]) + _gaps(stats["stamp_gaps"])
    lines += _rejections(stats["loops_rejected"])
    lines += ["", "## Time per stage", "", "| stage | p50 | p95 | p99 | frames |", "|---|---|---|---|---|"]
    shown = {stage: ms for stage, ms in stats["ms"].items() if stage != "latency" or stats["camera"]}
    for stage, ms in shown.items():
        count = thousands(int(ms["frames"]))
        lines.append(f"| {stage} | {ms['p50']:.2f} ms | {ms['p95']:.2f} ms | {ms['p99']:.2f} ms | {count} |")
    lines += [
        "",
        "`track`, `map` and `loop` are the stages and run in parallel; the other rows are steps of them. Compiling the",
        "kernels, once after an installation, is left out.",
    ]
    if "latency" in shown:
        lines.append("`latency` is the time from the arrival of an image to its pose; the plot omits it.")
    with (folder / "report.md").open("w", encoding="utf-8", errors="replace") as report:
        report.write("\n".join([*lines, "", _glossary(folder), ""]))
        for name, draw in drawings.items():
            report.flush()
            if not go_on():
                report.write("\nFurther plots were omitted: the run was interrupted.\n")
                break
            draw()
            if name != "trajectory":  # it is at the beginning
                report.write(f"\n![{name}]({name}.png)\n")
    page = to_html(source_name, (folder / "report.md").read_text("utf-8"), take_plots(folder, drawings))
    (folder / "report.html").write_text(page, encoding="utf-8", errors="replace")


def _glossary(folder: Path) -> str:
    """Where the terms are explained: a link in a checkout, else the page's name in the documentation."""
    page = Path(__file__).resolve().parents[2] / "docs" / "glossary.md"
    link = f"[glossary]({os.path.relpath(page, folder.resolve())})" if page.is_file() else "glossary (docs/glossary.md)"
    return f"The {link} explains the terms."


def _lost_intervals(intervals: list[dict[str, Any]]) -> list[str]:
    """A table of the frames without a pose; empty if there are none."""
    rows = [
        f"| {x['begin_s']:.2f} s | {x['begin_s'] + x['seconds']:.2f} s | {x['frames']} "
        f"| {x['reason'].replace('_', ' ')} | {ADVICE.get(x['reason'], '')} |"
        for x in intervals
    ]
    return _table("Lost intervals", "| from | to | frames | reason | advice |", rows)


def _gaps(gaps: list[dict[str, Any]]) -> list[str]:
    """A table of the times without images; empty if there are none."""
    rows = [f"| {x['begin_s']:.2f} s | {x['begin_s'] + x['seconds']:.2f} s | {x['missing']} |" for x in gaps]
    return _table("Times without images", "| from | to | images missing, about |", rows)


def _table(title: str, head: str, rows: list[str]) -> list[str]:
    """The first rows of a table below its title; empty without rows."""
    if not rows:
        return []
    more = ["", f"{len(rows) - SHOWN_ROWS} more are in stats.json."] if len(rows) > SHOWN_ROWS else []
    return ["", f"## {title}", "", head, "|---" * (head.count("|") - 1) + "|", *rows[:SHOWN_ROWS], *more]


def _rejections(counts: dict[str, int]) -> list[str]:
    """A table of the reasons why loop candidates were rejected; empty if none were."""
    if not counts:
        return []
    rows = [f"| {reason.replace('_', ' ')} | {n} | {REJECTIONS.get(reason, '')} |" for reason, n in counts.items()]
    return ["", "## Rejected loop candidates", "", "| reason | candidates | meaning |", "|---|---|---|", *rows]


def _plots_by_name(
    folder: Path,
    record: RunRecord,
    stats: dict[str, Any],
    estimates: dict[str, Trajectory],
    evaluations: dict[str, Evaluation],
) -> dict[str, Callable[[], None]]:
    """Functions that draw the plots, by name."""
    drawings: dict[str, Callable[[], None]] = {}
    aligned = {name: result.alignment.apply(estimates[name]) for name, result in evaluations.items()}
    shown = aligned or {name: t for name, t in estimates.items() if len(t)}
    if shown:
        truth = next(iter(evaluations.values())).reference if evaluations else None
        drawings["trajectory"] = lambda: plots.plot_trajectory(folder / "trajectory.png", shown, truth, True)
    if evaluations:
        drawings["errors"] = lambda: plots.plot_errors(folder / "errors.png", evaluations)
    if record.tracked().any():
        drawings["tracking"] = lambda: plots.plot_tracking(folder / "tracking.png", record)
    if record.calibrations:
        drawings["calibration"] = lambda: plots.plot_calibration(folder / "calibration.png", record)
    if len(record.frames):
        stages = [stage for stage in stats["ms"] if stage != "latency"]
        drawings["times"] = lambda: plots.plot_times(folder / "times.png", record, stages)
    return drawings


def _odd(stats: dict[str, Any]) -> list[str]:
    """What was odd about the source and left out or mended, except what the summary says."""
    said = stats["start_check"]["text"] if stats["start_check"] else None
    return [f"**WARN**: {line}" for line in stats["warnings"] if said is None or said not in line]


def _drops(stats: dict[str, Any]) -> list[str]:
    """Images lost between the camera and the log."""
    lost, total = stats["dropped"] - stats["dropped_by_capture"], stats["frames"] + stats["dropped"]
    slow = "were dropped because the stages are too slow: try --frame-skip, or fewer points (tracker.max_features)"
    disk = "are not in the log because its disk is too slow: use --image-format jpeg or --log lean"
    rows = (
        (stats["dropped_by_capture"], slow),
        (lost, "never arrived: check the cable, the disk and the files"),
        (stats["left_out_of_log"], disk),
    )
    out = [f"**WARN**: {n} frames ({100 * n / total:.1f} %) {what}" for n, what in rows if n]
    return out + ([f"**WARN**: {stats['log_ended']}"] if stats["log_ended"] else [])


def verdicts(stats: dict[str, Any], evaluations: dict[str, Evaluation]) -> list[str]:
    """What is good, what is not, and advice."""
    out: list[str] = []
    failed = failure(stats)
    if failed:
        out.append(f"**FAIL**: {failed}")
    reasons = sorted({interval["reason"] for interval in stats["lost_intervals"]})
    if reasons:
        out += [f"**WARN**: tracking was lost ({reason}): {ADVICE.get(reason, 'see stats.json')}" for reason in reasons]
    if 0 < stats["unplaced"] < stats["tracked"]:
        unplaced = f"{thousands(stats['unplaced'])} of the tracked frames were not found in the map"
        out.append(f"**WARN**: {unplaced}: show the camera places that it has")
    if stats["pieces"] > 1:
        out.append(
            f"**WARN**: the map is in {stats['pieces']} unconnected submaps: tracking restarted, and no place of one "
            "was recognised in another; drive again through a place that was seen before tracking was lost"
        )
    if stats["loop_errors_at"]:
        out.append(f"**WARN**: {loop_errors(stats)}")
    if unseen := without_images(stats):
        out.append(f"**WARN**: {unseen}")
    out += _drops(stats)
    out += [f"**WARN**: {line}" for line in sensor_lines(stats)]
    if stats["tracked"] and stats["inliers_median"] < FEW_INLIERS:
        out.append(
            f"**WARN**: only {stats['inliers_median']:.0f} points per frame: check texture, exposure and calibration"
        )
    if stats["row_errors"] is not None and stats["row_errors"]["warning"]:
        rows = stats["row_errors"]["systematic_px"]
        out.append(f"**WARN**: the calibration does not fit the images (row error {rows:.2f} px): see check-calib")
    if stats["pieces"] <= 1:  # else the submaps' relative poses are wrong, not the lengths
        out += [text for name, result in evaluations.items() if (text := _error(name, result))]
    out += _odd(stats)
    if not out and stats["tracked"]:
        out.append(passed(stats))
    return out or ["no frames"]


def _error(name: str, result: Evaluation) -> str:
    """Whether a path is too long, too short or far from the true one; "" if it is very short or has no scale."""
    if result.mode == "sim3" or result.length_m < MIN_LENGTH_M:
        return ""
    off = 1 / result.sim3_scale - 1
    if abs(result.sim3_scale - 1) > BIG_ERROR:
        how = "long" if off > 0 else "short"
        return f"**WARN**: {name} is {abs(100 * off):.1f} % too {how}: check the baseline and the calibration"
    if result.ate_percent > 100 * BIG_ERROR:
        return f"**WARN**: {name} is off by {result.ate_percent:.2g} % of the path: see the picture for where"
    return ""
