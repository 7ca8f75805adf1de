"""The keyframes' poses put together from the mapper's updates."""

import numpy as np

from stereo_sfm.geometry import se3
from stereo_sfm.mapping.keyframe_poses import KeyframePoses
from stereo_sfm.types import F64, MapUpdate


def moved(*poses: tuple[int, F64], culled: tuple[tuple[int, int, F64], ...] = ()) -> MapUpdate:
    none = np.zeros(0, np.int64)
    return MapUpdate(
        1, 0, np.array([k for k, _ in poses], np.int64), np.array([p for _, p in poses]).reshape(-1, 4, 4), none,
        np.zeros((0, 3)), none, np.zeros((0, 2), np.int64), np.eye(4),
        culled_kf_ids=np.array([k for k, _, _ in culled], np.int64),
        carrier_kf_ids=np.array([c for _, c, _ in culled], np.int64),
        carrier_T_kf=np.array([t for _, _, t in culled]).reshape(-1, 4, 4),
    )  # fmt: skip


def pose(seed: int) -> F64:
    return se3.exp(np.random.default_rng(seed).normal(size=6))


def test_culled_keyframes_follow_through_every_carrier() -> None:
    a, b, c, d = (pose(k) for k in range(4))
    poses = KeyframePoses()
    poses.update(moved((0, a), (1, b), (2, c)))
    poses.update(moved(culled=((0, 1, se3.inverse(b) @ a),)))
    poses.update(moved(culled=((1, 2, se3.inverse(c) @ b),)))
    assert len(poses) == 3 and [k for k in range(4) if poses.lives(k)] == [2]
    poses.update(moved((2, d @ c)))
    np.testing.assert_allclose(list(poses.all().values()), [d @ a, d @ b, d @ c], atol=1e-12)
    assert list(poses.all()) == [0, 1, 2]


def test_an_unknown_carrier_leaves_out_what_it_carries() -> None:
    """As in a log whose beginning is missing."""
    poses = KeyframePoses()
    poses.add(5, pose(1))
    poses.update(moved(culled=((5, 4, np.eye(4)),)))
    poses.update(moved((6, pose(2))))
    assert list(poses.all()) == [6]
