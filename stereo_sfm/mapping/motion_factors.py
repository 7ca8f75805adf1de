"""Motions in local bundle adjustment, by IMU, wheels and odometry: factors between successive keyframes.

The residuals of preintegrated motions (Forster et al., On-Manifold Preintegration for Real-Time Visual-Inertial
Odometry, TRO 2017, equation 45), random walks of the biases between them, and at the first keyframe of a submap what
the tracker's filter knew of velocity, gravity and biases: all earlier samples, marginalised. The motions by wheels and
by odometry are relative poses.

Stereo gives the size of the motion, so velocities, biases and gravity enter linearly. They are eliminated: what is left
is a quadratic model of the poses, made once a round, as the poses move by millimetres. A motion that the map
contradicts counts less.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve  # pyright: ignore[reportUnknownVariableType]

from stereo_sfm.calib.imu import TURN_SHARE, Imu
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.chi_squared import chi_squared
from stereo_sfm.geometry.preintegration import GRAVITY, Preintegrated
from stereo_sfm.mapping.map import Map
from stereo_sfm.tracking.inertial.inertial_filter import SPEED_SIGMA
from stereo_sfm.types import F64, I64, Bool, MotionLink

FIRST_ROUND = 10.0  # times as much is allowed before the poses are adjusted: until then it is they that may be wrong
STATE = 9  # numbers: velocity in the map, biases of accelerometer and gyroscope


@dataclass(frozen=True, eq=False)
class InertialFactors:
    """Motions by the IMU between nodes, keyframes in or outside of the bundle."""

    imu: Imu
    links: I64  # (L, 2) nodes
    motions: list[Preintegrated]  # (L,)
    first: I64  # (C,) nodes at which submaps begin
    known: list[tuple[F64, F64] | None]  # (C,) their states as the tracker knew them, see `InertialLink.state`
    states: F64  # (N, 9) to begin with: velocity in the IMU's axes, biases of accelerometer and gyroscope


@dataclass(frozen=True, eq=False)
class PoseFactors:
    """Motions by wheels and by odometry between nodes."""

    links: I64  # (L, 2) nodes
    motions: list[MotionLink]  # (L,)


@dataclass(frozen=True, eq=False)
class MotionFactors:
    """All of a bundle."""

    rows: I64  # (N,) of each node in the bundle, -1: outside
    world_T_kf: F64  # (N, 4, 4) of the nodes; counts for those outside
    inertial: InertialFactors | None
    poses: PoseFactors | None

    def linearized(self, rot: F64, pos: F64, free: I64, judged: bool) -> MotionModel:
        """The quadratic model at poses (K, 3, 3), (K, 3).

        Args:
            free: (K,) row of a keyframe in the system, -1 when it is fixed. judged: whether the poses are adjusted.
        """
        node_rot, node_pos = self.world_T_kf[:, :3, :3].copy(), self.world_T_kf[:, :3, 3].copy()
        inside = self.rows >= 0
        node_rot[inside], node_pos[inside] = rot[self.rows[inside]], pos[self.rows[inside]]
        column = np.where(inside, free[self.rows], -1)
        size = int(free.max(initial=-1)) + 1
        slack = 1.0 if judged else FIRST_ROUND
        moving = np.flatnonzero(free >= 0)
        model = MotionModel(rot[moving].copy(), pos[moving].copy(), np.zeros((6 * size,) * 2), np.zeros(6 * size))
        if self.poses is not None:
            _add_poses(self.poses, node_rot, node_pos, column, slack, model)
        if self.inertial is not None:
            model.states = _add_inertial(self.inertial, node_rot, node_pos, column, slack, model)
        return model


def motion_factors(map_: Map, rows: I64, fixed: Bool, imu: Imu | None) -> MotionFactors | None:
    """What is known of the motions between the keyframes of a bundle that move and those before and after them.

    Args:
        rows: (K,) of the bundle in the map. fixed: (K,). imu: None: without it.
    """
    if not map_.motions:
        return None
    table, moving = map_.keyframes, rows[~fixed]
    later = np.union1d(moving, np.flatnonzero(table.alive & np.isin(table.previous, moving)))
    later = np.array([row for row in later.tolist() if row in map_.motions], np.int64)
    if not len(later):
        return None
    nodes, links = np.unique(np.stack([table.previous[later], later], 1), return_inverse=True)
    links, motions = links.reshape(-1, 2), [map_.motions[row] for row in later.tolist()]
    inertial = None if imu is None else _inertial_factors(map_, nodes, links, [m.inertial for m in motions], imu)
    moved = [(k, link) for k, m in enumerate(motions) for link in (m.wheels, m.odometry) if link is not None]
    poses = PoseFactors(links[[k for k, _ in moved]], [link for _, link in moved]) if moved else None
    if inertial is None and poses is None:
        return None
    index = np.full(len(table), -1, np.int64)
    index[rows] = np.arange(len(rows))
    return MotionFactors(index[nodes], table.map_T_kf[nodes], inertial, poses)


def _inertial_factors(
    map_: Map, nodes: I64, links: I64, motions: list[Preintegrated | None], imu: Imu
) -> InertialFactors | None:
    """None where the tracker knew gravity at no keyframe that begins a submap."""
    links = links[[motion is not None for motion in motions]]
    first = np.setdiff1d(np.arange(len(nodes)), links[:, 1])
    known = [map_.known_states.get(row) for row in nodes[first].tolist()]
    if not len(links) or all(state is None for state in known):
        return None
    measured = [m for m in motions if m is not None]
    return InertialFactors(imu, links, measured, first, known, map_.keyframes.state[nodes])


@dataclass(eq=False)
class States:
    """Velocities and biases as functions of the poses."""

    rotation: F64  # (N, 3, 3) of the nodes' IMUs
    at: F64  # (N, 9) where the poses are those of the model
    by_step: F64  # (9 N, 6 F)

    def after(self, step: F64) -> F64:
        """(N, 9) velocity in the IMU's axes and biases, after a step (6 F,) of the poses."""
        states = (self.at.ravel() + self.by_step @ step).reshape(-1, STATE)
        states[:, :3] = _times(self.rotation.mT, states[:, :3])
        return states


