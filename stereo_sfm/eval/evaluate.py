"""The evaluation of an estimate against a reference, and how it is printed."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.eval import metrics
from stereo_sfm.eval.align import Alignment, align
from stereo_sfm.eval.associate import MAX_DIFFERENCE_NS, associate, parts_of
from stereo_sfm.eval.metrics import Drift, RetailErrors, Statistics
from stereo_sfm.types import F64, Trajectory

STRAIGHT = 0.02  # lateral extent of a path, as a share of its length, below which it counts as straight


@dataclass(frozen=True)
class Evaluation:
    """Errors of an estimate. Absolute errors are after `alignment`; of all others only its scale matters."""

    mode: str  # of eval.align.MODES
    alignment: Alignment
    length_m: float  # of the associated reference
    frames: int  # associated
    of_frames: int  # of the estimate
    ape_m: Statistics  # absolute position error: its rmse is the ATE
    ape_deg: Statistics
    ate_percent: float  # of the path
    ate_sim3_m: float  # the ATE with scale aligned as well; NaN where it is not defined
    sim3_scale: float
    rpe_m: Statistics  # per `rpe_delta`
    rpe_deg: Statistics
    rpe_delta: str
    drift: Drift | None
    retail: RetailErrors | None
    oriented: bool  # False: one of the two holds positions only, every rotation error is NaN
    estimate: Trajectory  # aligned, at the associated stamps
    reference: Trajectory

    def errors_m(self) -> F64:
        """(frames,) absolute position error."""
        return metrics.absolute_errors(self.estimate.poses, self.reference.poses)[0]

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON; NaN becomes None."""
        skip = {"estimate", "reference", "alignment"}
        values = {f.name: getattr(self, f.name) for f in dataclasses.fields(self) if f.name not in skip}
        values["scale"] = self.alignment.scale
        return {name: _plain(value) for name, value in values.items()}


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {k: _plain(v) for k, v in dataclasses.asdict(value).items()}
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return list(value) if isinstance(value, tuple) else value


def evaluate(
    estimate: Trajectory,
    reference: Trajectory,
    mode: str = "se3",
    delta: str = "1f",
    interpolate: bool = True,
    max_difference_ns: int = MAX_DIFFERENCE_NS,
) -> Evaluation:
    """Compare two trajectories of the same frame (world_T_cam0 with world_T_cam0).

    Args:
        estimate: the trajectory to evaluate.
        reference: the ground truth.
        mode: the alignment, one of eval.align.MODES.
        delta: distance of relative errors: `5f` frames or `1m` metres.
        interpolate: see `associate`.
        max_difference_ns: see `associate`.

    Raises:
        StereoSfmError: nothing in common, or the alignment is not determined.
    """
    of_frames, whole = len(estimate), reference
    estimate, reference = associate(estimate, reference, interpolate, max_difference_ns)
    parts = parts_of(whole, estimate.stamp_ns)
    alignment = align(estimate, reference, mode)
    pairs = metrics.within(_pairs(reference.poses, delta), parts)
    aligned = alignment.apply(estimate)
    oriented = estimate.oriented and reference.oriented
    # Motions are compared in the body's axes; where those are unknown, in the reference's, after alignment.
    scaled = Alignment(np.eye(4), alignment.scale).apply(estimate)
    moving, still = (scaled.poses, reference.poses) if oriented else (_positions(aligned), _positions(reference))
    rpe_m, rpe_rad = metrics.relative_errors(moving, still, pairs)
    drift = metrics.kitti_drift(moving, still, parts)
    retail = metrics.retail_errors(moving, still, parts) if oriented else None
    sim3_ate, sim3_scale = _sim3(estimate, reference)
    ape_m, ape_rad = metrics.absolute_errors(aligned.poses, reference.poses)
    if not oriented:
        ape_rad, rpe_rad = np.full_like(ape_rad, math.nan), np.full_like(rpe_rad, math.nan)
        drift = None if drift is None else replace(drift, rotation_deg_per_m=math.nan)
    ape = Statistics.of(ape_m)
    length = metrics.seen_length(reference.poses, parts)
    return Evaluation(
        mode=mode,
        alignment=alignment,
        length_m=length,
        frames=len(estimate),
        of_frames=of_frames,
        ape_m=ape,
        ape_deg=Statistics.of(np.degrees(ape_rad)),
        ate_percent=100 * ape.rmse / length if length > 0 else math.nan,
        ate_sim3_m=sim3_ate,
        sim3_scale=sim3_scale,
        rpe_m=Statistics.of(rpe_m),
        rpe_deg=Statistics.of(np.degrees(rpe_rad)),
        rpe_delta=delta,
        drift=drift,
        retail=retail,
        oriented=oriented,
        estimate=aligned,
        reference=reference,
    )


