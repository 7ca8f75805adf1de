"""Errors of an estimated trajectory against a reference of equal stamps, both world_T_cam0, (N, 4, 4).

Absolute and relative pose errors: Sturm et al., IROS 2012. Drift over segments: the KITTI odometry development kit
(Geiger et al., CVPR 2012). The retail paper's errors: its equations 23 and 24.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereo_sfm.geometry import se3
from stereo_sfm.types import F64, I64

KITTI_LENGTHS = tuple(100.0 * i for i in range(1, 9))  # metres
SHORTEST_PATH = 0.5  # metres; below it drift over a distance is meaningless
KITTI_STEP = 10  # a segment starts at every tenth frame


@dataclass(frozen=True)
class Statistics:
    """Of one kind of error over a trajectory."""

    rmse: float
    mean: float
    median: float
    std: float
    min: float
    max: float
    count: int

    @staticmethod
    def of(errors: F64) -> Statistics:
        """Of (N,) errors; NaN where there are none."""
        if not len(errors):
            nan = float("nan")
            return Statistics(nan, nan, nan, nan, nan, nan, 0)
        return Statistics(
            float(np.sqrt(np.mean(errors**2))),
            float(errors.mean()),
            float(np.median(errors)),
            float(errors.std()),
            float(errors.min()),
            float(errors.max()),
            len(errors),
        )


def rotation_angle(rotation: F64) -> F64:
    """(..., 3, 3) -> angle in radians, in [0, pi]; accurate also where acos of the trace is not."""
    return np.linalg.norm(se3.so3_log(rotation), axis=-1)


def absolute_errors(estimate: F64, reference: F64) -> tuple[F64, F64]:
    """(N,) metres and (N,) radians of reference^-1 estimate, after alignment."""
    error = se3.inverse(reference) @ estimate
    return np.linalg.norm(error[:, :3, 3], axis=1), rotation_angle(error[:, :3, :3])


def relative_errors(estimate: F64, reference: F64, pairs: I64) -> tuple[F64, F64]:
    """(M,) metres and (M,) radians of the motion over each pair (M, 2) of indices."""
    i, j = pairs[:, 0], pairs[:, 1]
    motion_reference = se3.inverse(reference[i]) @ reference[j]
    motion_estimate = se3.inverse(estimate[i]) @ estimate[j]
    error = se3.inverse(motion_reference) @ motion_estimate
    return np.linalg.norm(error[:, :3, 3], axis=1), rotation_angle(error[:, :3, :3])


def pairs_by_frames(count: int, delta: int) -> I64:
    """(M, 2) overlapping pairs `delta` frames apart."""
    start = np.arange(max(count - delta, 0), dtype=np.int64)
    return np.stack([start, start + delta], 1)


def pairs_by_metres(reference: F64, delta_m: float, starts: I64 | None = None) -> I64:
    """(M, 2): from each start the first pose whose distance along the reference is more than `delta_m` further."""
    along = path_lengths(reference)
    start = np.arange(len(along), dtype=np.int64) if starts is None else starts
    end = np.searchsorted(along, along[start] + delta_m, side="right")
    inside = end < len(along)
    return np.stack([start[inside], end[inside]], 1)


def within(pairs: I64, parts: I64 | None) -> I64:
    """The pairs (M, 2) of two poses in one of `parts` (N,), the number of each pose's; None: all are in one."""
    return pairs if parts is None else pairs[parts[pairs[:, 0]] == parts[pairs[:, 1]]]


def path_lengths(poses: F64) -> F64:
    """(N,) metres along the path up to each pose."""
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def seen_length(poses: F64, parts: I64 | None = None) -> float:
    """Metres of the path (N, 4, 4) within `parts`, as of `within`."""
    pairs = within(pairs_by_frames(len(poses), 1), parts)
    return float(np.linalg.norm(poses[pairs[:, 1], :3, 3] - poses[pairs[:, 0], :3, 3], axis=1).sum())


@dataclass(frozen=True)
class Drift:
    """Mean end error of segments, per metre of segment."""

    translation_percent: float
    rotation_deg_per_m: float
    segments: int
    lengths_m: tuple[float, ...]  # of the segments
    standard: bool  # the benchmark's own lengths, 100 to 800 m


def kitti_drift(estimate: F64, reference: F64, parts: I64 | None = None) -> Drift | None:
    """KITTI's drift; None for a path too short for any segment. `parts` as of `within`.

    Segments of 100, 200 .. 800 m start at every tenth frame. A path below 100 m takes 1 to 8 times the largest power of
    ten metres of which it holds at least two (10, 20 .. 80 m for 92 m; 1 and 2 m for 2.7 m): comparable among systems
    on that path, not with the benchmark's numbers.
    """
    length = seen_length(reference, parts)
    if length < SHORTEST_PATH:
        return None
    lengths = KITTI_LENGTHS
    if length < KITTI_LENGTHS[0]:
        unit = 10.0 ** np.floor(np.log10(length / 2))
        lengths = tuple(float(unit * i) for i in range(1, 9))
    starts = np.arange(0, len(reference), KITTI_STEP, dtype=np.int64)
    translation: list[F64] = []
    rotation: list[F64] = []
    used: list[float] = []
    for segment in lengths:
        pairs = within(pairs_by_metres(reference, segment, starts), parts)
        metres, radians = relative_errors(estimate, reference, pairs)
        if len(metres):
            translation.append(metres / segment)
            rotation.append(radians / segment)
            used.append(segment)
    if not used:
        return None
    per_metre, angle_per_metre = np.concatenate(translation), np.concatenate(rotation)
    return Drift(
        100 * float(per_metre.mean()),
        float(np.degrees(angle_per_metre.mean())),
        len(per_metre),
        tuple(used),
        lengths == KITTI_LENGTHS,
    )


@dataclass(frozen=True)
class RetailErrors:
    """Equations 23 and 24 of the retail paper.

    e_R = acos((trace(R^-1 R_GT) - 1) / 2) in radians; e_t = |t - t_GT|^2, a squared norm and so in square metres.
    Relative errors are of the motion between consecutive frames. The absolute error is that of the last pose, where
    both trajectories start at the same first pose.
    """

    relative_rotation_rad_mean: float
    relative_rotation_rad_std: float
    relative_translation_m2_mean: float
    relative_translation_m2_std: float
    absolute_rotation_rad: float
    absolute_translation_m2: float


def retail_errors(estimate: F64, reference: F64, parts: I64 | None = None) -> RetailErrors | None:
    """The retail paper's errors; None for fewer than two poses. `parts` as of `within`."""
    i, j = within(pairs_by_frames(len(estimate), 1), parts).T
    if not len(i):
        return None
    motion_estimate = se3.inverse(estimate[i]) @ estimate[j]
    motion_reference = se3.inverse(reference[i]) @ reference[j]
    rotation = _equation_23(motion_estimate, motion_reference)
    translation = _equation_24(motion_estimate, motion_reference)
    last_estimate = se3.inverse(estimate[0]) @ estimate[-1]
    last_reference = se3.inverse(reference[0]) @ reference[-1]
    return RetailErrors(
        float(rotation.mean()),
        float(rotation.std()),
        float(translation.mean()),
        float(translation.std()),
        float(_equation_23(last_estimate, last_reference)),
        float(_equation_24(last_estimate, last_reference)),
    )


def _equation_23(a: F64, b: F64) -> F64:
    return rotation_angle(np.swapaxes(a[..., :3, :3], -1, -2) @ b[..., :3, :3])


def _equation_24(a: F64, b: F64) -> F64:
    return ((a[..., :3, 3] - b[..., :3, 3]) ** 2).sum(-1)
