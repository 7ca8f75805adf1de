"""Bundle adjustment: arrays in, arrays out. Levenberg-Marquardt with the Schur complement over the points.

Any camera model of geometry.kernels, one or two cameras, Huber's loss, fixed keyframes, removal of outliers between
rounds. Observations of fixed keyframes depend on the points alone: they enter as a quadratic prior of each point, which
may be kept for a round, so that many fixed keyframes cost little.
The retail paper's equations 19-21 (local and full optimisation).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.chi_squared import chi_squared
from stereo_sfm.geometry.order_statistics import median
from stereo_sfm.geometry.small_matrix import solve_symmetric
from stereo_sfm.mapping import bundle_kernels as kernels
from stereo_sfm.mapping.level import Level
from stereo_sfm.mapping.motion_factors import MotionFactors, MotionModel
from stereo_sfm.mapping.reduced import ReducedSystem
from stereo_sfm.tracking.flow.stereo_cameras import StereoCameras
from stereo_sfm.types import F64, I64, Bool

LONGEST_STEP = 32.0  # steps of Gauss-Newton that `BundleConfig.extend` tries at once: five doublings, then a new system
LEAST_SQUARES = 100.0  # squared scale of Cauchy's loss over twice the variance: the mean weight is one within a percent
MIN_RESIDUAL = 0.05  # sigmas, lower bound of a median residual: exact data have none, and a scale of zero
Linear = tuple[F64, F64, F64, F64]  # A (M, 6), g (M, 3), p (M, 3), chi2 (M, 2)


@dataclass(frozen=True)
class BundleConfig:
    """Settings of `bundle_adjust`."""

    rounds: int = 2  # after each round but the last, outliers are determined anew
    iterations: int = 10  # maximum of accepted steps of a round
    huber: float = 2.0  # sigmas where the loss becomes linear; 0 means least squares
    cauchy: float = 0.0  # median residuals, the scale of Cauchy's loss in all rounds but the first; 0: Huber's
    disparity_sigmas: float = 0.0  # mean error of a point's stereo matches beyond which they count less; 0: never
    joint_loss: bool = False  # one loss over both images of an observation instead of one each
    outlier_chi2: float = chi_squared(2)  # squared normalised residual in an image: one of 100 right ones is left out
    tolerance: float = 1e-5  # relative decrease of the cost that ends a round
    damping: float = 1e-4  # first damping, relative to the diagonal
    fixed_once: bool = False  # observations of fixed keyframes are linearised once a round, not after every step
    extend: bool = False  # take steps longer than Gauss and Newton's while the cost decreases
    dense: bool | None = None  # the solver of the reduced system; None: by size


@dataclass(frozen=True, eq=False)
class Bundle:
    """One problem. Rows of observations in any order."""

    world_T_kf: F64  # (K, 4, 4)
    fixed: Bool  # (K,)
    points: F64  # (P, 3) world
    obs_kf: I64  # (M,) row of world_T_kf
    obs_pt: I64  # (M,) row of points
    uv_left: F64  # (M, 2) px, NaN where not observed
    uv_right: F64  # (M, 2) px, NaN where not observed; only the row NaN: u alone counts (rectified)
    sigma: F64 | None = None  # (M, 2) px of (left, right); None: 1
    level: Level | None = None  # what the keyframes measured of gravity; None: nothing
    motions: MotionFactors | None = None  # what IMU and wheels measured between them; None: nothing
    kf_rig: I64 | None = None  # (K,) which of several rigs took a keyframe; None: there is one
    points_stay: bool = False  # only poses are adjusted


@dataclass(frozen=True, eq=False)
class BundleResult:
    """The refined state, and which observations agree with it."""

    world_T_kf: F64  # (K, 4, 4)
    points: F64  # (P, 3)
    inlier: Bool  # (M, 2) per image; False also where not observed
    cost: float  # robust cost over the inliers at the end
    initial_cost: float  # the same function at the start of the last round
    iterations: int  # accepted steps
    converged: bool
    states: F64 | None = None  # (N, 9) of the nodes of the motions: see `States.after`; None: no IMU


@dataclass(frozen=True, eq=False)
class _Prior:
    """The observations of fixed keyframes as quadratic models of the points about x0, and their cost."""

    x0: F64  # (P, 3)
    h: F64  # (P, 6)
    g: F64  # (P, 3)
    cost: float


class _Table:
    """Observations of the moving or of the fixed keyframes, sorted by point, in columns for the kernels."""

    def __init__(self, rigs: Sequence[Rig], bundle: Bundle, config: BundleConfig, rows: I64) -> None:
        self.rows = rows = rows[np.argsort(bundle.obs_pt[rows], kind="stable")]
        self.kf = np.ascontiguousarray(bundle.obs_kf[rows], np.int64)
        self.pt = np.ascontiguousarray(bundle.obs_pt[rows], np.int64)
        self.starts = np.searchsorted(self.pt, np.arange(len(bundle.points) + 1))
        left = np.ascontiguousarray(bundle.uv_left[rows], float)
        right = np.ascontiguousarray(bundle.uv_right[rows], float)
        which = None if bundle.kf_rig is None else bundle.kf_rig[self.kf]
        of_rig = [np.flatnonzero(np.ones(len(rows), bool) if which is None else which == i) for i in range(len(rigs))]
        finite = np.isfinite(left)  # by columns: numpy takes ten times as long to reduce rows of two
        seen = np.stack([finite[:, 0] & finite[:, 1], np.isfinite(right[:, 0])], 1)
        for rig, own in zip(rigs, of_rig, strict=True):
            seen[own, 1] &= rig.stereo
        sigma = np.ones(seen.shape) if bundle.sigma is None else bundle.sigma[rows]
        self._weights = np.where(seen, 1.0 / sigma, 0.0)  # (M, 2)
        self._columns = kernels.Rows(self.kf, self.pt, left, right, self._weights)
        self._rigs = [(own, StereoCameras.of_any(rig)) for rig, own in zip(rigs, of_rig, strict=True)]
        self.trust = np.ones(len(bundle.points))  # (P,) factor of the loss of the points' disparities
        self.use = seen.copy()  # (M, 2) images that count
        self._config = config
        self.cauchy = 0.0  # above 0: `linearize` uses Cauchy's loss of this scale in sigmas
        self.limit = 0.0  # above 0: the next `linearize` determines which images count

    def linearize(self, state: _State) -> tuple[Linear, float]:
        """Quadratic models of the observations at a state, and their robust cost."""
        n, cost = len(self.kf), 0.0
        out: Linear = (np.empty((n, 6)), np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 2)))
        scale, redescends = self.cauchy or float(self._config.huber), self.cauchy > 0
        for own, cameras in self._rigs:
            cost += kernels.linearize(
                *(own, state.rot, state.pos, state.points, self._columns, self.trust, self.use, self.limit, cameras),
                *(scale, redescends, self._config.joint_loss, out),
            )
        self.limit = 0.0
        return out, float(cost)

    def add_disparity_errors(self, state: _State, total: F64, information: F64) -> None:
        """Add the weighted disparity errors of the points' observations, and their weights, to (P,) and (P,)."""
        for own, cameras in self._rigs:
            kernels.add_disparity_errors(
                own, state.rot, state.pos, state.points, self._columns, self.use, cameras, total, information
            )

    def sum_up(self, rot: F64, lin: Linear) -> tuple[F64, F64]:
        """(P, 6) and (P, 3): the quadratic models of the points, in world axes."""
        h, g = np.zeros((len(self.starts) - 1, 6)), np.zeros((len(self.starts) - 1, 3))
        kernels.sum_up(self.starts, self.kf, rot, lin, h, g)
        return h, g

    def agreeing(self, chi2: F64, limit: float) -> Bool:
        """(M, 2) which images agree, whether or not they counted."""
        return (self._weights > 0) & (chi2 <= limit)