def _positions(trajectory: Trajectory) -> F64:
    """(N, 4, 4) poses without rotation."""
    poses = np.tile(np.eye(4), (len(trajectory), 1, 1))
    poses[:, :3, 3] = trajectory.positions
    return poses


def _sim3(estimate: Trajectory, reference: Trajectory) -> tuple[float, float]:
    try:
        similarity = align(estimate, reference, "sim3")
    except StereoSfmError:
        return math.nan, math.nan
    errors = metrics.absolute_errors(similarity.apply(estimate).poses, reference.poses)[0]
    return Statistics.of(errors).rmse, similarity.scale


def _pairs(reference: F64, delta: str) -> metrics.I64:
    number, unit = delta[:-1], delta[-1:]
    try:
        value = float(number)
    except ValueError:
        value = 0.0
    if unit == "f" and value >= 1 and value == int(value):
        return metrics.pairs_by_frames(len(reference), int(value))
    if unit == "m" and value > 0:
        return metrics.pairs_by_metres(reference, value)
    raise StereoSfmError(f"--delta takes frames or metres, as in 1f or 0.5m, got '{delta}'")


def _straightness_note(result: Evaluation) -> str:
    """A note if positions hardly determine the rotation of the paths about their direction."""
    spread = np.linalg.svd(result.reference.positions - result.reference.positions.mean(0), compute_uv=False)
    straight = result.mode != "origin" and len(spread) > 1 and spread[1] < STRAIGHT * spread[0]
    return " (the path is nearly straight: the alignment does not determine the rotation about it)" if straight else ""


def table(result: Evaluation) -> list[tuple[str, str]]:
    """The printed lines as (name, value with unit)."""
    ape = result.ape_m
    rows = [
        ("compared", f"{_compared(result)} over {length(result.length_m)}, alignment {result.mode}"),
        ("ATE", f"{length(ape.rmse)} rmse, {length(ape.max)} max ({result.ate_percent:.3f} % of the path)"),
        ("ATE, Sim(3)", f"{length(result.ate_sim3_m)} rmse, scale {result.sim3_scale:.5f}"),
        ("rotation", _rotation(result)),
        (f"RPE per {result.rpe_delta}", _relative(result)),
    ]
    if result.drift is not None:
        low, high = result.drift.lengths_m[0], result.drift.lengths_m[-1]
        note = "KITTI's lengths" if result.drift.standard else "shorter than KITTI's, as is the path"
        rows.append(
            (
                "drift",
                f"{result.drift.translation_percent:.3f} %, {_rotation_drift(result.drift)}over "
                f"{result.drift.segments} segments of {low:g} to {high:g} m ({note})",
            )
        )
    return rows


def _compared(result: Evaluation) -> str:
    of = f" of {result.of_frames}" if result.frames < result.of_frames else ""
    return f"{result.frames}{of} frames"


def _rotation(result: Evaluation) -> str:
    if not result.oriented:
        return "not compared: one of the trajectories has no orientations"
    return f"{result.ape_deg.rmse:.3f} deg rmse, {result.ape_deg.max:.3f} deg max{_straightness_note(result)}"


def _rotation_drift(drift: Drift) -> str:
    return f"{drift.rotation_deg_per_m:.5f} deg/m " if math.isfinite(drift.rotation_deg_per_m) else ""


def _relative(result: Evaluation) -> str:
    if not result.rpe_m.count:
        return length(math.nan)
    if not result.oriented:
        return f"{length(result.rpe_m.rmse)} rmse"
    return f"{length(result.rpe_m.rmse)} rmse, {result.rpe_deg.rmse:.4f} deg rmse"


def length(metres: float) -> str:
    """A length as text: 4.6 mm, 27.1 mm, 0.449 m, 92.0 m."""
    if not math.isfinite(metres):
        return "not defined"
    if abs(metres) < 0.1:
        return f"{metres * 1e3:.2f} mm"
    return f"{metres:.3f} m" if abs(metres) < 10 else f"{metres:.1f} m"
