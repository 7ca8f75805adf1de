"""The columns of the map (mapping/map.py): keyframes, points and observations."""

from __future__ import annotations

import numpy as np

from stereo_sfm.mapping.columns import Columns, column
from stereo_sfm.types import F32, F64, I32, I64, U8, Bool


class KeyframeTable(Columns):
    """One row for each keyframe."""

    kf_id: I64 = column(np.int64, -1)
    frame_id: I64 = column(np.int64, -1)
    stamp_ns: I64 = column(np.int64, 0)
    submap_id: I64 = column(np.int64, 0)
    map_T_kf: F64 = column(np.float64, np.eye(4), (4, 4))  # (K, 4, 4)
    previous: I64 = column(np.int64, -1)  # row of the keyframe before it in the same submap, -1: none
    obs_first: I64 = column(np.int64, 0)  # first row of its observations, which follow each other
    obs_count: I64 = column(np.int64, 0)  # observations made, of which some may have been removed since
    reference: I64 = column(np.int64, -1)  # of a culled keyframe: the row of the one it moves with, -1 if alive
    reference_T_kf: F64 = column(np.float64, np.eye(4), (4, 4))  # (K, 4, 4)
    down: F64 = column(np.float64, 0.0, (3,))  # (K, 3) gravity's direction in the camera, zero: unknown
    down_sigma: F64 = column(np.float64, 0.0)  # radians, 0: unknown
    state: F64 = column(np.float64, 0.0, (9,))  # (K, 9) m/s in the IMU's axes, biases: m/s^2 and rad/s
    doubt: F64 = column(np.float64, 0.0, (2,))  # (K, 2) m^2, rad^2, of the odometry since the first keyframe
    alive: Bool = column(np.bool_, True)
    named: Bool = column(np.bool_, True)  # whether loops may still name it


class PointTable(Columns):
    """One row for each physical point."""

    pt_id: I64 = column(np.int64, -1)  # of its track, -1: it has none
    xyz: F64 = column(np.float64, np.nan, (3,))  # (P, 3) map frame, NaN until it is triangulated
    anchor: I32 = column(np.int32, -1)  # keyframe row that carries the point when keyframes are corrected
    head: I32 = column(np.int32, -1)  # newest observation, -1: none
    obs_count: I32 = column(np.int32, 0)
    seen: I32 = column(np.int32, 0)  # number of keyframes that observed it
    expected: I32 = column(np.int32, 0)  # number of keyframes in whose view it was
    last_seen: I32 = column(np.int32, -1)  # newest keyframe row that observed it
    descriptor_obs: I32 = column(np.int32, -1)  # observation whose descriptor represents the point, -1: none
    sigma: F32 = column(np.float32, 1.0)  # px, noise of its next observation
    fused_into: I32 = column(np.int32, -1)  # row of the point that replaced it, -1: none
    alive: Bool = column(np.bool_, True)


class ObservationTable(Columns):
    """One row for each observation of a point in a keyframe."""

    kf: I32 = column(np.int32, -1)  # keyframe row
    pt: I32 = column(np.int32, -1)  # point row, -1 when the observation was removed
    uv_left: F32 = column(np.float32, np.nan, (2,))  # (M, 2) px
    uv_right: F32 = column(np.float32, np.nan, (2,))  # (M, 2) px, NaN where unseen
    sigma: F32 = column(np.float32, 1.0)  # (M,) px, noise of one coordinate
    descriptor: U8 = column(np.uint8, 0, (32,))  # (M, 32), zero where there is none
    following: I32 = column(np.int32, -1)  # next older observation of the same point, -1: last
