"""Our errors against evo's, which many people use."""

from __future__ import annotations

import numpy as np
import pytest
from evo.core import metrics as evo_metrics
from evo.core import sync
from evo.core.trajectory import PoseTrajectory3D

from stereo_sfm.eval.evaluate import evaluate
from stereo_sfm.geometry import se3
from stereo_sfm.types import F64, Trajectory

SEED = 5


def noisy_sequence(count: int = 120) -> tuple[Trajectory, Trajectory]:
    """(estimate, reference): a turning sequence, the estimate with drift, noise, another scale and another world."""
    rng = np.random.default_rng(SEED)
    step = se3.exp(np.array([0.02, 0.01, 0.3, 0.01, 0.05, -0.02]))
    reference: list[F64] = [np.eye(4)]
    estimate: list[F64] = [se3.exp(np.array([3.0, -1.0, 2.0, 0.4, -0.8, 1.1]))]
    for _ in range(count - 1):
        wobble = se3.exp(rng.normal(scale=0.02, size=6))
        reference.append(reference[-1] @ step @ wobble)
        estimate.append(estimate[-1] @ step @ wobble @ se3.exp(rng.normal(scale=0.004, size=6)))
    stamps = np.arange(count, dtype=np.int64) * 33_333_333 + 1_553_180_224 * 10**9
    poses = np.array(estimate)
    poses[:, :3, 3] *= 1.05
    return Trajectory(stamps, poses), Trajectory(stamps.copy(), np.array(reference))


def as_evo(trajectory: Trajectory) -> PoseTrajectory3D:
    return PoseTrajectory3D(poses_se3=list(trajectory.poses), timestamps=trajectory.stamp_ns / 1e9)


def evo_errors(estimate: Trajectory, reference: Trajectory, metric: evo_metrics.PE, mode: str) -> dict[str, float]:
    truth, guess = sync.associate_trajectories(as_evo(reference), as_evo(estimate))
    if mode != "none":
        guess.align(truth, correct_scale=mode == "sim3")
    metric.process_data((truth, guess))
    return metric.get_all_statistics()


@pytest.mark.parametrize("mode", ["se3", "sim3", "none"])
def test_absolute_errors_equal_evos(mode: str) -> None:
    estimate, reference = noisy_sequence()
    ours = evaluate(estimate, reference, mode)
    position = evo_errors(estimate, reference, evo_metrics.APE(evo_metrics.PoseRelation.translation_part), mode)
    angle = evo_errors(estimate, reference, evo_metrics.APE(evo_metrics.PoseRelation.rotation_angle_deg), mode)
    for name in ("rmse", "mean", "median", "std", "min", "max"):
        assert getattr(ours.ape_m, name) == pytest.approx(position[name], rel=1e-6)
        assert getattr(ours.ape_deg, name) == pytest.approx(angle[name], rel=1e-5, abs=1e-5)


@pytest.mark.parametrize("delta", [1, 7])
def test_relative_errors_equal_evos(delta: int) -> None:
    estimate, reference = noisy_sequence()
    ours = evaluate(estimate, reference, "none", f"{delta}f")
    for relation, statistics in (
        (evo_metrics.PoseRelation.translation_part, ours.rpe_m),
        (evo_metrics.PoseRelation.rotation_angle_deg, ours.rpe_deg),
    ):
        metric = evo_metrics.RPE(relation, delta=delta, delta_unit=evo_metrics.Unit.frames, all_pairs=True)
        theirs = evo_errors(estimate, reference, metric, "none")
        assert statistics.rmse == pytest.approx(theirs["rmse"], rel=1e-6)
        assert statistics.max == pytest.approx(theirs["max"], rel=1e-5)


def test_sim3_finds_the_scale_that_was_put_in() -> None:
    estimate, reference = noisy_sequence()
    assert evaluate(estimate, reference, "sim3").alignment.scale == pytest.approx(1 / 1.05, rel=0.01)
    assert evaluate(estimate, reference).sim3_scale == pytest.approx(1 / 1.05, rel=0.01)
