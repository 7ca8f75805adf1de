"""The numbers of a run: stats.json, and the closing lines for the screen and for bug reports."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from stereo_sfm.drivers.live.counters import LOSSES
from stereo_sfm.eval.calibration_results import (
    calibration_lines,
    calibration_stats,
    mounting_stats,
    row_error_stats,
    sensor_stats,
    shutter_stats,
    start_check_stats,
    suspicion_stats,
)
from stereo_sfm.eval.evaluate import Evaluation, length
from stereo_sfm.eval.record import RunRecord
from stereo_sfm.eval.sensor_results import sensor_lines, sensor_use_stats
from stereo_sfm.maps.mounting import Mounting
from stereo_sfm.messages import Health
from stereo_sfm.tracking.inertial.inertial_motion import roll_pitch_deg
from stereo_sfm.types import F64, TrackState

RING, LOG = "ring", "log"  # where images are dropped, see `Dropped`
# Part of frames without a pose above which the run counts as failed.
MAX_LOST_PERCENT = 20.0
SHOWN_ERRORS = 5  # keyframes that one line names


def percentiles(values: Sequence[float] | F64) -> dict[str, float]:
    """p50, p95 and p99."""
    p50, p95, p99 = np.percentile(np.asarray(values, float), [50, 95, 99])
    return {"p50": float(p50), "p95": float(p95), "p99": float(p99)}


def stage_times(record: RunRecord) -> dict[str, dict[str, float]]:
    """Milliseconds per stage over the frames that ran it, the longest first."""
    ran = {stage: ms[np.isfinite(ms)] for stage, ms in record.times().items()}
    ran = {stage: ms for stage, ms in ran.items() if len(ms)}
    order = sorted(ran, key=lambda stage: -float(ran[stage].sum()))
    return {stage: {**percentiles(ran[stage]), "frames": float(len(ran[stage]))} for stage in order}


def statistics(
    record: RunRecord,
    wall_s: float,
    evaluations: dict[str, Evaluation] | None = None,
    mounting: Mounting | None = None,
) -> dict[str, Any]:
    """The numbers of a run as plain values for JSON."""
    tracked = int(record.tracked().sum())
    frames, drops = len(record.frames), record.drops
    dropped_by_capture = drops.get(RING, 0)
    lost = record.lost_intervals()
    drifts = record.closure_drifts()
    states, counts = np.unique(record.frames.state, return_counts=True)
    stamps = record.frames.stamp_ns
    trajectory = record.mapped() or record.odometry()
    return {
        "frames": frames,
        "tracked": tracked,
        "unplaced": tracked - int(record.placed().sum()),  # not found in the saved map
        "dropped": sum(count for where, count in drops.items() if where != LOG),
        "dropped_by_capture": dropped_by_capture,  # the stages were too slow
        "left_out_of_log": drops.get(LOG, 0),  # tracked, but missing in the log
        "log_ended": record.log_ended,
        "states": {TrackState(k).name: n for k, n in zip(states.tolist(), counts.tolist(), strict=True)},
        "lost_percent": 100.0 * (frames + dropped_by_capture - tracked) / max(frames + dropped_by_capture, 1),
        "lost_intervals": [dataclasses.asdict(interval) for interval in lost],
        "stamp_gaps": [dataclasses.asdict(gap) for gap in record.stamp_gaps()],
        "localize_only": record.localize_only,
        "located_after_s": record.located_after_s() if record.localize_only else None,
        "pieces": record.unconnected_submaps(),
        "keyframes": len(record.keyframes),
        "points": len(record.map_points) or int(record.seen_points.sum()),
        "inliers_median": float(np.median(record.frames.inliers)) if frames else 0.0,
        "path_m": trajectory.length if len(trajectory) > 1 else 0.0,
        "duration_s": float(stamps[-1] - stamps[0]) / 1e9 if frames else 0.0,
        "gravity": gravity_stats(record),
        "mounting": mounting_stats(mounting),
        "loops_accepted": len(record.loops),
        "loops_rejected": dict(sorted(record.rejected.items(), key=lambda item: (-item[1], item[0]))),
        "loop_errors_at": record.failed_kf_ids,  # keyframes at which the loop closer failed
        "closure_drift_percent_median": 100 * float(np.median(drifts)) if drifts else None,
        "wall_s": wall_s,
        "frames_per_s": frames / wall_s if wall_s > 0 else 0.0,
        "ms": stage_times(record),
        "health": {stage: _health(report) for stage, report in sorted(record.health.items())},
        "camera": record.source_counts,
        "warnings": list(record.warnings),
        "start_check": start_check_stats(record),
        "calibration": calibration_stats(record),
        "shutter": shutter_stats(record),
        "suspected": suspicion_stats(record),
        "sensor_calibration": sensor_stats(record),
        "sensors": sensor_use_stats(record),
        "row_errors": row_error_stats(record),
        "fingerprint": record.fingerprint(),
        "evaluation": {name: result.to_dict() for name, result in (evaluations or {}).items()},
    }


def gravity_stats(record: RunRecord) -> dict[str, float] | None:
    """Roll and pitch of the map's axes (those of its first camera) against gravity, degrees; None if not measured."""
    if not record.down.any() or not record.down_information:  # a saved map may know it
        return None
    roll, pitch = roll_pitch_deg(record.down)
    return {"roll_deg": roll, "pitch_deg": pitch, "sigma_deg": float(np.degrees(record.down_information**-0.5))}


