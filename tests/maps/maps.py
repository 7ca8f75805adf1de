"""Saved maps of synthetic sequences with exact poses, for the tests of everything that reads a map."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from stereo_sfm.geometry import se3
from stereo_sfm.mapping.map import Map
from stereo_sfm.maps.cameras import MapCamera
from stereo_sfm.maps.saved_map import SavedMap
from tests.loop.store_sequence import StoreSequence, make_sequence


def map_of_sequence(sequence: StoreSequence, vocabulary_id: str = "") -> SavedMap:
    """Every keyframe at its true pose relative to the first; points where their first keyframe observed them."""
    map_ = Map()
    for k, pose in zip(sequence.keyframes, se3.inverse(sequence.world_T_kf[0]) @ sequence.world_T_kf, strict=True):
        row = map_.add_keyframe(k, pose)
        new = map_.point_rows(k.point_ids) < 0
        map_.add_points(k.point_ids[new], se3.transform(pose, k.points_cam[new]), row)
        map_.observe(row, map_.point_rows(k.point_ids), k.uv_left, k.uv_right, k.descriptors)
    snapshot = map_.snapshot()
    return SavedMap.of_session(snapshot, MapCamera(sequence.rig), vocabulary_id)


def small_map(seed: int = 0, noise_px: float = 0.2) -> tuple[StoreSequence, SavedMap]:
    """One aisle."""
    sequence = make_sequence([0], seed=seed, noise_px=noise_px)
    return sequence, map_of_sequence(sequence)


def same(a: Any, b: Any) -> bool:
    """Whether two dataclasses of arrays have the same bits."""
    return all(
        np.array_equal(x, y, equal_nan=x.dtype.kind == "f") if isinstance(x, np.ndarray) else x == y
        for x, y in ((getattr(a, f.name), getattr(b, f.name)) for f in dataclasses.fields(a))
    )
