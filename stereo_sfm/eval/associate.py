"""Association of the poses of an estimate and a reference by stamp."""

from __future__ import annotations

import numpy as np

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.types import F64, I64, Trajectory

MAX_DIFFERENCE_NS = 10_000_000  # nearest stamps at most 10 ms apart, as evo's default
A_DAY_NS = 86_400 * 10**9
MAX_GAP_NS = 250_000_000  # a reference is interpolated between poses at most this far apart
MIN_HOLE_NS, HOLE_STEPS = 10**9, 10  # a reference is not known in a gap of so long, and of so many of its usual ones


def poses_at(trajectory: Trajectory, stamp_ns: I64, max_gap_ns: int = MAX_GAP_NS) -> tuple[F64, I64]:
    """Poses at given times, on the geodesic between the two around each.

    Args:
        trajectory: (N,) poses.
        stamp_ns: (M,) times.
        max_gap_ns: times between poses further apart than this are omitted, as are times before and after.

    Returns:
        (K, 4, 4) poses and (K,) indices into `stamp_ns`.
    """
    stamps = trajectory.stamp_ns
    after = np.clip(np.searchsorted(stamps, stamp_ns), 0, len(stamps) - 1)
    exact = stamps[after] == stamp_ns
    before = np.where(exact, after, after - 1)
    gap = np.where(before >= 0, stamps[after] - stamps[before], 0)
    inside = exact | ((before >= 0) & (stamps[after] > stamp_ns) & (gap <= max_gap_ns))
    kept = np.flatnonzero(inside)
    before, after, gap = before[kept], after[kept], gap[kept]
    fraction = np.where(gap > 0, (stamp_ns[kept] - stamps[before]) / np.where(gap > 0, gap, 1), 0.0)
    return se3.interpolate(trajectory.poses[before], trajectory.poses[after], fraction), kept


def associate(
    estimate: Trajectory,
    reference: Trajectory,
    interpolate: bool = True,
    max_difference_ns: int = MAX_DIFFERENCE_NS,
) -> tuple[Trajectory, Trajectory]:
    """The parts of two trajectories that can be compared, with the estimate's stamps.

    Args:
        estimate: the trajectory to evaluate.
        reference: the ground truth.
        interpolate: take the reference at the estimate's stamps; else its poses with the nearest ones of the estimate.
        max_difference_ns: nearest poses further apart than this are omitted.

    Raises:
        StereoSfmError: the two have no time in common.
    """
    if not len(estimate) or not len(reference):
        raise StereoSfmError("a trajectory without poses cannot be compared: was tracking lost from the start?")
    if interpolate:
        poses, kept = poses_at(reference, estimate.stamp_ns)
    else:
        nearest = _nearest(reference.stamp_ns, estimate.stamp_ns)
        apart = np.abs(reference.stamp_ns[nearest] - estimate.stamp_ns)
        order = np.lexsort((apart, nearest))  # each pose of the reference goes with the nearest of the estimate alone
        closest = np.sort(order[np.unique(nearest[order], return_index=True)[1]])
        kept = closest[apart[closest] <= max_difference_ns]
        poses = reference.poses[nearest[kept]]
    if not len(kept):
        raise StereoSfmError(
            f"no stamps in common: the estimate covers {_span(estimate)}, the reference {_span(reference)} (seconds)"
            + _remedy(estimate, reference)
        )
    stamps = estimate.stamp_ns[kept]
    return (
        Trajectory(stamps, estimate.poses[kept], estimate.oriented),
        Trajectory(stamps.copy(), poses, reference.oriented),
    )


def parts_of(reference: Trajectory, stamp_ns: I64) -> I64:
    """(N,) at these times: number of the part of a reference that was seen without a hole, as where a body left a
    motion capture's room. Between two parts its path is not known, and so neither are errors per metre or frame.
    """
    steps = np.diff(reference.stamp_ns)
    if not len(steps):
        return np.zeros(len(stamp_ns), np.int64)
    middles = reference.stamp_ns[:-1] + steps // 2
    holes = middles[steps > max(MIN_HOLE_NS, HOLE_STEPS * float(np.median(steps)))]
    return np.searchsorted(holes, stamp_ns, side="right")


def _remedy(estimate: Trajectory, reference: Trajectory) -> str:
    """What to do where the stamps of one were counted from 0, or where the reference is too slow to be interpolated."""
    counted, true = sorted((int(estimate.stamp_ns[0]), int(reference.stamp_ns[0])))
    if counted < A_DAY_NS <= true:
        return ": name the images by their stamps, or put a times.txt with their seconds beside them, and run again"
    interval_ns = float(np.median(np.diff(reference.stamp_ns))) if len(reference) > 1 else 0.0
    if interval_ns > MAX_GAP_NS:
        return f": the reference has a pose every {interval_ns / 1e9:.2g} s, --t-max-diff compares the nearest ones"
    return ""


def _nearest(stamps: I64, wanted: I64) -> I64:
    after = np.clip(np.searchsorted(stamps, wanted), 1, len(stamps) - 1) if len(stamps) > 1 else np.zeros_like(wanted)
    before = np.maximum(after - 1, 0)
    return np.where(wanted - stamps[before] <= stamps[after] - wanted, before, after)


def _span(trajectory: Trajectory) -> str:
    first, last = (int(s) for s in trajectory.stamp_ns[[0, -1]])
    return f"{first / 1e9:.3f} to {last / 1e9:.3f}"