@dataclass(eq=False)
class MotionModel:
    """cost + g d + d H d / 2 in the steps d (6 F,) of the moving poses from where it was made."""

    rot: F64  # (F, 3, 3)
    pos: F64  # (F, 3)
    h: F64  # (6 F, 6 F)
    g: F64  # (6 F,)
    cost: float = 0.0
    states: States | None = None

    def scaled(self, share: float) -> MotionModel:
        """With a share of the information."""
        return replace(self, h=share * self.h, g=share * self.g, cost=share * self.cost)

    @property
    def blocks(self) -> F64:
        """(F, F, 6, 6) of h."""
        n = len(self.rot)
        return self.h.reshape(n, 6, n, 6).transpose(0, 2, 1, 3)

    def step_to(self, rot: F64, pos: F64) -> F64:
        """(6 F,) from the model's poses to others (F, 3, 3), (F, 3), to first order."""
        moved = _times(self.rot.mT, pos - self.pos)
        return np.hstack([moved, se3.so3_log(self.rot.mT @ rot)]).ravel()

    def evaluate(self, rot: F64, pos: F64) -> tuple[F64, float]:
        """The gradient (6 F,) and the cost at poses."""
        step = self.step_to(rot, pos)
        change = self.h @ step
        return self.g + change, float(self.cost + self.g @ step + 0.5 * step @ change)


def _times(matrices: F64, vectors: F64) -> F64:
    """(L, R) of (L, R, C) and (L, C)."""
    return np.einsum("lrc,lc->lr", matrices, vectors)


