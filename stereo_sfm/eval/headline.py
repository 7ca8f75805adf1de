"""The first sentence of a report, for a reader who knows no term of the field."""

from __future__ import annotations

from typing import Any

from stereo_sfm.eval.evaluate import Evaluation, length
from stereo_sfm.eval.statistics import failure, thousands


def headline(stats: dict[str, Any], evaluations: dict[str, Evaluation], warnings: int) -> str:
    """What the run is worth, in one sentence.

    Args:
        stats: of the run. evaluations: by trajectory, where there is ground truth. warnings: those of the verdict.
    """
    failed = failure(stats)
    if failed:
        return f"**This run failed**: {failed}."
    total = stats["frames"] + stats["dropped"]
    placed = stats["tracked"] - stats["unplaced"]
    share = "all" if placed == total else f"{thousands(placed)} of"
    path = f"the camera's path of {length(stats['path_m'])} in {stats['duration_s']:.1f} s"
    known = f"**The camera's position is known for {share} {thousands(total)} images** along {path}"
    listed = {0: "", 1: "; one warning is listed below"}.get(warnings, f"; {warnings} warnings are listed below")
    return f"{known}, {_error(evaluations)}{listed}."


def _error(evaluations: dict[str, Evaluation]) -> str:
    result = evaluations.get("map", evaluations.get("odometry"))
    if result is None:
        return "but nobody can say how exactly: the recording has no true path to compare with"
    percent = f" ({result.ate_percent:.2g} % of the path)" if result.mode != "sim3" else ", its size left aside"
    part = "" if result.frames == result.of_frames else f", which is known for {thousands(result.frames)} of them"
    return f"with an error of {length(result.ape_m.rmse)}{percent} against the true path{part}"


def passed(stats: dict[str, Any]) -> str:
    """What a run without a warning has shown: that every frame has a pose, on how many points, and in which map."""
    dropped = ", except those dropped by capture" if stats["dropped_by_capture"] else ""
    parts = [f"every frame after the first pose has a pose{dropped}"]
    parts.append(f"a pose rests on {stats['inliers_median']:.0f} points (median)")
    if stats["keyframes"]:
        parts.append("the map is in one piece")
    if stats["row_errors"] is not None:
        parts.append(f"the images fit the calibration (row error {stats['row_errors']['systematic_px']:.2f} px)")
    return f"**PASS**: {'; '.join(parts)}"
