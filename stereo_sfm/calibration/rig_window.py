"""Information about the rig from a few consecutive keyframes.

A separate bundle adjustment of the window's keyframes, the points that its first keyframe sees with both cameras, and
eight terms of the rig (`calib.choice`): rotation of the right camera, direction of the baseline, focal length of the
right camera relative to the left, decentering of the right lens relative to the left. Points and motion are unknowns
too, so errors of disparity, which are correlated with the motion, are estimated as well. The result is the information
about the terms with points and motion eliminated; that of several windows is summed.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from stereo_sfm.calib.choice import with_terms
from stereo_sfm.calib.rig import Rig
from stereo_sfm.calib.scene_model import inverse_distances, tangents
from stereo_sfm.calibration import rig_window_kernels
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Camera
from stereo_sfm.geometry.order_statistics import median
from stereo_sfm.geometry.stereo import rectifying_rotations
from stereo_sfm.types import F64, I64, RIG_TERMS, Keyframe

# Of a window: so many leave seven rows for each of its unknowns; more say little, as windows have errors of their own.
MIN_POINTS, MAX_POINTS = 20, 160
STEPS = 4  # of Gauss-Newton: two that find what does not fit, two without it
DERIVATIVE = 1e-5  # radians or ratio: step of numerical derivatives, thousandths of a pixel
NOISE_PX = 0.05, 5.0  # px, limits of the estimated noise of one coordinate: of exact data, of none that fit
LENSES = slice(5, 8)  # focal ratio and decentering
LENGTHENING = 1, *range(RIG_TERMS)[LENSES]  # terms that trade lengths with one another: rotation about y, and these
# Prior standard deviations of the terms, radians, radians, ratio, radians: wide enough for a step of half a degree.
PRIOR = np.array([0.01, 0.01, 0.01, 0.005, 0.005, 0.005, 0.01, 0.01])

# Prior standard deviations of `_shapes`, px at the image's border.
LENS_PRIOR = np.array([6.0, 2.0, 2.0, 2.0, *[0.5] * 6])
SHARED_PRIOR = np.concatenate([PRIOR, LENS_PRIOR]) ** -2  # information, of both


@dataclass(frozen=True, eq=False)
class SeenPoints:
    """What is known of a keyframe without its images."""

    kf_id: int
    stamp_ns: int
    submap_id: int
    odom_T_cam: F64  # (4, 4)
    point_ids: I64  # (N,)
    uv_left: F64  # (N, 2) px
    uv_right: F64  # (N, 2) px, NaN where not seen

    @staticmethod
    def of(keyframe: Keyframe) -> SeenPoints:
        k = keyframe
        return SeenPoints(k.kf_id, k.stamp_ns, k.submap_id, k.odom_T_cam, k.point_ids, k.uv_left, k.uv_right)

    def every(self, step: int, first: int) -> SeenPoints:
        """With one in `step` of the points: those whose id is `first` modulo `step`."""
        kept = self.point_ids % step == first
        return replace(self, point_ids=self.point_ids[kept], uv_left=self.uv_left[kept], uv_right=self.uv_right[kept])


@dataclass(frozen=True, eq=False)
class RigInformation:
    """Information about the terms: of one window, or the sum of several."""

    matrix: F64  # (8, 8)
    vector: F64  # (8,) matrix @ (the terms that fit best)

    def gain(self, terms: F64, change: F64) -> float:
        """By how much a change (8,) of terms (8,) lowers the cost of rows and reprojections, in standard deviations."""
        size = change @ self.matrix @ change
        return float((2 * (self.vector - self.matrix @ terms) @ change - size) / np.sqrt(max(size, 1e-12)))


@dataclass(frozen=True, eq=False)
class RigWindow:
    """The result of one window."""

    first_kf_id: int
    last_kf_id: int
    stamp_ns: int  # of the last keyframe
    information: RigInformation
    noise_px: float
    length: F64  # (8,) relative change of lengths by each of the LENGTHENING terms, per radian or ratio; others zero
    turn: F64  # (3,) radians from the first to the last keyframe

    def turned(self, change: F64) -> RigWindow:
        """If the rig's terms had been others, by `change` (8,)."""
        matrix, vector = self.information.matrix, self.information.vector
        return replace(self, information=RigInformation(matrix, vector + matrix @ change))


@dataclass(eq=False)
class _Problem:
    """One window's measurements and its own unknowns."""

    uv_left: F64  # (F, N, 2) px
    uv_right: F64  # (F, N, 2) px
    bearing: F64  # (N, 3) unit, first left camera
    rho: F64  # (N,) 1/m
    frame_T_first: F64  # (F, 4, 4)
    shapes: F64  # (2, F, N, 2, L) px
    lens: F64  # (L,)