def _relative_weights(residual: F64, slack: float) -> F64:
    """(L,) factors of the information of motions with whitened residuals (L, R): less than 1 for 1 % of right ones.

    `slack`: times as much is allowed.
    """
    limit = slack * chi_squared(residual.shape[1])
    return np.minimum(1.0, limit / np.maximum((residual**2).sum(axis=1), limit))


def _normal_equations(jacobian: F64, residual: F64, columns: I64, size: int) -> tuple[F64, F64]:
    """(size, size) and (size,) of rows (L, R, C) and residuals (L, R), whose columns (L, C) may be -1: fixed."""
    columns = np.where(columns < 0, size, columns)
    local, n = np.einsum("lri,lrj->lij", jacobian, jacobian), size + 1
    where = columns[:, :, None] * n + columns[:, None, :]
    h = np.asarray(np.bincount(where.ravel(), local.ravel(), n * n), np.float64).reshape(n, n)
    pull = np.einsum("lri,lr->li", jacobian, residual)
    g = np.asarray(np.bincount(columns.ravel(), pull.ravel(), n), np.float64)
    return h[:size, :size], g[:size]


def _pose_columns(column: I64) -> I64:
    """(..., 6) columns of nodes (...), -1 for fixed ones."""
    return np.where(column[..., None] < 0, -1, 6 * column[..., None] + np.arange(6))


def _add_poses(factors: PoseFactors, rot: F64, pos: F64, column: I64, slack: float, model: MotionModel) -> None:
    i, j = factors.links.T
    poses = se3.from_rotation_translation(rot, pos)
    seen = se3.inverse(poses[i]) @ poses[j]
    measured = np.stack([m.last_T_cam for m in factors.motions])
    residual = np.asarray(se3.log(se3.inverse(measured) @ seen))
    root = _roots(np.stack([m.covariance for m in factors.motions]))
    jacobian = np.zeros((len(i), 6, 12))
    jacobian[:, :, :6], jacobian[:, :, 6:] = -se3.adjoint(se3.inverse(seen)), np.eye(6)
    jacobian, residual = root @ jacobian, _times(root, residual)
    weight = np.sqrt(_relative_weights(residual, slack))
    jacobian, residual = weight[:, None, None] * jacobian, weight[:, None] * residual
    columns = _pose_columns(column[factors.links]).reshape(len(i), 12)
    h, g = _normal_equations(jacobian, residual, columns, len(model.g))
    model.h += h
    model.g += g
    model.cost += 0.5 * float((residual**2).sum())


def _roots(covariance: F64) -> F64:
    """(L, D, D) W with W^T W the inverse of covariances (L, D, D)."""
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)), np.float64)


@dataclass(frozen=True, eq=False)
class _System:
    """Normal equations over the poses' steps (6 F,) and then everything else, which is eliminated."""

    h: F64
    g: F64
    cost: float
    size: int  # 6 F

    def plus(self, jacobian: F64, residual: F64, columns: I64) -> _System:
        """With rows (L, R, C) and residuals (L, R) of columns (L, C)."""
        h, g = _normal_equations(jacobian, residual, columns, len(self.g))
        return _System(self.h + h, self.g + g, self.cost + 0.5 * float((residual**2).sum()), self.size)

    def eliminated(self) -> F64:
        """(E, 1 + 6 F) X: the rest takes the step -X @ [1, steps of the poses]."""
        n = self.size
        right = np.column_stack([self.g[n:], self.h[n:, :n]])
        return np.asarray(cho_solve(cho_factor(self.h[n:, n:], check_finite=False), right, check_finite=False))

    def add_to(self, model: MotionModel, eliminated: F64) -> None:
        """Add what is left of the poses."""
        n = self.size
        model.h += self.h[:n, :n] - self.h[n:, :n].T @ eliminated[:, 1:]
        model.g += self.g[:n] - self.h[n:, :n].T @ eliminated[:, 0]
        model.cost += self.cost - 0.5 * float(self.g[n:] @ eliminated[:, 0])


