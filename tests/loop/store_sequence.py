"""Synthetic keyframes of a sequence around shelves with exact truth: descriptors with bit errors, new point ids for
points that return into view, corners of which half is found again, drifting odometry, and aisles that may be copies."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.geometry import se3
from stereo_sfm.types import F32, F64, I64, U8, Corners, Keyframe
from tests.synthetic import fisheye_rig, see

SHELF_Z = 10.0  # metres along an aisle
CORNERS = 300  # of a keyframe


@dataclass(frozen=True, eq=False)
class StoreSequence:
    """Keyframes as from a tracker, and their ground truth."""

    rig: Rig
    keyframes: list[Keyframe]
    world_T_kf: F64  # (K, 4, 4)
    physical: dict[int, int]  # point id -> index of the physical point

    def first(self, count: int) -> StoreSequence:
        """The first `count` keyframes."""
        return dataclasses.replace(self, keyframes=self.keyframes[:count], world_T_kf=self.world_T_kf[:count])


def shelf_points(aisles: int, alike: float, rng: np.random.Generator, per_aisle: int = 1200) -> tuple[F64, U8]:
    """(P, 3) points on both sides of parallel aisles 3 m apart, and (P, 32) their descriptors.

    `alike`: share of the points of the other aisles that are copies of those in the first aisle.
    """
    points, descriptors = [], []
    for aisle in range(aisles):
        if aisle == 0 or not alike:
            local = np.stack(
                [
                    np.where(rng.random(per_aisle) < 0.5, -1.0, 1.0) * rng.uniform(0.9, 1.2, per_aisle),
                    rng.uniform(-1.2, 1.2, per_aisle),
                    rng.uniform(0.0, SHELF_Z, per_aisle),
                ],
                1,
            )
            descriptor = rng.integers(0, 256, (per_aisle, 32), dtype=np.uint8)
        points.append(local + np.array([3.0 * aisle, 0, 0]))
        descriptors.append(descriptor.copy())
        if aisle and 0 < alike < 1:
            other = rng.random(per_aisle) >= alike
            descriptors[-1][other] = rng.integers(0, 256, (int(other.sum()), 32), dtype=np.uint8)
    return np.concatenate(points), np.concatenate(descriptors)


def aisle_sequence(aisles: list[int], step: float = 0.3) -> F64:
    """(K, 4, 4) world_T_cam along +z through one aisle after the other; between aisles the camera turns in place and
    moves outside the shelves to the start of the next aisle."""
    poses = []
    for previous, aisle in zip([None, *aisles], aisles, strict=False):
        if previous is not None:
            back = np.arange(SHELF_Z - 1, -2, -2 * step)
            x = np.linspace(3.0 * previous, 3.0 * aisle, len(back)) + 30.0 * np.sin(np.linspace(0, np.pi, len(back)))
            poses += [_pose(px, z, np.pi) for px, z in zip(x, back, strict=True)]
        poses += [_pose(3.0 * aisle, z, 0.0) for z in np.arange(-1.5, SHELF_Z - 1.5, step)]
    return np.array(poses)


def _pose(x: float, z: float, yaw: float) -> F64:
    return se3.from_rotation_translation(se3.so3_exp(np.array([0, yaw, 0.0])), np.array([x, 0.02 * np.sin(3 * z), z]))


def drift(world_T_kf: F64, rng: np.random.Generator, per_metre: float, turn_per_metre: float) -> F64:
    """Odometry poses whose steps err by a random walk and a constant curl."""
    steps = se3.inverse(world_T_kf[:-1]) @ world_T_kf[1:]
    length = np.linalg.norm(steps[:, :3, 3], axis=1)
    noise = rng.normal(0, 1, (len(steps), 6)) * np.array([per_metre] * 3 + [turn_per_metre] * 3) * length[:, None]
    noise[:, 4] += turn_per_metre * length
    poses = [world_T_kf[0]]
    for step, error in zip(steps, noise, strict=True):
        poses.append(poses[-1] @ step @ se3.exp(error))
    return se3.orthonormalize(np.array(poses))


def make_sequence(
    aisles: list[int],
    alike: float = 0.0,
    seed: int = 0,
    flip: float = 0.06,
    noise_px: float = 0.4,
    max_points: int = 300,
    rig: Rig | None = None,
) -> StoreSequence:
    """Keyframes of a sequence through the aisles, in this order; `rig`: that of `fisheye_rig` when omitted."""
    rng, corner_rng = np.random.default_rng(seed), np.random.default_rng([seed, 1])
    rig = rig or fisheye_rig()
    points, descriptors = shelf_points(max(aisles) + 1, alike, rng)
    strength = corner_rng.random(len(points))
    world_T_kf = aisle_sequence(aisles)
    odom = drift(world_T_kf, rng, 0.004, 0.0006)
    tracks: dict[int, int] = {}  # physical point -> its id while it stays in sight
    physical: dict[int, int] = {}
    keyframes: list[Keyframe] = []
    for k, pose in enumerate(world_T_kf):
        rows = _visible(rig, pose, points, tracks, rng, max_points)
        kept = {p: tracks[p] for p in rows.tolist() if p in tracks}
        new = [p for p in rows.tolist() if p not in tracks]
        physical.update(zip(range(len(physical), len(physical) + len(new)), new, strict=True))
        tracks = kept | dict(zip(new, range(len(physical) - len(new), len(physical)), strict=True))
        ids = [tracks[p] for p in rows.tolist()]
        seen = _seen(rig, pose, points[rows], descriptors[rows], rng, flip, noise_px)
        strongest = _strongest(rig, pose, points, strength, corner_rng)
        corners = _seen(rig, pose, points[strongest], descriptors[strongest], corner_rng, flip, noise_px)
        keyframes.append(_keyframe(k, odom[k], ids, seen, corners))
    return StoreSequence(rig, keyframes, world_T_kf, physical)


def _visible(rig: Rig, pose: F64, points: F64, tracks: dict[int, int], rng: np.random.Generator, most: int) -> I64:
    """Visible rows: those already tracked, then others at random."""
    seen, _, right = see(rig, pose, points, max_depth=5.0)
    rows = np.flatnonzero(seen & np.isfinite(right[:, 0]))
    order = rng.random(len(rows)) - np.isin(rows, list(tracks))
    return np.sort(rows[np.argsort(order, kind="stable")][:most])


def _strongest(rig: Rig, pose: F64, points: F64, strength: F64, rng: np.random.Generator) -> I64:
    """Visible rows that a detector prefers: mostly the same ones from view to view."""
    seen, _, right = see(rig, pose, points, max_depth=5.0)
    rows = np.flatnonzero(seen & np.isfinite(right[:, 0]))
    return rows[np.argsort(-strength[rows] - rng.normal(0, 0.3, len(rows)), kind="stable")][:CORNERS]


def _seen(
    rig: Rig, pose: F64, points: F64, descriptors: U8, rng: np.random.Generator, flip: float, noise_px: float
) -> Corners:
    """Descriptors of points from one viewpoint."""
    _, left, right = see(rig, pose, points)
    left, right = left + rng.normal(0, noise_px, left.shape), right + rng.normal(0, noise_px, right.shape)
    cam = se3.transform(se3.inverse(pose), points)
    distance = np.linalg.norm(cam, axis=1, keepdims=True)
    cam *= 1 + rng.normal(0, noise_px, (len(cam), 1)) * distance / (rig.left.fx * rig.baseline)
    flips = np.packbits(rng.random((len(descriptors), 256)) < flip, axis=1)
    return Corners(_float32(left), _float32(right), _float32(cam), descriptors ^ flips)


def _float32(values: F64) -> F32:
    return values.astype(np.float32)


def _keyframe(k: int, odom: F64, ids: list[int], seen: Corners, corners: Corners) -> Keyframe:
    return Keyframe(
        kf_id=k,
        frame_id=5 * k,
        stamp_ns=k * 10**8,
        odom_T_cam=odom,
        point_ids=np.array(ids, np.int64),
        uv_left=seen.uv_left.astype(np.float64),
        uv_right=seen.uv_right.astype(np.float64),
        points_cam=seen.points_cam.astype(np.float64),
        descriptors=seen.descriptors,
        corners=corners,
    )
