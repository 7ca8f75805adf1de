"""Scenes with exact truth for tests and benchmarks: cameras on a path along shelves, stereo observations with noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.rig import Rig
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import KannalaBrandt, Pinhole
from stereo_sfm.types import F64, I64, Bool


def pinhole_rig(baseline: float = 0.1) -> Rig:
    """Rectified 640x480 pair."""
    cam = Pinhole(640, 480, 400.0, 400.0, 319.5, 239.5)
    return Rig(cam, cam, se3.from_rotation_translation(np.eye(3), np.array([baseline, 0, 0])))


def fisheye_rig() -> Rig:
    """Pair like a T265's: 848x800, 165 degrees, 64 mm, eyes slightly turned against each other."""
    left = KannalaBrandt(848, 800, 285.0, 286.0, 424.0, 400.0, (-0.004, 0.038, -0.036, 0.006))
    right = KannalaBrandt(848, 800, 285.5, 285.2, 420.0, 402.0, (-0.005, 0.040, -0.037, 0.006))
    return Rig(left, right, se3.exp(np.array([0.064, 0.0003, -0.0002, 0.002, -0.004, 0.001])))


@dataclass(frozen=True, eq=False)
class Scene:
    """Truth and what was seen."""

    rig: Rig
    world_T_kf: F64  # (K, 4, 4)
    points: F64  # (P, 3)
    obs_kf: I64  # (M,)
    obs_pt: I64  # (M,)
    uv_left: F64  # (M, 2)
    uv_right: F64  # (M, 2)
    outlier: Bool  # (M,)


def walk(count: int, step: float = 0.25, yaw_per_step: float = 0.02) -> F64:
    """(K, 4, 4) world_T_cam of somebody who walks forward (world z) and slowly turns, with some sway."""
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
    right = rig.right.project(se3.transform(se3.inverse(rig.left_T_right), cam))
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
    """Random shelves along a walk; at most `max_obs` observations, chosen at random; right eyes drop out at times."""
    rng = np.random.default_rng(seed)
    world_T_kf = walk(keyframes) if poses is None else poses
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