def solve_window(rig: Rig, keyframes: Sequence[SeenPoints], terms: F64) -> RigWindow | None:
    """The information of a window, or None if its keyframes have too few common points.

    Args:
        rig: the calibrated rig. keyframes: in order of time. terms: (8,) initial corrections.
    """
    corrected = with_terms(rig, terms)
    problem = _problem(corrected, keyframes)
    if problem is None:
        return None
    sigma = 1.0
    for step in range(STEPS):
        system = _System.of(corrected, problem, sigma, hard=step >= 2)
        sigma = system.noise_px
        terms = terms + system.step(problem, terms)
        if not np.isfinite(terms).all():
            return None
        corrected = with_terms(rig, terms)
    system = _System.of(corrected, problem, sigma, hard=True)
    information = system.information(problem, terms)
    last = keyframes[-1]
    length = _length_by_terms(rig, problem.uv_left[0], problem.uv_right[0])
    turn = se3.log(se3.inverse(keyframes[0].odom_T_cam) @ last.odom_T_cam)[3:]
    return RigWindow(keyframes[0].kf_id, last.kf_id, last.stamp_ns, information, system.noise_px, length, turn)


def _length_by_terms(rig: Rig, uv_left: F64, uv_right: F64) -> F64:
    """(8,) relative change by LENGTHENING terms of the motion that the rig measures with points (N, 2), least squares.

    Points move in the image by the step times their inverse distance rho: step ~ sum(rho flow) / sum(rho^2).
    """
    rho = inverse_distances(rig, uv_left, uv_right)
    used, out = np.isfinite(rho), np.zeros(RIG_TERMS)
    for k, changed in zip(LENGTHENING, _lengthened(rig), strict=True):
        change = inverse_distances(changed, uv_left, uv_right) - rho
        out[k] = (rho * change)[used & np.isfinite(change)].sum()
    return -out / (DERIVATIVE * max(float((rho[used] ** 2).sum()), 1e-12))


@functools.lru_cache(maxsize=1)
def _lengthened(rig: Rig) -> tuple[Rig, ...]:
    """The rig, which is the same for all windows of a run, with a little more of each of the LENGTHENING terms."""
    steps = DERIVATIVE * np.eye(RIG_TERMS)
    return tuple(with_terms(rig, steps[k]) for k in LENGTHENING)


