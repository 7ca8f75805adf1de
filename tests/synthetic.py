"""Scenes with exact truth for tests and benchmarks: cameras on a path along shelves, stereo observations with noise."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import KannalaBrandt, Pinhole
from stereo_sfm.types import F64, I64, Bool, Keyframe


def pinhole_rig(baseline: float = 0.1) -> Rig:
    """Rectified 640x480 pair."""
    cam = Pinhole(640, 480, 400.0, 400.0, 319.5, 239.5)
    return Rig(cam, cam, se3.from_rotation_translation(np.eye(3), np.array([baseline, 0, 0])))


def fisheye_rig() -> Rig:
    """Pair like a T265's: 848x800, 165 degrees, 64 mm, cameras slightly turned against each other."""
    left = KannalaBrandt(848, 800, 285.0, 286.0, 424.0, 400.0, (-0.004, 0.038, -0.036, 0.006))
    right = KannalaBrandt(848, 800, 285.5, 285.2, 420.0, 402.0, (-0.005, 0.040, -0.037, 0.006))
    return Rig(left, right, se3.exp(np.array([0.064, 0.0003, -0.0002, 0.002, -0.004, 0.001])))


@dataclass(frozen=True, eq=False)
class Scene:
    """Ground truth and observations."""

    rig: Rig
    world_T_kf: F64  # (K, 4, 4)
    points: F64  # (P, 3)
    obs_kf: I64  # (M,)
    obs_pt: I64  # (M,)
    uv_left: F64  # (M, 2)
    uv_right: F64  # (M, 2)
    outlier: Bool  # (M,)


def turned(rig: Rig, degrees: tuple[float, float, float]) -> Rig:
    """The right camera rotated about its own axes."""
    return replace(rig, left_T_right=rig.left_T_right @ se3.exp(np.array([0, 0, 0, *np.deg2rad(degrees)])))


def camera_path(count: int, step: float = 0.25, yaw_per_step: float = 0.02) -> F64:
    """(K, 4, 4) world_T_cam of a camera that moves forward (world z) and slowly turns, with some sway."""
    pose, out = np.eye(4), []
    for k in range(count):
        out.append(
            pose @ se3.exp(np.array([0, 0.02 * np.sin(k), 0, 0.02 * np.cos(0.7 * k), 0, 0.02 * np.sin(0.9 * k)]))
        )
        pose = pose @ se3.exp(np.array([0, 0, step, 0, yaw_per_step, 0]))
    return np.array(out)


def points_around(world_T_kf: F64, count: int, rng: np.random.Generator, width: float = 2.5) -> F64:
    """(count, 3) points on shelves left and right of a path, a little ahead of it."""
    near = world_T_kf[rng.integers(0, len(world_T_kf), count)]
    side = np.where(rng.random(count) < 0.5, -1.0, 1.0) * rng.uniform(0.6, 1.0, count) * width
    local = np.stack([side, rng.uniform(-1.5, 1.0, count), rng.uniform(1.0, 6.0, count)], 1)
    return (near[:, :3, :3] @ local[..., None])[..., 0] + near[:, :3, 3]


def see(rig: Rig, world_T_cam: F64, points: F64, max_depth: float = 10.0) -> tuple[Bool, F64, F64]:
    """Which of (P, 3) world points one camera pose sees, and where: (P,), (P, 2), (P, 2) px, right NaN where unseen."""
    cam = se3.transform(se3.inverse(world_T_cam), points)
    assert rig.right is not None
    left = rig.left.project(cam)
    right = rig.project_right(cam)
    seen = rig.left.inside(left, 5) & (np.linalg.norm(cam, axis=1) < max_depth)
    right[~rig.right.inside(right, 5)] = np.nan
    return seen, left, right


def make_scene(
    rig: Rig,
    keyframes: int = 12,
    points: int = 1500,
    max_obs: int | None = None,
    noise_px: float = 0.5,
    outliers: float = 0.0,
    seed: int = 0,
    poses: F64 | None = None,
) -> Scene:
    """Random points of shelves along a path; at most `max_obs` random observations, some without the right camera."""
    rng = np.random.default_rng(seed)
    world_T_kf = camera_path(keyframes) if poses is None else poses
    xyz = points_around(world_T_kf, points, rng)
    kf, pt, left, right = [], [], [], []
    for k, pose in enumerate(world_T_kf):
        seen, uv_l, uv_r = see(rig, pose, xyz)
        rows = np.flatnonzero(seen)
        kf.append(np.full(len(rows), k))
        pt.append(rows)
        left.append(uv_l[rows])
        right.append(uv_r[rows])
    obs_kf, obs_pt = np.concatenate(kf), np.concatenate(pt)
    uv_left, uv_right = np.concatenate(left), np.concatenate(right)
    if max_obs is not None and len(obs_kf) > max_obs:
        keep = np.sort(rng.choice(len(obs_kf), max_obs, replace=False))
        obs_kf, obs_pt, uv_left, uv_right = obs_kf[keep], obs_pt[keep], uv_left[keep], uv_right[keep]
    uv_left = uv_left + rng.normal(0, noise_px, uv_left.shape)
    uv_right = uv_right + rng.normal(0, noise_px, uv_right.shape)
    uv_right[rng.random(len(uv_right)) < 0.05] = np.nan
    outlier = rng.random(len(obs_kf)) < outliers
    uv_left[outlier] += rng.uniform(-60, 60, (int(outlier.sum()), 2)) + 8
    return Scene(rig, world_T_kf, xyz, obs_kf, obs_pt, uv_left, uv_right, outlier)


