from __future__ import annotations

import numpy as np
import pytest

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.eval import metrics
from stereo_sfm.eval.align import align
from stereo_sfm.eval.associate import associate, poses_at
from stereo_sfm.eval.evaluate import evaluate, length, table
from stereo_sfm.geometry import se3
from stereo_sfm.types import F64, Trajectory


def straight(count: int, step: float, turn: float = 0.0) -> F64:
    """(count, 4, 4): `step` metres forward and `turn` radians about y a frame."""
    poses = [np.eye(4)]
    for _ in range(count - 1):
        poses.append(poses[-1] @ se3.exp(np.array([0, 0, step, 0, turn, 0])))
    return np.array(poses)


def trajectory(poses: F64, period_ns: int = 100_000_000, start_ns: int = 0) -> Trajectory:
    return Trajectory(np.arange(len(poses), dtype=np.int64) * period_ns + start_ns, poses)


def test_scale_error_is_translation_drift() -> None:
    truth = straight(1000, 1.0)
    estimate = truth.copy()
    estimate[:, :3, 3] *= 1.02
    drift = metrics.kitti_drift(estimate, truth)
    assert drift is not None and drift.standard
    assert drift.lengths_m == metrics.KITTI_LENGTHS
    # A segment of length L ends at the first frame beyond L, so 1 m steps give an error of 0.02 (L + 1) at most.
    assert 2.0 <= drift.translation_percent <= 2.0 * 1.011
    assert drift.rotation_deg_per_m == pytest.approx(0, abs=1e-9)


def test_turn_error_is_rotation_drift() -> None:
    drift = metrics.kitti_drift(straight(1000, 1.0, turn=np.radians(0.003)), straight(1000, 1.0))
    assert drift is not None
    assert drift.rotation_deg_per_m == pytest.approx(0.003, rel=0.011)


@pytest.mark.parametrize(
    ("metres", "lengths"),
    [(92, tuple(10.0 * i for i in range(1, 9))), (2.74, (1.0, 2.0)), (39, (10.0, 20.0, 30.0)), (101, (100.0,))],
)
def test_short_paths_take_stated_shorter_segments(metres: float, lengths: tuple[float, ...]) -> None:
    drift = metrics.kitti_drift(straight(400, metres / 399), straight(400, metres / 399))
    assert drift is not None
    assert drift.lengths_m == pytest.approx(lengths)
    assert drift.standard == (metres > 100)


def test_no_drift_without_a_path() -> None:
    assert metrics.kitti_drift(straight(5, 0), straight(5, 0)) is None


def test_equations_23_and_24() -> None:
    truth = straight(11, 1.0)
    errors = metrics.retail_errors(straight(11, 1.1, turn=0.01), truth)
    assert errors is not None
    assert errors.relative_rotation_rad_mean == pytest.approx(0.01)
    assert errors.relative_rotation_rad_std == pytest.approx(0, abs=1e-9)
    assert errors.relative_translation_m2_mean == pytest.approx(0.1**2, rel=0.01)  # squared, as in the paper
    assert errors.absolute_rotation_rad == pytest.approx(0.1)
    assert errors.absolute_translation_m2 == pytest.approx(1.0 + 0.55**2, rel=0.1)
    assert metrics.retail_errors(truth[:1], truth[:1]) is None


def test_small_angles_are_not_lost_in_acos() -> None:
    assert metrics.rotation_angle(se3.so3_exp(np.array([0, 1e-9, 0]))) == pytest.approx(1e-9, rel=1e-6)


def test_reference_is_interpolated_at_the_estimates_stamps() -> None:
    reference = trajectory(straight(10, 0.5, turn=0.1))
    inside = np.array([150_000_000, 420_000_000], np.int64)
    poses, kept = poses_at(reference, np.concatenate([[-1], inside, [10**9]]))
    assert kept.tolist() == [1, 2]
    expected = reference.poses[[1, 4]] @ se3.exp(np.outer([0.5, 0.2], [0, 0, 0.5, 0, 0.1, 0]))
    assert poses == pytest.approx(expected, abs=1e-12)


def test_gaps_in_the_reference_are_left_out() -> None:
    poses = straight(4, 1.0)
    reference = Trajectory(np.array([0, 10**8, 10**9, 11 * 10**8], np.int64), poses)
    estimate = Trajectory(np.array([5, 5 * 10**8, 10**9], np.int64) * 1, poses[:3])
    assert associate(estimate, reference)[0].stamp_ns.tolist() == [5, 10**9]


def test_nearest_association_keeps_the_maximum_difference() -> None:
    reference = trajectory(straight(5, 1.0))
    estimate = Trajectory(np.array([4_000_000, 111_000_000, 298_000_000], np.int64), straight(3, 1.0))
    ours, truth = associate(estimate, reference, interpolate=False)
    assert ours.stamp_ns.tolist() == [4_000_000, 298_000_000]
    assert truth.poses == pytest.approx(reference.poses[[0, 3]])