def _problem(rig: Rig, keyframes: Sequence[SeenPoints]) -> _Problem | None:
    first = keyframes[0]
    both = np.isfinite(first.uv_left).all(1) & np.isfinite(first.uv_right).all(1)
    later = np.concatenate([k.point_ids for k in keyframes[1:]])
    ids = first.point_ids[both & np.isin(first.point_ids, later)]
    ids = ids[:: max(1, -(-len(ids) // MAX_POINTS))]
    if len(ids) < MIN_POINTS:
        return None
    uv = np.full((2, len(keyframes), len(ids), 2), np.nan)
    for f, keyframe in enumerate(keyframes):
        _, at, of = np.intersect1d(ids, keyframe.point_ids, assume_unique=True, return_indices=True)
        uv[0, f, at], uv[1, f, at] = keyframe.uv_left[of], keyframe.uv_right[of]
    bearing, rho = rig.left.unproject(uv[0, 0]), inverse_distances(rig, uv[0, 0], uv[1, 0])
    good = np.isfinite(bearing).all(1) & np.isfinite(rho)
    frames = np.array([se3.inverse(k.odom_T_cam) @ first.odom_T_cam for k in keyframes])
    uv = np.ascontiguousarray(uv[:, :, good])
    shapes = _shapes(rig.left, uv)
    return _Problem(uv[0], uv[1], bearing[good], rho[good], frames, shapes, np.zeros(len(LENS_PRIOR)))


def _shapes(camera: Camera, uv: F64) -> F64:
    """(..., 2, L) displacements of pixels by errors that both lenses may share, one pixel at the image's border.

    Magnification, the first radial order, a shift and the second orders: they bend the flow of a turning camera, which
    is similar to an error of disparity.
    """
    x, y = 2 * uv[..., 0] / camera.width - 1, (2 * uv[..., 1] - camera.height) / camera.width
    r2, one, zero = x * x + y * y, np.ones_like(x), np.zeros_like(x)
    u = [x, x * r2, one, zero, x * x, x * y, y * y, zero, zero, zero]
    v = [y, y * r2, zero, one, zero, zero, zero, x * x, x * y, y * y]
    return np.asarray(np.nan_to_num(np.stack([np.stack(u, -1), np.stack(v, -1)], -2)), float)


@dataclass(frozen=True, eq=False)
class _System:
    """Normal equations of the terms with the other unknowns eliminated, and their back-substitution."""

    matrix: F64  # (S, S) of the rig's terms and the lens's
    gradient: F64  # (S,)
    noise_px: float  # within NOISE_PX
    pose_gain: F64  # (6 (F - 1), S)
    pose_gradient: F64
    point_gain: F64  # (N, 3, R)
    point_gradient: F64  # (N, 3)
    tangent: F64  # (N, 3, 2) of the points' bearings

    @staticmethod
    def of(rig: Rig, problem: _Problem, sigma: float, hard: bool) -> _System:
        """The system at the problem's present state."""
        assert rig.right is not None
        count, frames = len(problem.rho), len(problem.frame_T_first)
        shared = RIG_TERMS + len(problem.lens)
        size = shared + 6 * (frames - 1)
        h, g = np.zeros((size, size)), np.zeros(size)
        gain, gradient = np.zeros((count, 3, size)), np.zeros((count, 3))
        squares, rows = np.zeros(count), np.zeros(count, np.int64)
        tangent, rotation = tangents(problem.bearing), rig.left_T_right[:3, :3]
        rect_R_left, _ = rectifying_rotations(rig.left_T_right)
        rig_window_kernels.accumulate(
            problem.uv_left, problem.uv_right, problem.bearing, tangent, problem.rho,
            np.ascontiguousarray(problem.frame_T_first[:, :3, :3]),
            np.ascontiguousarray(problem.frame_T_first[:, :3, 3]), problem.shapes, problem.lens,
            (rig.left.model_id, rig.left.params, rig.right.model_id, rig.right.params),
            np.ascontiguousarray(rotation.T), rig.left_T_right[:3, 3].copy(),
            np.ascontiguousarray(-rig.baseline * (rotation.T @ rect_R_left[1:].T)), sigma, hard,
            h, g, gain, gradient, squares, rows,
        )  # fmt: skip
        own = h[shared:, shared:] + 1e-6 * np.eye(size - shared)
        pose_gain = np.asarray(np.linalg.solve(own, h[shared:, :shared]), float)
        pose_gradient = np.asarray(np.linalg.solve(own, g[shared:]), float)
        across = h[:shared, shared:]
        matrix, reduced = h[:shared, :shared] - across @ pose_gain, g[:shared] - across @ pose_gradient
        return _System(
            0.5 * (matrix + matrix.T), reduced, _noise(squares, rows), pose_gain, pose_gradient, gain, gradient, tangent
        )

    def step(self, problem: _Problem, terms: F64) -> F64:
        """(8,) step of the terms, back-substituted into the window's lens, motion and points."""
        pulled = self.gradient + SHARED_PRIOR * np.concatenate([terms, problem.lens])
        delta = -np.linalg.solve(self.matrix + np.diag(SHARED_PRIOR), pulled)
        problem.lens = problem.lens + delta[RIG_TERMS:]
        pose = -(self.pose_gradient + self.pose_gain @ delta)
        step = -(self.point_gradient + self.point_gain @ np.concatenate([delta, pose]))
        turned = problem.bearing + (self.tangent @ step[:, :2, None])[..., 0]
        problem.bearing = turned / np.linalg.norm(turned, axis=1, keepdims=True)
        problem.rho = problem.rho + step[:, 2]
        problem.frame_T_first[1:] = se3.exp(pose.reshape(-1, 6)) @ problem.frame_T_first[1:]
        return np.asarray(delta[:RIG_TERMS], float)

    def information(self, problem: _Problem, terms: F64) -> RigInformation:
        """About the rig's terms alone, whatever the lens is."""
        own = self.matrix[RIG_TERMS:, RIG_TERMS:] + np.diag(LENS_PRIOR**-2)
        gain = np.linalg.solve(own, self.matrix[RIG_TERMS:, :RIG_TERMS]).T
        matrix = self.matrix[:RIG_TERMS, :RIG_TERMS] - gain @ self.matrix[RIG_TERMS:, :RIG_TERMS]
        gradient = self.gradient[:RIG_TERMS] - gain @ (self.gradient[RIG_TERMS:] + problem.lens / LENS_PRIOR**2)
        return RigInformation(matrix, matrix @ terms - gradient)


def _noise(squares: F64, rows: I64) -> float:
    """Noise of one coordinate: median over the points of their residuals, corrected for the median's bias.

    A point's three unknowns leave k of its rows free; the median of chi-squared with k degrees of freedom is
    k (1 - 2 / 9k)^3 (Wilson and Hilferty, PNAS 17, 1931).
    """
    usable = rows > 4
    if not usable.any():
        return NOISE_PX[1]
    free = rows[usable] - 3
    noise = median(np.sqrt(squares[usable] / free) / (1 - 2 / (9 * free)) ** 1.5)
    return min(max(NOISE_PX[0], noise), NOISE_PX[1])
