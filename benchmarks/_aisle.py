"""Keyframes of a robot that drives the same aisles for hours, without images, as from a tracker.

A gondola in a room; the robot drives around it, or back and forth along its longer side. Every surface has points with
scores (the tracker takes the best visible ones), descriptors that change with the direction of view, and noise in
pixels. Tracks end where their points leave the view, and some earlier; re-observed points get new ids, as in a tracker.
Map updates (fused and culled points) are applied as in the real tracker.
"""

from __future__ import annotations

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.geometry import se3
from stereo_sfm.types import F64, I64, U8, Bool, Corners, Keyframe, MapUpdate

STEP_M = 0.15  # between keyframes
GONDOLA, ROOM = (2.0, 0.5), (4.0, 2.5)  # half lengths along x and y, metres
DENSITY = 200  # points a square metre
HEIGHT = -1.3, 0.9  # metres, y is down
REACH_M = 6.0
TRACKS, CORNERS = 320, 400
BROKEN = 0.08  # share of the tracks that end from one keyframe to the next
SCORE_NOISE = 0.5  # spread of the scores from image to image, relative to that of the points
NOISE_PX = 0.3
BITS = 0.05  # share of the bits of a descriptor that change from view to view
TURNED_BITS = 0.25  # and between opposite directions of view
DRIFT = 0.002, 0.0005  # metres and radians of an odometry pose