def _health(report: Health) -> dict[str, float]:
    return {
        "rate": report.rate,
        "p50_ms": report.p50_ms,
        "p95_ms": report.p95_ms,
        "p99_ms": report.p99_ms,
        "queue_max": float(report.queue),
        "dropped": float(report.dropped),
    }


def failure(stats: dict[str, Any]) -> str:
    """Why the run counts as failed (exit code 4), or ''."""
    checked = stats["start_check"]
    if not stats["tracked"]:
        return "tracking never initialised" + (f": {checked['text']}" if checked else "")
    if checked and checked["shown"] and not checked["corrected"]:
        return f"the first images contradict the calibration: {checked['text']}"
    if stats["lost_percent"] > stats["max_lost_percent"]:
        dropped = stats["dropped_by_capture"]
        why = f", {thousands(dropped)} of them dropped by capture: the stages are too slow" if dropped else ""
        limit = f"(limit {stats['max_lost_percent']:g} %)"
        return f"{stats['lost_percent']:.0f} % of the frames have no pose {limit}{why}"
    if stats["unplaced"] == stats["tracked"]:
        return "the camera was never found in the map"
    return ""


def thousands(count: int) -> str:
    """8930 -> '8 930'."""
    return f"{count:,}".replace(",", " ")


def summary(stats: dict[str, Any], evaluations: dict[str, Evaluation] | None = None) -> list[str]:
    """The closing lines of a run."""
    total = stats["frames"] + stats["dropped"]
    lines = [
        f"tracked {thousands(stats['tracked'])}/{thousands(total)} frames ({_dropped(stats)}), "
        f"{_lost(stats)}, {stats['keyframes']} keyframes, {thousands(stats['points'])} points",
    ]
    if stats["localize_only"]:
        lines.append(_localized(stats))
    elif stats["unplaced"]:
        lines.append(f"{thousands(stats['unplaced'])} of the tracked frames were not found in the map")
    if stats["pieces"] > 1:
        lines.append(f"{stats['pieces']} submaps that no loop connects: their relative poses are only predicted")
    if stats["loops_accepted"] or stats["loops_rejected"]:
        lines.append(_loops(stats))
    if stats["loop_errors_at"]:
        lines.append(loop_errors(stats))
    if stats["gravity"]:
        lines.append(_gravity(stats["gravity"]))
    if unseen := without_images(stats):
        lines.append(unseen)
    lines += sensor_lines(stats)
    if stats["camera"]:
        lines.append(_camera(stats["camera"]))
    lines += _log(stats)
    lines += calibration_lines(stats)
    lines.append(_times(stats))
    for name, result in (evaluations or {}).items():
        lines.append(_against_truth(name, result))
    return lines


def _localized(stats: dict[str, Any]) -> str:
    """What came of the saved map."""
    if stats["located_after_s"] is None:
        return "localized in the saved map: never"
    placed = f"{thousands(stats['tracked'] - stats['unplaced'])} of {thousands(stats['tracked'])} tracked frames"
    return f"localized in the saved map: {placed}, first found after {stats['located_after_s']:.1f} s"