class _State:
    """Poses and points, the quadratic model of the moving keyframes' observations, and the cost."""

    def __init__(self, rot: F64, pos: F64, points: F64) -> None:
        self.rot, self.pos, self.points = rot, pos, points
        self.lin: Linear
        self.prior: _Prior
        self.level: tuple[F64, F64]  # expected directions (F, 3) and weights (F,) of gravity
        self.pull: F64  # (6 F,) gradient of the motions' costs
        self.cost = 0.0


class _Solver:
    def __init__(self, rigs: Sequence[Rig], bundle: Bundle, config: BundleConfig) -> None:
        self.config = config
        two_cameras = any(rig.second_camera is not None for rig in rigs)
        self._weighs_disparities = config.disparity_sigmas > 0 and two_cameras
        moves = ~bundle.fixed[bundle.obs_kf]
        self.table = _Table(rigs, bundle, config, np.flatnonzero(moves))
        self.fixed = _Table(rigs, bundle, config, np.flatnonzero(~moves))
        self.free = np.where(bundle.fixed, -1, np.cumsum(~bundle.fixed) - 1).astype(np.int64)
        self.moving = np.flatnonzero(~bundle.fixed)
        self.points_stay = bundle.points_stay
        self.level = bundle.level
        self.motions = bundle.motions
        self.model: MotionModel | None = None  # of the round
        self.share = 1.0  # of the information of gravity and motions that counts in the round
        self.system: ReducedSystem | None = None
        n = len(bundle.points)
        self._nothing = _Prior(bundle.points, np.zeros((n, 6)), np.zeros((n, 3)), 0.0)

    def _prior(self, state: _State) -> _Prior:
        if not len(self.fixed.kf):
            return self._nothing
        lin, cost = self.fixed.linearize(state)
        return _Prior(state.points, *self.fixed.sum_up(state.rot, lin), cost)

    def evaluate(self, state: _State, prior: _Prior | None = None) -> _State:
        """Fill in the model and the cost; `prior`: model of the fixed keyframes from an earlier state, to reuse it."""
        self._evaluate_images(state, prior)
        self._evaluate_sensors(state)
        return state

    def _evaluate_images(self, state: _State, prior: _Prior | None = None) -> None:
        state.lin, state.cost = self.table.linearize(state)
        state.prior = prior or self._prior(state)
        state.cost += state.prior.cost
        if prior is not None and prior is not self._nothing:
            state.cost += kernels.prior_cost(state.points, prior.x0, prior.h, prior.g)

    def _evaluate_sensors(self, state: _State) -> None:
        """Add gravity and motions."""
        if self.level is not None:
            expected, weight, cost = self.level.evaluate(state.rot, self.moving)
            state.level = expected, self.share * weight
            state.cost += self.share * cost
        if self.model is not None:
            state.pull, cost = self.model.evaluate(state.rot[self.moving], state.pos[self.moving])
            state.cost += cost

    def begin_round(self, state: _State, judge: bool) -> None:
        """Linearise anew without outliers; `judge`: determine outliers, in all rounds but the first."""
        if judge and self._weighs_disparities:  # not at the start, where wrong poses make all points disagree
            total, information = np.zeros(len(state.points)), np.zeros(len(state.points))
            for table in (self.table, self.fixed):
                table.add_disparity_errors(state, total, information)
            self.table.trust = self.fixed.trust = _disparity_weights(total, information, self.config.disparity_sigmas)
        self.table.limit = self.fixed.limit = self.config.outlier_chi2 if judge else 0.0
        if judge and self.config.cauchy > 0:
            residual = np.sqrt(median(state.lin[3][self.table.use])) if self.table.use.any() else 0.0
            self.table.cauchy = self.fixed.cauchy = self.config.cauchy * max(float(residual), MIN_RESIDUAL)
        self._evaluate_images(state)
        if self.level is not None or self.motions is not None:
            chi2, config = state.lin[3][self.table.use], self.config
            if len(chi2):
                self.share = counted_information(float(median(chi2)), self.table.cauchy, config.joint_loss)
            if self.motions is not None:
                self.model = self.motions.linearized(state.rot, state.pos, self.free, judge).scaled(self.share)
            self._evaluate_sensors(state)

    def _pose_system(self, state: _State, damping: float) -> tuple[F64, F64]:
        h, b = np.zeros((len(self.moving), 6, 6)), np.zeros((len(self.moving), 6))
        kernels.pose_blocks(self.table.kf, self.free, state.lin, h, b)
        if self.level is not None:
            self.level.add(*state.level, self.level.seen[self.moving], h, b)
        if self.model is not None:
            h += self.model.blocks[np.arange(len(h)), np.arange(len(h))]
            b -= state.pull.reshape(-1, 6)
        diagonal = h.reshape(-1, 36)[:, ::7]
        # A keyframe without any inlier keeps its pose: its block would be singular.
        diagonal += damping * diagonal + 1e-12
        return h, b

    def _solve_poses(self, state: _State, damping: float, blocks: tuple[F64, F64] | None) -> F64 | None:
        h, b = self._pose_system(state, damping)
        if blocks is None:  # nothing couples the poses
            xi, factor = np.zeros(b.shape), np.zeros((6, 6))
            return xi if all(solve_symmetric(h[k], b[k], xi[k], factor) for k in range(len(h))) else None
        table = self.table
        if self.system is None:
            dense = self.config.dense if self.model is None else True  # which motions couple as well
            self.system = ReducedSystem(table.starts, table.kf, self.free, dense)
        matrix = self.system.new_blocks(h)
        if self.model is not None:
            rows, others = np.tril_indices(len(h), -1)
            matrix[rows * len(h) + others] = self.model.blocks[rows, others]
        kernels.reduce(
            *(table.starts, table.kf, self.free, state.rot, state.lin, *blocks),
            *(self.system.most, matrix, self.system.slots, b),
        )
        return self.system.solve(matrix, b)

    def step(self, state: _State, damping: float) -> _State | None:
        """The state after one damped step, or None if the system has no solution."""
        rot, pos, points, prior = state.rot, state.pos, state.points, state.prior
        blocks = None if self.points_stay else self.table.sum_up(rot, state.lin)
        if blocks is not None:
            kernels.point_blocks(points, prior.x0, prior.h, prior.g, damping, *blocks)
        xi = np.zeros((0, 6))
        if len(self.moving):
            solved = self._solve_poses(state, damping, blocks)
            if solved is None or not np.isfinite(solved).all():
                return None
            xi, rot, pos = solved, rot.copy(), pos.copy()
            kernels.move_poses(self.moving, xi, rot, pos)
        if blocks is not None:
            points, table = np.empty_like(points), self.table
            view = table.starts, table.kf, self.free, state.rot, state.lin
            kernels.point_steps(*view, *blocks, xi, state.points, points)
        return self.evaluate(_State(rot, pos, points), prior if self.config.fixed_once else None)

    def _extended(self, state: _State, trial: _State) -> _State:
        """The best of ever longer steps from one state towards another, which has a lower cost.

        The weights of a redescending loss follow a step only afterwards, so that where keyframes move together each
        step is a small share of what is left. A longer one needs no new system.
        """
        turn, prior = se3.so3_log(state.rot.mT @ trial.rot), state.prior if self.config.fixed_once else None
        best, factor = trial, 2.0
        while factor <= LONGEST_STEP:
            rot = np.ascontiguousarray(state.rot @ se3.so3_exp(factor * turn))
            pos, points = (a + factor * (b - a) for a, b in ((state.pos, trial.pos), (state.points, trial.points)))
            further = self.evaluate(_State(rot, pos, points), prior)
            if not further.cost < best.cost:
                break
            best, factor = further, 2.0 * factor
        return best

    def descend(self, state: _State) -> tuple[_State, int, bool]:
        """Levenberg-Marquardt from one state: the best state, accepted steps, whether it converged."""
        damping, accepted, c = self.config.damping, 0, self.config
        while accepted < c.iterations:
            trial = self.step(state, damping)
            if trial is None or not trial.cost <= state.cost:
                damping *= 10.0
                if damping > 1e6 or (trial is not None and trial.cost - state.cost <= c.tolerance * 0.1 * state.cost):
                    return state, accepted, True
                continue
            if c.extend:
                trial = self._extended(state, trial)
            decrease = state.cost - trial.cost
            state, damping, accepted = trial, max(damping * 0.1, 1e-9), accepted + 1
            if decrease <= c.tolerance * state.cost:
                return state, accepted, True
        return state, accepted, False


