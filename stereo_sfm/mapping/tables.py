"""The columns of the map (mapping/map.py): keyframes, points and observations."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from stereo_sfm.mapping.columns import Columns, Spec
from stereo_sfm.types import F32, F64, I32, I64, U8, Bool


class KeyframeTable(Columns):
    """One row for each keyframe."""

    kf_id: I64
    frame_id: I64
    stamp_ns: I64
    submap_id: I64
    map_T_kf: F64  # (K, 4, 4)
    previous: I64  # row of the keyframe before it in the same submap, -1: none
    obs_first: I64  # first row of its observations, which follow each other
    obs_count: I64  # observations made, of which some may have been removed since
    carrier: I64  # of a culled keyframe: the row of the one it moves with, -1 if alive
    carrier_T_kf: F64  # (K, 4, 4)
    down: F64  # (K, 3) gravity's direction in the camera, zero: unknown
    down_sigma: F64  # radians, 0: unknown
    velocity: F64  # (K, 3) m/s in the IMU's axes
    accel_bias: F64  # (K, 3) m/s^2
    gyro_bias: F64  # (K, 3) rad/s
    alive: Bool
    named: Bool  # whether loops may still name it

    SPEC: ClassVar[Spec] = {
        "kf_id": (np.int64, (), -1),
        "frame_id": (np.int64, (), -1),
        "stamp_ns": (np.int64, (), 0),
        "submap_id": (np.int64, (), 0),
        "map_T_kf": (np.float64, (4, 4), np.eye(4)),
        "previous": (np.int64, (), -1),
        "obs_first": (np.int64, (), 0),
        "obs_count": (np.int64, (), 0),
        "carrier": (np.int64, (), -1),
        "carrier_T_kf": (np.float64, (4, 4), np.eye(4)),
        "down": (np.float64, (3,), 0.0),
        "down_sigma": (np.float64, (), 0.0),
        "velocity": (np.float64, (3,), 0.0),
        "accel_bias": (np.float64, (3,), 0.0),
        "gyro_bias": (np.float64, (3,), 0.0),
        "alive": (np.bool_, (), True),
        "named": (np.bool_, (), True),
    }


class PointTable(Columns):
    """One row for each physical point."""

    pt_id: I64  # of its track, -1: it has none
    xyz: F64  # (P, 3) map frame, NaN until it is triangulated
    anchor: I32  # keyframe row that carries the point when keyframes are corrected
    head: I32  # newest observation, -1: none
    obs_count: I32
    seen: I32  # number of keyframes that observed it
    expected: I32  # number of keyframes in whose view it was
    last_seen: I32  # newest keyframe row that observed it
    descriptor_obs: I32  # observation whose descriptor represents the point, -1: none
    sigma: F32  # px, noise of its next observation
    fused_into: I32  # row of the point that replaced it, -1: none
    alive: Bool

    SPEC: ClassVar[Spec] = {
        "pt_id": (np.int64, (), -1),
        "xyz": (np.float64, (3,), np.nan),
        "anchor": (np.int32, (), -1),
        "head": (np.int32, (), -1),
        "obs_count": (np.int32, (), 0),
        "seen": (np.int32, (), 0),
        "expected": (np.int32, (), 0),
        "last_seen": (np.int32, (), -1),
        "descriptor_obs": (np.int32, (), -1),
        "sigma": (np.float32, (), 1.0),
        "fused_into": (np.int32, (), -1),
        "alive": (np.bool_, (), True),
    }


class ObservationTable(Columns):
    """One row for each observation of a point in a keyframe."""

    kf: I32  # keyframe row
    pt: I32  # point row, -1 when the observation was removed
    uv_left: F32  # (M, 2) px
    uv_right: F32  # (M, 2) px, NaN where unseen
    sigma: F32  # (M,) px, noise of one coordinate
    descriptor: U8  # (M, 32), zero where there is none
    following: I32  # next older observation of the same point, -1: last

    SPEC: ClassVar[Spec] = {
        "kf": (np.int32, (), -1),
        "pt": (np.int32, (), -1),
        "uv_left": (np.float32, (2,), np.nan),
        "uv_right": (np.float32, (2,), np.nan),
        "sigma": (np.float32, (), 1.0),
        "descriptor": (np.uint8, (32,), 0),
        "following": (np.int32, (), -1),
    }
