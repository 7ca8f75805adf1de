"""What a run of `benchmarks real` reached, from its output folder."""

from __future__ import annotations

import functools
import json
from pathlib import Path
from typing import Any

import numpy as np
from _real_sequences import Sequence

from stereo_sfm.drivers.ground_truth import read_tum
from stereo_sfm.drivers.source import open_source
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.eval.evaluate import evaluate
from stereo_sfm.geometry import se3
from stereo_sfm.types import F64, Trajectory

KEPT = ("seconds", "why", "applied", "text", "terms", "covariance")  # of a change of the calibration


@functools.cache
def truth_of(path: Path, rig: Path | None) -> Trajectory | None:
    """Ground truth of a sequence."""
    with open_source(str(path), rig) as source:
        return source.ground_truth


def measured(folder: Path, sequence: Sequence, truth: Trajectory | None) -> dict[str, Any]:
    """The numbers of a run; without the errors where it has no pose."""
    stats = json.loads((folder / "stats.json").read_text("utf-8"))
    told = stats.get("calibration", [])  # earlier versions had none
    changes = [c for c in told if c["applied"]]
    out: dict[str, Any] = {
        "frames": stats["frames"],
        "lost": stats["frames"] - stats["tracked"],
        "losses": len(stats["lost_intervals"]),
        "submaps": stats.get("pieces"),
        "keyframes": stats["keyframes"],
        "loops": stats["loops_accepted"],
        "corrections": sum(c["why"] != "step" for c in changes),
        "steps": sum(c["why"] == "step" for c in changes),
        "not_ok": stats["frames"] - stats["states"].get("OK", 0) if "states" in stats else None,
        "suspected": len(stats["suspected"]) if "suspected" in stats else None,  # earlier versions did not tell
        "changes": [{name: c[name] for name in KEPT} for c in told],
        "duration_s": stats["duration_s"],
        "path_m": stats["path_m"],
        "fingerprint": stats.get("fingerprint"),
    }
    estimate = _trajectory(folder / "trajectory_map.tum")
    if estimate is None:
        return out
    out |= _errors(estimate, truth)
    odometry = _trajectory(folder / "trajectory_odom.tum")
    if odometry is not None and truth is not None:
        out["odometry_m"] = _errors(odometry, truth).get("ate_m")
    places = estimate.poses[:, :3, 3]
    if sequence.rest:
        out["ate_m"] = spread(places)
    if sequence.closed and stats["path_m"] > 0:
        out["closing_m"] = float(np.linalg.norm(places[-1] - places[0]))
    if sequence.deg_per_s:
        turned = np.rad2deg(np.linalg.norm(se3.log(se3.inverse(estimate.poses[0]) @ estimate.poses[-1])[3:]))
        seconds = float(estimate.stamp_ns[-1] - estimate.stamp_ns[0]) * 1e-9
        out["angle_error_deg"] = float(turned - sequence.deg_per_s * seconds)
    return out


def spread(places: F64) -> float:
    """Root mean square distance of places (N, 3) from their mean, which is the ATE of a camera that stands still."""
    return float(np.sqrt(np.square(places - places.mean(0)).sum(1).mean()))


def still_m(truth: Trajectory | None, begin_s: float, duration_s: float, first_ns: int) -> float | None:
    """The ATE of a camera that stands still in a part of a sequence whose first image is at `first_ns`."""
    if truth is None:
        return None
    since = (truth.stamp_ns - first_ns) * 1e-9
    part = (since >= begin_s) & (since < (begin_s + duration_s if duration_s else np.inf))
    return spread(truth.poses[part][:, :3, 3]) if part.any() else None


def first_stamp(path: Path, rig: Path | None) -> int:
    """Time of the first image."""
    with open_source(str(path), rig) as source:
        return next(iter(source)).stamp_ns


def _errors(estimate: Trajectory, truth: Trajectory | None) -> dict[str, Any]:
    """ATE after SE(3) and Sim(3) alignment, and the scale of the latter, over the estimate's frames."""
    if truth is None:
        return {}
    try:
        found = evaluate(estimate, truth, "se3")
    except StereoSfmError:
        return {}
    return {"ate_m": found.ape_m.rmse, "ate_sim3_m": _finite(found.ate_sim3_m), "scale": _finite(found.sim3_scale)}


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None


def _trajectory(path: Path) -> Trajectory | None:
    if not path.is_file():
        return None
    found = read_tum(path)
    return found if len(found) > 1 else None