def counted_information(chi2: float, cauchy: float = 0.0, joint: bool = False) -> float:
    """What a cost of pixels counts, over the information about the poses that these pixels have.

    The loss compares observations with each other, whatever their noise is; what else knows the poses, gravity and
    motions with covariances of their own, enters the same cost with this factor. Where coordinates have the standard
    deviation s, an estimate by a loss with weights w counts E[w] and has the variance E[psi^2] / E[psi']^2 (Huber,
    Robust Statistics, 1981, section 4.2). Of Cauchy's weights c^2 / (c^2 + r^2), with a = c^2 / 2 s^2, E[w] is
    v = a e^a E1(a) in two dimensions and a (1 - v) in four, E[w^2] is a (1 - v) and a v - a^2 (1 - v). Without them all
    weights are taken as one, as of residuals that are small for Huber's loss.

    Args:
        chi2: median squared residual of an image, sigmas^2. cauchy: scale c in sigmas, 0: another loss.
        joint: one loss over both images.
    """
    variance = max(chi2 / (2.0 * math.log(2.0)), MIN_RESIDUAL**2)  # chi-squared of two dimensions has that median
    a = cauchy**2 / (2.0 * variance)
    if cauchy <= 0 or a > LEAST_SQUARES:
        return min(variance, 1.0)
    from scipy.special import exp1  # here, as only runs with sensors need it: it takes 20 ms to load

    v = a * float(exp1(a)) * math.exp(a)
    if not joint:
        weight = v
        square = slope = a * (1.0 - v)
        psi2 = a * variance * (weight - square)
    else:
        weight, square = a * (1.0 - v), a * v - a * a * (1.0 - v)
        slope, psi2 = 0.5 * (weight + square), 0.5 * a * variance * (weight - square)
    return weight * psi2 / slope**2


