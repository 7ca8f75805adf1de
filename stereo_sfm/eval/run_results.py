"""From the record of a run to the files of its folder."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from stereo_sfm import config as configuration
from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import Config
from stereo_sfm.errors import StereoSfmError, writing_to
from stereo_sfm.eval.calibration_results import write_corrected_rig
from stereo_sfm.eval.evaluate import Evaluation, evaluate
from stereo_sfm.eval.record import RunRecord
from stereo_sfm.eval.report import write_report
from stereo_sfm.eval.statistics import MAX_LOST_PERCENT, statistics
from stereo_sfm.export.run_folder import write_json
from stereo_sfm.export.trajectories import write_kitti, write_tum
from stereo_sfm.geometry import se3
from stereo_sfm.maps.mounting import unknown
from stereo_sfm.types import F64, Trajectory

log = logging.getLogger("stereo_sfm")


def in_frame(poses_cam: F64, frame: str, rig: Rig) -> F64:
    """(N, 4, 4) world_T_cam0 -> the same, or for "body" world_T_body with the first body as the world."""
    if frame == "cam0":
        return poses_cam
    body_T_cam = rig.body_T_left
    return body_T_cam @ poses_cam @ se3.inverse(body_T_cam)


def write_results(
    folder: Path,
    source_name: str,
    rig: Rig,
    config: Config,
    record: RunRecord,
    wall_s: float,
    reference: Trajectory | None = None,
    frame: str = "cam0",
    step: int = 1,
    max_lost_percent: float = MAX_LOST_PERCENT,
    go_on: Callable[[], bool] = lambda: True,
) -> tuple[dict[str, Any], dict[str, Evaluation]]:
    """Write trajectories, configuration, calibration, numbers and report.

    Args:
        folder: exists.
        source_name, rig, config: what was run.
        record: what came out.
        wall_s: seconds it took.
        reference: ground truth (world_T_cam0), or None.
        frame: "cam0" or "body", the frame whose poses the trajectory files hold. Errors are always those of cam0.
        step: every `step`-th frame of the source was processed.
        max_lost_percent: frames without a pose above which the run counts as failed.
        go_on: whether there is time for another plot.

    Returns:
        The content of stats.json, and the evaluations by trajectory name.
    """
    from stereo_sfm.calib import save_rig

    estimates = {"odometry": record.odometry()}
    mapped = record.mapped() if config.mapper.enabled or config.loop.enabled else None
    if mapped is not None:
        estimates["map"] = mapped
    mounting = record.mounting.result() if unknown(rig) else None
    mounting = mounting if mounting is not None and mounting.measured else None
    with writing_to(folder):
        for short, trajectory in zip(("odom", "map"), estimates.values(), strict=False):
            _write_trajectory(folder, short, trajectory, record, rig, frame, step)
        keyframes = record.keyframe_trajectory()
        if len(keyframes):
            _write_tum(folder / "keyframes.tum", keyframes, rig, frame)
        (folder / "config.toml").write_text(configuration.dump(config), encoding="utf-8", errors="replace")
        save_rig(rig, folder / "rig.yaml")
        write_corrected_rig(folder, rig, record, mounting)
        evaluations = _evaluate(estimates, reference, "sim3" if scale_free(config, rig) else "se3")
        stats = {"source": source_name, "frame": frame, **statistics(record, wall_s, evaluations, mounting)}
        stats["max_lost_percent"] = max_lost_percent
        write_json(folder / "stats.json", stats)
        write_report(folder, source_name, record, stats, estimates, reference, evaluations, go_on)
    return stats, evaluations


def scale_free(config: Config, rig: Rig) -> bool:
    """Whether the scale of a run is unknown: of one camera (PnP takes no other source of it), or of unit steps."""
    o = config.odometry
    if o.method == "pnp":
        return o.monocular or not rig.stereo
    return o.scale == "unit" and (o.method == "eight-point" or not rig.stereo)


def _evaluate(estimates: dict[str, Trajectory], reference: Trajectory | None, best: str) -> dict[str, Evaluation]:
    """By name, aligned as `best` says; short paths are aligned at the first pose."""
    evaluations: dict[str, Evaluation] = {}
    if reference is None:
        return evaluations
    for name, trajectory in estimates.items():
        if len(trajectory) < 2:
            continue
        for mode in (best, "origin"):
            try:
                evaluations[name] = evaluate(trajectory, reference, mode)
                break
            except StereoSfmError as error:
                if mode == "origin":
                    log.warning("%s is not compared with ground truth: %s", name, error)
    return evaluations


def _write_trajectory(
    folder: Path, name: str, trajectory: Trajectory, record: RunRecord, rig: Rig, frame: str, step: int
) -> None:
    if not len(trajectory):
        return
    _write_tum(folder / f"trajectory_{name}.tum", trajectory, rig, frame)
    kept = record.tracked() if name == "odom" else record.placed()
    per_frame = record.pose_per_frame(trajectory.poses, kept, step)
    write_kitti(folder / f"trajectory_{name}.kitti", in_frame(per_frame, frame, rig))


def _write_tum(path: Path, trajectory: Trajectory, rig: Rig, frame: str) -> None:
    poses = np.ascontiguousarray(in_frame(trajectory.poses, frame, rig))
    write_tum(path, Trajectory(trajectory.stamp_ns.copy(), poses), f"world_T_{frame}")