def disturb(scene: Scene, pose_sigma: float, point_sigma: float, seed: int = 1) -> tuple[F64, F64]:
    """Poses (all but the first) and points with noise: a start for an optimisation."""
    rng = np.random.default_rng(seed)
    xi = rng.normal(0, pose_sigma, (len(scene.world_T_kf), 6))
    xi[:, 3:] *= 0.5
    xi[0] = 0
    return scene.world_T_kf @ se3.exp(xi), scene.points + rng.normal(0, point_sigma, scene.points.shape)


@dataclass(frozen=True, eq=False)
class KeyframeStream:
    """Keyframes as a tracker with drift would make them, and the truth behind them."""

    rig: Rig
    keyframes: list[Keyframe]
    world_T_kf: F64  # (K, 4, 4)
    points: F64  # (P, 3)
    truth_of_id: I64  # (ids,) row of `points` behind each track id


def keyframe_stream(
    rig: Rig,
    world_T_kf: F64,
    points: int = 3000,
    noise_px: float = 0.3,
    outliers: float = 0.0,
    drift: tuple[float, float] = (0.002, 0.0005),
    track_length: int = 6,
    per_keyframe: int = 150,
    broken_at: int = -1,
    seed: int = 0,
) -> KeyframeStream:
    """Keyframes of a sequence with interrupted tracks.

    A point that stays in view is tracked for at most `track_length` keyframes and comes back later under a new id with
    the descriptor it had, a few bits changed; every new track sits up to half a pixel beside the point.

    Args:
        drift: metres and radians of random error from one keyframe to the next.
        broken_at: a keyframe before which every track ends.
    """
    rng = np.random.default_rng(seed)
    xyz = points_around(world_T_kf, points, rng)
    looks = rng.integers(0, 256, (points, 32), dtype=np.uint8)
    odometry, next_id = [world_T_kf[0]], 0
    track: dict[int, tuple[int, int, F64]] = {}  # point -> id, age, offset px
    rest: dict[int, int] = {}  # point -> keyframe until which no corner is found there again
    truth_of_id: list[int] = []
    keyframes: list[Keyframe] = []
    for k, pose in enumerate(world_T_kf):
        if k:
            error = rng.normal(0, 1, 6) * np.repeat(drift, 3)
            odometry.append(odometry[-1] @ se3.inverse(world_T_kf[k - 1]) @ pose @ se3.exp(error))
        seen, left, right = see(rig, pose, xyz)
        seen &= np.isfinite(right[:, 0])
        ended = [p for p, t in track.items() if not seen[p] or t[1] >= track_length or k == broken_at]
        for p in ended:
            del track[p]
            rest[p] = k - 1 if k == broken_at else k + 1
        fresh = [p for p in np.flatnonzero(seen).tolist() if p not in track and rest.get(p, -1) < k]
        for p in rng.permutation(fresh)[: max(per_keyframe - len(track), 0)].tolist():
            age = 0 if k else int(rng.integers(track_length))  # so that tracks do not all end together
            track[p] = (next_id, age, rng.uniform(-0.5, 0.5, 2))
            truth_of_id.append(p)
            next_id += 1
        rows = np.array(sorted(track), np.int64)
        ids = np.array([track[p][0] for p in rows.tolist()], np.int64)
        offset = np.array([track[p][2] for p in rows.tolist()]).reshape(-1, 2)
        track = {p: (i, age + 1, o) for p, (i, age, o) in track.items()}
        uv_left = left[rows] + offset + rng.normal(0, noise_px, (len(rows), 2))
        uv_right = right[rows] + offset + rng.normal(0, noise_px, (len(rows), 2))
        wild = rng.random(len(rows)) < outliers
        uv_left[wild] += rng.choice([-1.0, 1.0], (int(wild.sum()), 2)) * rng.uniform(5, 30, (int(wild.sum()), 2))
        keyframes.append(
            Keyframe(
                kf_id=k,
                frame_id=5 * k,
                stamp_ns=k * 10**8,
                odom_T_cam=odometry[-1],
                point_ids=ids,
                uv_left=uv_left,
                uv_right=uv_right,
                points_cam=_stereo_points(rig, uv_left, uv_right),
                descriptors=looks[rows] ^ _few_bits(rng, len(rows)),
            )
        )
    return KeyframeStream(rig, keyframes, world_T_kf, xyz, np.array(truth_of_id, np.int64))


def _few_bits(rng: np.random.Generator, count: int) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    """(N, 32) masks with about ten bits set."""
    return np.packbits(rng.random((count, 256)) < 0.04, axis=1)


def _stereo_points(rig: Rig, uv_left: F64, uv_right: F64) -> F64:
    """(N, 3) midpoints of the two rays, left camera."""
    assert rig.right is not None
    a = rig.left.unproject(uv_left)
    b = rig.right.unproject(uv_right) @ rig.left_T_right[:3, :3].T
    t = rig.left_T_right[:3, 3]
    ab, at, bt = (a * b).sum(1), a @ t, b @ t
    along = (at - ab * bt) / np.maximum(1 - ab * ab, 1e-12)
    return a * np.clip(along, 0.2, 50.0)[:, None]