def _disparity_weights(total: F64, information: F64, sigmas: float) -> F64:
    """(P,) weights of the points' disparities, 1 up to so many sigmas of the mean error, then redescending.

    The disparity of a point near a depth edge is wrong in the same way in all its observations, mostly towards nearer:
    each error is small, and no loss of single observations reduces its weight, but their mean is significant, and many
    of them make the path too short. What all points have in common is the error of the path so far: it is left out.
    Sigma is the robust standard deviation of the points' normalised means.

    Args:
        total, information: (P,) of the points' disparity errors, see `bundle_kernels.add_disparity_errors`.
    """
    weight, seen = np.ones(len(total)), information > 0
    if not seen.any():
        return weight
    mean = total[seen] / information[seen]
    mean = np.abs(mean - median(mean)) * np.sqrt(information[seen])
    limit = sigmas * max(1.4826 * median(mean), MIN_RESIDUAL)  # 1 / Phi^-1(3/4)
    weight[seen] = (limit / np.maximum(mean, limit)) ** 4
    return weight


def bundle_adjust(rig: Rig | Sequence[Rig], bundle: Bundle, config: BundleConfig | None = None) -> BundleResult:
    """Poses and points that minimise the robust reprojection error.

    Args: rig, that took the keyframes; several with `Bundle.kf_rig`.

    A point without inliers stays where it is; one on a single ray moves onto it and constrains no pose.

    Raises:
        StereoSfmError: arrays of different lengths, or indices out of range.
    """
    config = config or BundleConfig()
    _check(bundle)
    solver = _Solver([rig] if isinstance(rig, Rig) else rig, bundle, config)
    state = _State(
        np.ascontiguousarray(bundle.world_T_kf[:, :3, :3], float),
        np.ascontiguousarray(bundle.world_T_kf[:, :3, 3], float),
        np.ascontiguousarray(bundle.points, float),
    )
    iterations, converged, initial = 0, False, 0.0
    for index in range(config.rounds):
        solver.begin_round(state, judge=index > 0)
        initial = state.cost
        state, steps, converged = solver.descend(state)
        iterations += steps
    return _result(solver, bundle, state, initial, iterations, converged)