def _add_inertial(
    factors: InertialFactors, rot: F64, pos: F64, column: I64, slack: float, model: MotionModel
) -> States:
    left_T_imu, size, nodes = factors.imu.left_T_imu, len(model.g), len(column)
    rot, pos = rot @ left_T_imu[:3, :3], pos + rot @ left_T_imu[:3, 3]  # of the IMU
    by_camera = se3.adjoint(se3.inverse(left_T_imu))  # a step of the IMU's pose by one of the camera's
    states = factors.states.copy()
    states[:, :3] = _times(rot, states[:, :3])
    begins = list(zip(factors.first.tolist(), factors.known, strict=True))
    gravity = np.mean([rot[n] @ known[0][3:6] for n, known in begins if known is not None], axis=0)
    gravity *= GRAVITY / np.linalg.norm(gravity)
    of_pose, of_state = _pose_columns(column), size + STATE * np.arange(nodes)[:, None] + np.arange(STATE)
    of_gravity = size + STATE * nodes + np.arange(3)
    total = size + STATE * nodes + 3
    at_begin = _System(np.zeros((total, total)), np.zeros(total), 0.0, size)
    for n, known in begins:
        rows, off = _known_rows(factors.imu, known, rot[n], states[n], gravity)
        rows[:, :6] = rows[:, :6] @ by_camera
        at_begin = at_begin.plus(rows[None], off[None], np.concatenate([of_pose[n], of_state[n], of_gravity])[None])
    i, j = factors.links.T
    jacobian, residual = _motion_rows(factors, rot, pos, states, gravity)
    jacobian[:, :, :6], jacobian[:, :, 6:12] = jacobian[:, :, :6] @ by_camera, jacobian[:, :, 6:12] @ by_camera
    columns = np.hstack([of_pose[i], of_pose[j], of_state[i], of_state[j], np.tile(of_gravity, (len(i), 1))])
    system = at_begin.plus(jacobian, residual, columns)
    eliminated = system.eliminated()
    step = np.concatenate([np.zeros(size), -eliminated[:, 0], [0.0]])
    left = residual + _times(jacobian, step[columns])
    weight = _relative_weights(left[:, :STATE], slack)
    if (weight < 1.0).any():
        scale = np.sqrt(weight)[:, None]
        jacobian[:, :STATE], residual[:, :STATE] = scale[:, :, None] * jacobian[:, :STATE], scale * residual[:, :STATE]
        system = at_begin.plus(jacobian, residual, columns)
        eliminated = system.eliminated()
    system.add_to(model, eliminated)
    return States(rot, states - eliminated[:-3, 0].reshape(-1, STATE), -eliminated[:-3, 1:])


