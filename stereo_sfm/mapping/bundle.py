"""Bundle adjustment: arrays in, arrays out. Levenberg-Marquardt with the Schur complement over the points.

Any camera model of geometry.kernels, one or two eyes, Huber's loss, fixed keyframes, removal of outliers between
rounds, and the refinement of nothing but poses. The retail paper's equations 19-21 (local and full optimisation).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.rig import Rig
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.mapping import bundle_kernels as kernels
from stereo_sfm.mapping.reduced import ReducedSystem
from stereo_sfm.types import F64, I64, Bool

Linear = tuple[F64, F64, F64, F64]  # A (M, 6), g (M, 3), p (M, 3), chi2 (M, 2)


@dataclass(frozen=True)
class BundleConfig:
    """How a bundle is adjusted."""

    rounds: int = 2  # after each round but the last, observations are judged anew
    iterations: int = 10  # most accepted steps of a round
    huber: float = 2.0  # sigmas where the loss turns linear; 0 means least squares
    joint_loss: bool = False  # one loss over both eyes of an observation instead of one each
    outlier_chi2: float = 9.21  # squared normalised residual of an eye above which it is an outlier (99 % of 2 dof)
    tolerance: float = 1e-5  # relative decrease of the cost that ends a round
    damping: float = 1e-4  # first damping, relative to the diagonal
    move_points: bool = True  # False: nothing but poses
    dense: bool | None = None  # the solver of the reduced system; None: by size


@dataclass(frozen=True, eq=False)
class Bundle:
    """One problem. Rows of observations in any order."""

    world_T_kf: F64  # (K, 4, 4)
    fixed: Bool  # (K,)
    points: F64  # (P, 3) world
    obs_kf: I64  # (M,) row of world_T_kf
    obs_pt: I64  # (M,) row of points
    uv_left: F64  # (M, 2) px, NaN where the left eye does not see it
    uv_right: F64  # (M, 2) px, NaN where the right eye does not; only the row NaN: u alone counts (rectified, depth)
    sigma: F64 | None = None  # (M, 2) px of (left, right); None: 1


@dataclass(frozen=True, eq=False)
class BundleResult:
    """The refined state, and which observations agree with it."""

    world_T_kf: F64  # (K, 4, 4)
    points: F64  # (P, 3)
    inlier: Bool  # (M, 2) per eye; False also where the eye does not see
    chi2: F64  # (M, 2) squared normalised residuals at the end, of outliers too; 0 where the eye does not see
    cost: float  # robust cost over the inliers at the end
    initial_cost: float  # the same function at the start of the last round
    iterations: int  # accepted steps
    converged: bool


class _State:
    """Poses and points of one moment, their residuals and quadratic model."""

    def __init__(self, rot: F64, pos: F64, points: F64, count: int) -> None:
        self.rot, self.pos, self.points = rot, pos, points
        self.lin: Linear = (np.empty((count, 6)), np.empty((count, 3)), np.empty((count, 3)), np.empty((count, 2)))
        self.cost = 0.0


class _Solver:
    def __init__(self, rig: Rig, bundle: Bundle, config: BundleConfig) -> None:
        self.config = config
        self.order = np.argsort(bundle.obs_pt, kind="stable")
        self.obs_kf = np.ascontiguousarray(bundle.obs_kf[self.order], np.int64)
        self.obs_pt = np.ascontiguousarray(bundle.obs_pt[self.order], np.int64)
        self.uv_left = np.ascontiguousarray(bundle.uv_left[self.order], float)
        self.uv_right = np.ascontiguousarray(bundle.uv_right[self.order], float)
        self.starts = np.searchsorted(self.obs_pt, np.arange(len(bundle.points) + 1))
        self.sight = self._weights(rig, bundle)
        self.weights = self.sight
        right = rig.right if rig.right is not None else rig.left
        self.cams = (rig.left.model_id, rig.left.params, right.model_id, right.params)
        right_T_left = se3.inverse(rig.left_T_right)
        self.right_r, self.right_t = np.ascontiguousarray(right_T_left[:3, :3]), right_T_left[:3, 3].copy()
        self.free = np.where(bundle.fixed, -1, np.cumsum(~bundle.fixed) - 1).astype(np.int64)
        self.moving = np.flatnonzero(~bundle.fixed)
        self.system: ReducedSystem | None = None

    def _weights(self, rig: Rig, bundle: Bundle) -> F64:
        """(M, 2) 1/sigma, 0 where an eye does not see."""
        seen = np.stack([np.isfinite(self.uv_left).all(1), np.isfinite(self.uv_right[:, 0])], 1)
        seen[:, 1] &= rig.stereo
        sigma = np.ones(seen.shape) if bundle.sigma is None else bundle.sigma[self.order]
        return np.where(seen, 1.0 / sigma, 0.0)

    def evaluate(self, state: _State) -> _State:
        c = self.config
        state.cost = kernels.linearize(
            *(state.rot, state.pos, state.points, self.obs_kf, self.obs_pt, self.uv_left, self.uv_right, self.weights),
            *(self.cams, self.right_r, self.right_t, float(c.huber), c.joint_loss, state.lin),
        )
        return state

    def _pose_system(self, state: _State, damping: float) -> tuple[F64, F64]:
        h, b = np.zeros((len(self.moving), 6, 6)), np.zeros((len(self.moving), 6))
        kernels.pose_blocks(self.obs_kf, self.free, state.lin, h, b)
        diagonal = np.arange(6)
        # A keyframe without any inlier keeps its place: its block would be singular.
        h[:, diagonal, diagonal] += damping * h[:, diagonal, diagonal] + 1e-12
        return h, b

    def _solve_poses(self, state: _State, damping: float) -> F64 | None:
        h, b = self._pose_system(state, damping)
        if not self.config.move_points:
            return np.asarray(np.linalg.solve(h, b[..., None])[..., 0], float)
        if self.system is None:
            self.system = ReducedSystem(self.starts, self.obs_kf, self.free, self.config.dense)
        blocks = self.system.new_blocks(h)
        kernels.reduce(
            *(self.starts, self.obs_kf, self.free, state.rot, state.lin, damping),
            *(self.system.most, blocks, self.system.slots, b),
        )
        return self.system.solve(blocks, b)

    def step(self, state: _State, damping: float) -> _State | None:
        """The state after one damped step, or None where the system has no solution."""
        rot, pos, points = state.rot, state.pos, state.points
        xi = np.zeros((0, 6))
        if len(self.moving):
            solved = self._solve_poses(state, damping)
            if solved is None or not np.isfinite(solved).all():
                return None
            xi = solved
            delta = se3.exp(xi)
            rot, pos = rot.copy(), pos.copy()
            pos[self.moving] += (rot[self.moving] @ delta[:, :3, 3, None])[..., 0]
            rot[self.moving] = rot[self.moving] @ delta[:, :3, :3]
        if self.config.move_points:
            points = np.empty_like(points)
            kernels.point_steps(
                self.starts, self.obs_kf, self.free, state.rot, state.lin, damping, xi, state.points, points
            )
        return self.evaluate(_State(rot, pos, points, len(self.obs_kf)))

    def descend(self, state: _State) -> tuple[_State, int, bool]:
        """Levenberg-Marquardt from one state: the best state, accepted steps, whether the cost stopped falling."""
        damping, accepted, c = self.config.damping, 0, self.config
        state = self.evaluate(state)
        while accepted < c.iterations:
            trial = self.step(state, damping)
            if trial is None or not trial.cost <= state.cost:
                damping *= 10.0
                if damping > 1e6 or (trial is not None and trial.cost - state.cost <= c.tolerance * 0.1 * state.cost):
                    return state, accepted, True
                continue
            decrease = state.cost - trial.cost
            state, damping, accepted = trial, max(damping * 0.1, 1e-9), accepted + 1
            if decrease <= c.tolerance * state.cost:
                return state, accepted, True
        return state, accepted, False

    def judge(self, state: _State) -> Bool:
        """(M, 2) which eyes agree with a state, whether or not they had a say in it."""
        self.weights = self.sight
        self.evaluate(state)
        return (self.sight > 0) & (state.lin[3] <= self.config.outlier_chi2)


def bundle_adjust(rig: Rig, bundle: Bundle, config: BundleConfig | None = None) -> BundleResult:
    """Poses and points that minimise the robust reprojection error.

    A point that no remaining observation sees stays where it is; one on a single ray moves onto it and binds no pose.

    Raises:
        StereoSfmError: arrays of different lengths, or indices out of range.
    """
    config = config or BundleConfig()
    _check(bundle)
    solver = _Solver(rig, bundle, config)
    state = _State(
        np.ascontiguousarray(bundle.world_T_kf[:, :3, :3], float),
        np.ascontiguousarray(bundle.world_T_kf[:, :3, 3], float),
        np.ascontiguousarray(bundle.points, float),
        len(bundle.obs_kf),
    )
    iterations, converged, initial = 0, False, 0.0
    for index in range(config.rounds):
        if index:
            solver.weights = np.where(solver.judge(state), solver.sight, 0.0)
        initial = solver.evaluate(state).cost
        state, steps, converged = solver.descend(state)
        iterations += steps
    return _result(solver, bundle, state, initial, iterations, converged)


def _result(
    solver: _Solver, bundle: Bundle, state: _State, initial: float, iterations: int, converged: bool
) -> BundleResult:
    cost = state.cost
    inlier_sorted = solver.judge(state)
    inlier, chi2 = np.empty_like(inlier_sorted), np.empty_like(state.lin[3])
    inlier[solver.order], chi2[solver.order] = inlier_sorted, state.lin[3]
    poses = bundle.world_T_kf.astype(float, copy=True)
    moved = se3.from_rotation_translation(state.rot, state.pos)[solver.moving]
    poses[solver.moving] = se3.orthonormalize(moved) if len(moved) else moved
    return BundleResult(poses, state.points, inlier, chi2, cost, initial, iterations, converged)


def _check(bundle: Bundle) -> None:
    count = len(bundle.obs_kf)
    lengths = {len(bundle.obs_pt), len(bundle.uv_left), len(bundle.uv_right), count}
    if bundle.sigma is not None:
        lengths.add(len(bundle.sigma))
    if len(lengths) > 1 or len(bundle.fixed) != len(bundle.world_T_kf):
        raise StereoSfmError("bundle adjustment got arrays of different lengths: check the observation table")
    for rows, size, what in (
        (bundle.obs_kf, len(bundle.world_T_kf), "keyframe"),
        (bundle.obs_pt, len(bundle.points), "point"),
    ):
        if count and (int(rows.min()) < 0 or int(rows.max()) >= size):
            raise StereoSfmError(f"bundle adjustment got an observation of a {what} that is not there")