def _dropped(stats: dict[str, Any]) -> str:
    lost = stats["dropped"] - stats["dropped_by_capture"]
    camera = f", {thousands(lost)} lost before capture" if lost else ""
    return f"{thousands(stats['dropped_by_capture'])} dropped by capture{camera}"


def _log(stats: dict[str, Any]) -> list[str]:
    """What is missing in the log."""
    lines = [f"the log is not complete: {stats['log_ended']}"] if stats["log_ended"] else []
    if stats["left_out_of_log"]:
        noun = "image" if stats["left_out_of_log"] == 1 else "images"
        lines.append(f"the log lacks {thousands(stats['left_out_of_log'])} {noun}: it was slower than the camera")
    return lines


def _against_truth(name: str, result: Evaluation) -> str:
    ate = f"{name} against ground truth: ATE {length(result.ape_m.rmse)} over {length(result.length_m)}"
    rotation = f"{result.rpe_deg.rmse:.3f} deg per frame" if result.oriented else ""
    if result.mode == "sim3":
        return f"{ate} (Sim(3) aligned: one camera has no scale)" + (f", rotation {rotation}" if rotation else "")
    return (
        f"{ate} ({result.ate_percent:.3f} %, {result.mode.upper()} aligned), Sim(3) {length(result.ate_sim3_m)}, "
        f"RPE {length(result.rpe_m.rmse)} {rotation or 'per frame'}"
    )


def _lost(stats: dict[str, Any]) -> str:
    if not stats["tracked"]:
        return "never initialised"
    intervals: list[dict[str, Any]] = stats["lost_intervals"]
    if not intervals:
        return "never lost"
    worst = max(intervals, key=lambda interval: interval["seconds"])
    noun = "interval" if len(intervals) == 1 else "intervals"
    return f"{len(intervals)} lost {noun} (max {worst['seconds']:.1f} s, {worst['reason']})"


def _gravity(tilt: dict[str, float]) -> str:
    """How the map's axes are tilted."""
    return (
        f"gravity is known to {tilt['sigma_deg']:.2f} deg: the first camera is rolled by {tilt['roll_deg']:.2f} deg "
        f"and pitched by {tilt['pitch_deg']:.2f} deg"
    )


def _camera(counts: dict[str, float]) -> str:
    """Problems of a live camera by its own counters."""
    losses = [f"{name.replace('_', ' ')} {count:g}" for name, count in counts.items() if count and name in LOSSES]
    return f"camera: {counts.get('pairs', 0):g} stereo images, {', '.join(losses) or 'nothing lost'}"


def _loops(stats: dict[str, Any]) -> str:
    reasons = ", ".join(f"{count} {reason.replace('_', ' ')}" for reason, count in stats["loops_rejected"].items())
    rejected = sum(stats["loops_rejected"].values())
    noun = "loop" if stats["loops_accepted"] == 1 else "loops"
    text = f"{stats['loops_accepted']} {noun} accepted / {rejected} candidates rejected" + (
        f" ({reasons})" if reasons else ""
    )
    drift = stats["closure_drift_percent_median"]
    return text if drift is None else f"{text} · odometry drift at loops {drift:.2f} % of the path (median)"


def without_images(stats: dict[str, Any]) -> str:
    """How many poses the images say nothing about; "" if all rest on them."""
    count = int(stats["states"].get(TrackState.INERTIAL.name, 0))
    if not count:
        return ""
    return f"{thousands(count)} poses ({100 * count / stats['frames']:.1f} %) rest on IMU or wheels alone"


def loop_errors(stats: dict[str, Any]) -> str:
    """At which keyframes the loop closer failed."""
    at: list[int] = stats["loop_errors_at"]
    some = ", ".join(map(str, at[:SHOWN_ERRORS])) + (", ..." if len(at) > SHOWN_ERRORS else "")
    noun = "keyframe" if len(at) == 1 else "keyframes"
    return f"the loop closer failed at {len(at)} {noun} ({some}) and started again: please report the log's traceback"


def _times(stats: dict[str, Any]) -> str:
    parts = [
        f"{stage} p50 {ms['p50']:.1f} ms p95 {ms['p95']:.1f} ms"
        for stage, ms in stats["ms"].items()
        if stage in ("track", "map", "loop")
    ]
    rate = f"{stats['frames_per_s']:.1f} frames/s"
    return " · ".join([*parts, rate, f"result hash {stats['fingerprint']}"])