def _motion_rows(factors: InertialFactors, rot: F64, pos: F64, z: F64, gravity: F64) -> tuple[F64, F64]:
    """Whitened rows (L, 15, 33) over the steps of both IMU poses, both states and gravity, and residuals (L, 15): of
    rotation, velocity and position, and of the biases' walks."""
    i, j = factors.links.T
    m, imu = factors.motions, factors.imu
    t = np.array([x.seconds for x in m])[:, None]
    turn, v, p, by_turn, v_gyro, v_accel, p_gyro, p_accel, covariance = (
        np.stack([getattr(x, name) for x in m])
        for name in (
            "rotation", "velocity", "position", "rotation_by_gyro", "velocity_by_gyro", "velocity_by_accel",
            "position_by_gyro", "position_by_accel", "covariance",
        )
    )  # fmt: skip
    accel = z[i, 3:6] - np.stack([x.accel_bias for x in m])
    gyro = z[i, 6:] - np.stack([x.gyro_bias for x in m])
    expected = turn @ se3.so3_exp(_times(by_turn, gyro))
    faster = v + _times(v_gyro, gyro) + _times(v_accel, accel)
    moved = p + _times(p_gyro, gyro) + _times(p_accel, accel)
    i_R_map, i_R_j = rot[i].mT, rot[i].mT @ rot[j]
    off = np.asarray(se3.so3_log(expected.mT @ i_R_j))
    residual = np.concatenate(
        [
            off,
            _times(i_R_map, z[j, :3] - z[i, :3] - t * gravity) - faster,
            _times(i_R_map, pos[j] - pos[i] - t * z[i, :3] - 0.5 * t * t * gravity) - moved,
            (z[j, 3:6] - z[i, 3:6]) / (imu.accel_walk * np.sqrt(t)),
            (z[j, 6:] - z[i, 6:]) / (imu.gyro_walk * np.sqrt(t)),
        ],
        axis=1,
    )
    # A turn of the first pose turns what was measured: velocities and gravity, to be found yet, will agree with that.
    a, one, t3 = np.zeros((len(i), 15, 33)), np.eye(3), t[:, :, None]
    right = one + 0.5 * se3.skew(off)
    a[:, :3, 3:6], a[:, :3, 9:12] = -right @ i_R_j.mT, right
    a[:, :3, 18:21] = -(one - 0.5 * se3.skew(off)) @ by_turn
    a[:, 3:6, 3:6] = se3.skew(faster)
    a[:, 3:6, 12:15], a[:, 3:6, 21:24], a[:, 3:6, 30:] = -i_R_map, i_R_map, -t3 * i_R_map
    a[:, 3:6, 15:18], a[:, 3:6, 18:21] = -v_accel, -v_gyro
    a[:, 6:9, :3], a[:, 6:9, 6:9], a[:, 6:9, 3:6] = -one, i_R_j, se3.skew(moved)
    a[:, 6:9, 12:15], a[:, 6:9, 30:] = -t3 * i_R_map, -0.5 * t3 * t3 * i_R_map
    a[:, 6:9, 15:18], a[:, 6:9, 18:21] = -p_accel, -p_gyro
    for rows, sigma, first, second in ((slice(9, 12), imu.accel_walk, 15, 24), (slice(12, 15), imu.gyro_walk, 18, 27)):
        walk = one / (sigma * np.sqrt(t3))
        a[:, rows, first : first + 3], a[:, rows, second : second + 3] = -walk, walk
    covariance = covariance.copy()
    share = TURN_SHARE * np.linalg.norm(se3.so3_log(turn), axis=1)
    covariance[:, :3, :3] += (share**2)[:, None, None] * one
    root = _roots(covariance)
    a[:, :STATE], residual[:, :STATE] = root @ a[:, :STATE], _times(root, residual[:, :STATE])
    return a, residual


def _known_rows(imu: Imu, known: tuple[F64, F64] | None, rot: F64, state: F64, gravity: F64) -> tuple[F64, F64]:
    """Whitened rows (R, 18) over the step of the IMU's pose, its state and gravity, and residuals (R,), at the first
    keyframe of a submap."""
    if known is None:
        sigma = np.repeat([SPEED_SIGMA, imu.accel_bias_sigma, imu.gyro_bias_sigma], 3)
        rows = np.zeros((STATE, 18))
        rows[:, 6 : 6 + STATE] = np.diag(1.0 / sigma)
        return rows, np.zeros(STATE)
    mean, covariance = known
    speed, down = rot.T @ state[:3], rot.T @ gravity
    rows = np.zeros((12, 18))
    rows[:3, 3:6], rows[3:6, 3:6] = se3.skew(mean[:3]), se3.skew(mean[3:6])
    rows[:3, 6:9], rows[3:6, 15:] = rot.T, rot.T
    rows[6:, 9:15] = np.eye(6)
    root = _roots(covariance[None])[0]
    return root @ rows, root @ (np.concatenate([speed, down, state[3:]]) - mean)