def test_trajectories_without_common_time_are_refused_in_one_line() -> None:
    with pytest.raises(StereoSfmError, match=r"no stamps in common.*0.000 to 0.200") as error:
        associate(trajectory(straight(3, 1.0)), trajectory(straight(3, 1.0), start_ns=10**12))
    assert "\n" not in str(error.value) and "times.txt" not in str(error.value)
    for start_ns, other_ns in ((0, 10**18), (10**18, 0)):  # one was counted from 0
        with pytest.raises(StereoSfmError, match=r"name the images by their stamps, or put a times.txt"):
            associate(trajectory(straight(3, 1.0), start_ns=start_ns), trajectory(straight(3, 1.0), start_ns=other_ns))


def test_alignment_modes() -> None:
    moved = se3.exp(np.array([1, 2, 3, 0.3, 0.2, 0.1]))
    reference = trajectory(straight(30, 0.3, turn=0.1))
    estimate = trajectory(moved @ reference.poses)
    for mode in ("se3", "sim3", "origin"):
        assert align(estimate, reference, mode).transform == pytest.approx(se3.inverse(moved), abs=1e-9)
    assert evaluate(estimate, reference).ape_m.rmse == pytest.approx(0, abs=1e-9)
    assert evaluate(estimate, reference, "none").ape_m.rmse > 1
    with pytest.raises(StereoSfmError, match="unknown alignment"):
        align(estimate, reference, "affine")


def test_two_poses_cannot_be_aligned_but_compared_from_the_origin() -> None:
    short = trajectory(straight(2, 1.0))
    with pytest.raises(StereoSfmError, match="--align origin"):
        evaluate(short, short)
    result = evaluate(short, short, "origin")
    assert result.ape_m.max == 0
    assert result.to_dict()["ate_sim3_m"] is None
    assert table(result)


@pytest.mark.parametrize("delta", ["1", "0f", "1.5f", "-1m", "xm", ""])
def test_an_invalid_delta(delta: str) -> None:
    with pytest.raises(StereoSfmError, match="--delta"):
        evaluate(trajectory(straight(9, 1, 0.1)), trajectory(straight(9, 1, 0.1)), "none", delta)


def test_relative_errors_over_metres() -> None:
    reference = trajectory(straight(50, 0.1, turn=0.02))
    estimate = trajectory(straight(50, 0.101, turn=0.02))
    assert evaluate(estimate, reference, delta="1m").rpe_m.mean == pytest.approx(0.011, rel=0.05)


def test_lengths_for_people() -> None:
    assert [length(v) for v in (0.0046, 0.449, 91.97, float("nan"))] == ["4.60 mm", "0.449 m", "92.0 m", "not defined"]


def test_a_truth_with_a_hole_tells_nothing_of_the_way_across() -> None:
    """Motion capture at both ends of a corridor: 400 m of drift are not that of the metre that is seen."""
    truth = trajectory(straight(1000, 0.5, turn=0.002))
    estimate = trajectory(straight(1000, 0.5, turn=0.0021))
    seen = np.r_[0:100, 900:1000]
    parts = Trajectory(truth.stamp_ns[seen], truth.poses[seen])
    result = evaluate(estimate, parts)
    assert result.length_m == pytest.approx(99.0) and (result.frames, result.of_frames) == (200, 1000)
    assert result.drift is not None and result.drift.translation_percent < 1.0
    assert result.rpe_m.count == 198 and result.rpe_m.max < 1e-3
    assert "200 of 1000 frames over 99.0 m" in dict(table(result))["compared"]
    assert evaluate(estimate, truth).rpe_m.count == 999


def test_relative_errors_have_the_scale_of_the_alignment() -> None:
    truth = trajectory(straight(200, 0.5, turn=0.02))
    poses = truth.poses.copy()
    poses[:, :3, 3] *= 0.1  # of one camera
    result = evaluate(trajectory(poses), truth, "sim3")
    assert result.rpe_m.rmse < 1e-6 and result.drift is not None and result.drift.translation_percent < 1e-3


def test_a_slow_reference_is_compared_with_the_nearest_poses() -> None:
    """A total station once a second: each of its poses once, not with thirty of the estimate."""
    estimate = trajectory(straight(301, 0.1, turn=0.01))
    slow = Trajectory(estimate.stamp_ns[5::10] + 3_000_000, estimate.poses[5::10])
    with pytest.raises(StereoSfmError, match="a pose every 1 s, --t-max-diff compares the nearest"):
        evaluate(estimate, slow)
    result = evaluate(estimate, slow, interpolate=False, max_difference_ns=500_000_000)
    assert result.frames == 30 and result.ape_m.rmse < 1e-6
