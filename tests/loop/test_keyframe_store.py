"""Covisibility of keyframes against plain sets."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from stereo_sfm.geometry import se3
from stereo_sfm.loop.keyframe_store import KeyframeStore
from stereo_sfm.types import I64, Keyframe


def keyframe(kf_id: int, point_ids: I64) -> Keyframe:
    n = len(point_ids)
    return Keyframe(
        kf_id, kf_id, kf_id, se3.exp(np.zeros(6)), point_ids, np.zeros((n, 2)), np.zeros((n, 2)), np.ones((n, 3)),
        np.zeros((n, 32), np.uint8),
    )  # fmt: skip


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_shared_points_agree_with_plain_sets(seed: int) -> None:
    rng = np.random.default_rng(seed)
    store, name, seen = KeyframeStore(), {}, {}
    for kf_id in range(60):
        ids = np.unique(rng.integers(0, 40 + 3 * kf_id, 12))
        store.add(keyframe(kf_id, ids))
        seen[kf_id] = ids.tolist()
        if rng.random() < 0.4 and len(seen) > 3:
            gone = int(rng.choice(sorted(seen)[:-1]))
            store.remove(gone)
            del seen[gone]
        if rng.random() < 0.3:
            pairs = rng.integers(0, 40 + 3 * kf_id, (3, 2))
            store.merge(pairs)
            for a, b in pairs.tolist():
                keep, drop = name.get(a, a), name.get(b, b)
                name = {k: keep if v == drop else v for k, v in (name | {drop: drop, keep: keep}).items()}
    assert store.ids == sorted(seen)

    def points(ids: list[int]) -> set[int]:
        return {name.get(i, i) for i in ids}

    for kf_id, ids in seen.items():
        shared = {k: len(points(ids) & points(other)) for k, other in seen.items()}
        assert store.connected(np.array(ids), 2) == sorted(k for k, n in shared.items() if n >= 2)
        del shared[kf_id]
        best = sorted((k for k, n in shared.items() if n), key=lambda k: (-shared[k], k))
        assert store.best_connected(kf_id, 4) == best[:4]


def test_removed_keyframes_take_no_memory() -> None:
    """Nor do high ids, of keyframes after years."""
    store, first = KeyframeStore(), 10**9
    for k in range(400):
        store.add(keyframe(first + k, np.arange(50 * k, 50 * k + 100)))
        if k >= 10:
            store.remove(first + k - 10)
    assert len(store._sightings) < 8000 and len(store._points.ids) < 4000  # of 20,050 ids
    assert store.connected(np.arange(50 * 395, 50 * 395 + 100), 1) == [first + 394, first + 395, first + 396]