class Aisle:
    """The points of the room."""

    def __init__(self, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        sides = [_walls(rng, GONDOLA, 1.0), _walls(rng, ROOM, -1.0)]
        self.points: F64 = np.concatenate([points for points, _ in sides])
        self.normals: F64 = np.concatenate([normals for _, normals in sides])
        self.scores: F64 = rng.random(len(self.points))
        self.looks: U8 = rng.integers(0, 256, (len(self.points), 32), dtype=np.uint8)
        self.turned: U8 = np.packbits(rng.random((len(self.points), 256)) < TURNED_BITS, axis=1)

    def visible(self, world_T_cam: F64) -> Bool:
        """(P,) points that face the camera, are near enough, and not occluded by the gondola."""
        to_cam = world_T_cam[:3, 3] - self.points
        ahead = -(to_cam @ world_T_cam[:3, 2]) > 0.2
        seen = ahead & ((to_cam * self.normals).sum(1) > 0.05) & (np.linalg.norm(to_cam, axis=1) < REACH_M)
        with np.errstate(divide="ignore", invalid="ignore"):
            ends = [(s * np.array(GONDOLA) - self.points[:, (0, 2)]) / to_cam[:, (0, 2)] for s in (-0.99, 0.99)]
        enters, leaves = np.minimum(*ends).max(1), np.maximum(*ends).min(1)
        return seen & ~((enters < leaves) & (leaves > 1e-6) & (enters < 1))

    def descriptors(self, rows: I64, world_T_cam: F64, rng: np.random.Generator) -> U8:
        """(N, 32) from where the camera stands."""
        along = np.stack([-self.normals[rows, 2], self.normals[rows, 0]], 1)
        back = ((world_T_cam[(0, 2), 3] - self.points[rows][:, (0, 2)]) * along).sum(1) < 0
        noise = np.packbits(rng.random((len(rows), 256)) < BITS, axis=1)
        return self.looks[rows] ^ np.where(back[:, None], self.turned[rows], 0).astype(np.uint8) ^ noise


def _walls(rng: np.random.Generator, half: tuple[float, float], outwards: float) -> tuple[F64, F64]:
    """Points (N, 3) on the four sides of a box, and their normals."""
    points: list[F64] = []
    normals: list[F64] = []
    for axis in (0, 1):
        for sign in (-1.0, 1.0):
            count = int(DENSITY * 2 * half[1 - axis] * (HEIGHT[1] - HEIGHT[0]))
            along, height = rng.uniform(-half[1 - axis], half[1 - axis], count), rng.uniform(*HEIGHT, count)
            depth = np.full(count, sign * half[axis]) + outwards * sign * rng.uniform(0, 0.15, count)
            points.append(np.stack([depth, height, along] if axis == 0 else [along, height, depth], 1))
            normals.append(np.tile(outwards * sign * np.eye(3)[0 if axis == 0 else 2], (count, 1)))
    return np.concatenate(points), np.concatenate(normals)


def there_and_back(count: int) -> F64:
    """(K, 4, 4) world_T_cam along the gondola's longer side, back and forth, looking along it."""
    length = int(2 * GONDOLA[0] / STEP_M)
    at = np.arange(count) % (2 * length)
    x = STEP_M * np.where(at < length, at, 2 * length - at) - GONDOLA[0]
    return np.array([_pose(np.array([v, 0.0, 1.5]), 0.0) for v in x])


def round_and_round(count: int) -> F64:
    """(K, 4, 4) world_T_cam around the gondola."""
    half = np.array([3.0, 1.5])  # of the ellipse
    angle, poses = 0.0, list[F64]()
    for _ in range(count):
        velocity = half * [-np.sin(angle), np.cos(angle)]
        place = np.array([half[0] * np.cos(angle), 0.0, half[1] * np.sin(angle)])
        poses.append(_pose(place, np.arctan2(velocity[1], velocity[0])))
        angle += STEP_M / float(np.linalg.norm(velocity))
    return np.array(poses)


def _pose(position: F64, heading: float) -> F64:
    """Looking along (cos heading, 0, sin heading), y down."""
    z = np.array([np.cos(heading), 0.0, np.sin(heading)])
    y = np.array([0.0, 1.0, 0.0])
    return se3.from_rotation_translation(np.stack([np.cross(y, z), y, z], 1), position)


class SimulatedTracker:
    """Keyframes as if images had been tracked between them."""

    def __init__(self, aisle: Aisle, rig: Rig, seed: int = 0) -> None:
        self._aisle, self._rig, self._rng = aisle, rig, np.random.default_rng([seed, 1])
        self._points: I64 = np.zeros(0, np.int64)  # row of the aisle's points of each track
        self._ids: I64 = np.zeros(0, np.int64)
        self._next_id = self._next_kf = 0
        self._first_T_world: F64 | None = None

    def step(self, world_T_cam: F64) -> Keyframe:
        """The keyframe at a pose; odometry is the truth from the first pose on, disturbed."""
        if self._first_T_world is None:
            self._first_T_world = se3.inverse(world_T_cam)
        seen, left, right = self._see(world_T_cam)
        self._follow(seen)
        rng, corners = self._rng, self._best(seen, CORNERS)
        error = rng.normal(0, 1, 6) * np.repeat(DRIFT, 3) * (self._next_kf > 0)
        kf_id, rows = self._next_kf, self._points
        self._next_kf += 1
        uv_left, uv_right, points = self._measured(rows, left, right)
        c_left, c_right, c_points = self._measured(corners, left, right)
        return Keyframe(
            kf_id=kf_id,
            frame_id=8 * kf_id,
            stamp_ns=8 * kf_id * 33_333_333,
            odom_T_cam=self._first_T_world @ world_T_cam @ se3.exp(error),
            point_ids=self._ids.copy(),
            uv_left=uv_left,
            uv_right=uv_right,
            points_cam=points,
            descriptors=self._aisle.descriptors(rows, world_T_cam, rng),
            corners=Corners(
                c_left.astype(np.float32),
                c_right.astype(np.float32),
                c_points.astype(np.float32),
                self._aisle.descriptors(corners, world_T_cam, rng),
            ),
        )

    def apply(self, update: MapUpdate) -> None:
        """Tracks of fused points go on under the older id, those of culled points end."""
        renamed = dict(update.fused_point_ids.tolist())
        self._ids = np.array([renamed.get(i, i) for i in self._ids.tolist()], np.int64)
        _, first = np.unique(self._ids, return_index=True)
        once = np.isin(np.arange(len(self._ids)), first)
        self._keep(once & ~np.isin(self._ids, update.culled_point_ids))

    def _see(self, world_T_cam: F64) -> tuple[Bool, F64, F64]:
        rig = self._rig
        assert rig.right is not None
        local = se3.transform(se3.inverse(world_T_cam), self._aisle.points)
        left, right = rig.left.project(local), rig.project_right(local)
        return self._aisle.visible(world_T_cam) & rig.left.inside(left, 5) & rig.right.inside(right, 5), left, right

    def _follow(self, seen: Bool) -> None:
        """Tracks end, new ones take their places."""
        self._keep(seen[self._points] & (self._rng.random(len(self._points)) > BROKEN))
        free = seen.copy()
        free[self._points] = False
        new = self._best(free, max(TRACKS - len(self._points), 0))
        self._points = np.concatenate([self._points, new])
        self._ids = np.concatenate([self._ids, self._next_id + np.arange(len(new))])
        self._next_id += len(new)

    def _keep(self, mask: Bool) -> None:
        self._points, self._ids = self._points[mask], self._ids[mask]

    def _best(self, among: Bool, count: int) -> I64:
        """Rows of the points with the best scores in this image."""
        rows = np.flatnonzero(among)
        score = self._aisle.scores[rows] + self._rng.normal(0, SCORE_NOISE, len(rows))
        return np.sort(rows[np.argsort(-score, kind="stable")[:count]])

    def _measured(self, rows: I64, left: F64, right: F64) -> tuple[F64, F64, F64]:
        """Pixels with noise, and the stereo points that follow from them."""
        uv_left, uv_right = (uv[rows] + self._rng.normal(0, NOISE_PX, (len(rows), 2)) for uv in (left, right))
        rig = self._rig
        assert rig.right is not None
        a, b = rig.left.unproject(uv_left), rig.right.unproject(uv_right) @ rig.left_T_right[:3, :3].T
        t = rig.left_T_right[:3, 3]
        ab, at, bt = (a * b).sum(1), a @ t, b @ t
        depth = np.clip((at - ab * bt) / np.maximum(1 - ab * ab, 1e-12), 0.2, 30.0)
        return uv_left, uv_right, a * depth[:, None]