def adjust_pose(
    rig: Rig, world_T_cam: F64, points: F64, uv_left: F64, uv_right: F64, sigma: F64, huber: float
) -> tuple[F64, Bool]:
    """The pose of one keyframe that minimises the robust reprojection error of fixed points in both images.

    Args:
        world_T_cam: (4, 4) start. points: (N, 3) world. uv_left, uv_right: (N, 2) px, NaN where unseen; only the row
            NaN: the column alone counts. sigma: (N,) px. huber: sigmas where the loss turns linear.

    Returns:
        (4, 4) pose, and (N, 2) which observations agree with it, in the left and the right image.
    """
    rows, sigmas = np.arange(len(points)), np.repeat(np.asarray(sigma, float)[:, None], 2, axis=1)
    bundle = Bundle(
        np.array(world_T_cam, float)[None], np.zeros(1, bool), points, np.zeros_like(rows), rows, uv_left, uv_right,
        sigmas, points_stay=True,
    )  # fmt: skip
    result = bundle_adjust(rig, bundle, BundleConfig(rounds=3, huber=huber))
    return result.world_T_kf[0], result.inlier


def _result(
    solver: _Solver, bundle: Bundle, state: _State, initial: float, iterations: int, converged: bool
) -> BundleResult:
    inlier = np.empty((len(bundle.obs_kf), 2), bool)
    for table, found in ((solver.table, state.lin[3]), (solver.fixed, solver.fixed.linearize(state)[0][3])):
        inlier[table.rows] = table.agreeing(found, solver.config.outlier_chi2)
    poses = bundle.world_T_kf.astype(float, copy=True)
    moved = se3.from_rotation_translation(state.rot, state.pos)[solver.moving]
    poses[solver.moving] = se3.orthonormalize(moved) if len(moved) else moved
    states = None
    if (model := solver.model) is not None and model.states is not None:
        states = model.states.after(model.step_to(state.rot[solver.moving], state.pos[solver.moving]))
    return BundleResult(poses, state.points, inlier, state.cost, initial, iterations, converged, states)


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
            raise StereoSfmError(f"bundle adjustment got an observation of a {what} that does not exist")
