"""Keyframes of a simulated sequence without rendering every frame of it.

Images are rendered at distances of STEP_METRES; corners, stereo points and descriptors come from the tracker's own
code; a point keeps its id from one keyframe to the next when descriptor and true motion agree; odometry is the truth
with a drift that is a few times worse than the tracker's. So a hundred metres cost seconds per keyframe, not minutes.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.drivers.sim.source import SimSource
from stereo_sfm.drivers.source import open_source
from stereo_sfm.geometry import se3
from stereo_sfm.loop.cloud import gather, match_guided
from stereo_sfm.loop.place_view import place_view_of
from stereo_sfm.maps.single_image import still_keyframe
from stereo_sfm.types import F64, I64, Keyframe

STEP_METRES, STEP_DEGREES = 0.4, 15.0  # between keyframes
DRIFT_PER_METRE, TURN_PER_METRE = 0.005, 0.0005  # random part of a step, and radians of constant curl per metre


@dataclass(frozen=True, eq=False)
class SparseSequence:
    """Keyframes with drifting odometry, and their true poses."""

    rig: Rig
    keyframes: list[Keyframe]
    world_T_kf: F64  # (K, 4, 4)


def keyframe_rows(poses: F64) -> I64:
    """Frames that become keyframes: by distance or rotation since the last one."""
    rows = [0]
    for k in range(1, len(poses)):
        step = se3.inverse(poses[rows[-1]]) @ poses[k]
        turned = np.rad2deg(np.linalg.norm(se3.log(step)[3:]))
        if np.linalg.norm(step[:3, 3]) >= STEP_METRES or turned >= STEP_DEGREES:
            rows.append(k)
    return np.array(rows)


def drifted(world_T_kf: F64, seed: int) -> F64:
    """(K, 4, 4) odometry: the true steps, each with an error that grows with its length."""
    rng = np.random.default_rng([seed, 17])
    steps = se3.inverse(world_T_kf[:-1]) @ world_T_kf[1:]
    length = np.linalg.norm(steps[:, :3, 3], axis=1)[:, None]
    error = rng.normal(0, 1, (len(steps), 6)) * ([DRIFT_PER_METRE] * 3 + [TURN_PER_METRE] * 3) * np.sqrt(length)
    error[:, 4] += rng.choice([-1, 1]) * TURN_PER_METRE * length[:, 0]
    poses = [np.eye(4)]
    for step, xi in zip(steps, error, strict=True):
        poses.append(poses[-1] @ step @ se3.exp(xi))
    return se3.orthonormalize(np.array(poses))


def sequence_keyframes(spec: str) -> SparseSequence:
    """Render and describe the keyframes of `sim:...`."""
    source = open_source(spec)
    assert isinstance(source, SimSource) and source.ground_truth is not None
    rows = keyframe_rows(source.ground_truth.poses)
    world_T_kf = source.ground_truth.poses[rows]
    odom = drifted(world_T_kf, source.options.seed + 1000 * source.options.walk)
    keyframes = list(_described(source, source.frame_ids[rows], world_T_kf, odom))
    return SparseSequence(source.rig, keyframes, world_T_kf)


def _described(source: SimSource, frame_ids: I64, world_T_kf: F64, odom: F64) -> Iterator[Keyframe]:
    previous: Keyframe | None = None
    next_id = 0
    for k, frame_id in enumerate(frame_ids.tolist()):
        still = still_keyframe(source.frame(frame_id), source.rig, max_features=400)
        if still is None:
            continue
        ids = next_id + np.arange(len(still.point_ids))
        next_id += len(ids)
        if previous is not None:
            kf_T_previous = se3.inverse(world_T_kf[k]) @ world_T_kf[previous.kf_id]
            _continue_ids(ids, kf_T_previous, previous, still, source.rig)
        previous = dataclasses.replace(still, kf_id=k, frame_id=frame_id, odom_T_cam=odom[k], point_ids=ids)
        yield previous


def _continue_ids(ids: I64, kf_T_previous: F64, previous: Keyframe, still: Keyframe, rig: Rig) -> None:
    """Give points that the previous keyframe observed their ids."""
    cloud, view = gather(previous, [], rig, 0.3), place_view_of(still, rig, 0.3)
    rows_b, rows_a = match_guided(kf_T_previous, view, cloud, rig, 50, radius=4.0)
    points = ~view.corner[rows_b]
    ids[np.searchsorted(still.point_ids, view.ids[rows_b[points]])] = cloud.ids[rows_a[points]]
