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
from stereo_sfm.calib.elimination import OUTLIER_SIGMAS, Eliminated, point_noise, robust_weights
from stereo_sfm.calib.rig import Rig
from stereo_sfm.calib.scene_model import inverse_distances, tangents
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Camera
from stereo_sfm.geometry.kernels import PINHOLE, RADTAN
from stereo_sfm.geometry.order_statistics import median
from stereo_sfm.geometry.stereo import rectifying_rotations
from stereo_sfm.tracking.flow.sudden_turn import MIN_POINTS
from stereo_sfm.types import F64, I64, RIG_TERMS, Bool, Keyframe

# Of a window, at most: more say little, as windows have errors of their own.
MAX_POINTS = 160
STEPS = 4  # of Gauss-Newton: two that find what does not fit, two without it
DERIVATIVE = 1e-5  # radians or ratio: step of numerical derivatives, thousandths of a pixel
NOISE_PX = 0.05, 5.0  # px, limits of the estimated noise of one coordinate: of exact data, of none that fit
LENSES = slice(5, 8)  # focal ratio and decentering
# Prior standard deviations of the terms, radians, radians, ratio, radians: wide enough for a step of half a degree.
PRIOR = np.array([0.01, 0.01, 0.01, 0.005, 0.005, 0.005, 0.01, 0.01])

# Prior standard deviations of `_shapes`, shares of half the width: focal lengths are known to half a percent.
LENS_PRIOR = np.array([5e-3, 3e-3, 3e-3, 3e-3, *[8e-4] * 6])
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
    length: F64  # (8,) relative change of lengths by each of the `_lengthening` terms, per radian or ratio; others zero
    turn: F64  # (3,) radians from the first to the last keyframe

    @property
    def across(self) -> int:
        """The term of the rotation that changes lengths: 1, about y, where one camera is beside the other."""
        return int(abs(self.length[1]) >= abs(self.length[0]))

    def turned(self, change: F64) -> RigWindow:
        """If the rig's terms had been others, by `change` (8,)."""
        matrix, vector = self.information.matrix, self.information.vector
        return replace(self, information=RigInformation(matrix, vector + matrix @ change))


@dataclass(eq=False)
class _Problem:
    """One window's measurements and its own unknowns."""

    uv: F64  # (N, F, 2, 2) px in the left and the right image; nothing in the right one without the left
    bearing: F64  # (N, 3) unit, first left camera
    rho: F64  # (N,) 1/m
    frame_T_first: F64  # (F, 4, 4)
    shapes: F64  # (N, F, 2, 2, L) px
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
        system, sigma = _equations(corrected, problem, sigma, hard=step >= 2)
        pulled = system.gradient + SHARED_PRIOR * np.concatenate([terms, problem.lens])
        delta = np.asarray(-np.linalg.solve(system.matrix + np.diag(SHARED_PRIOR), pulled), float)
        terms, problem.lens = terms + delta[:RIG_TERMS], problem.lens + delta[RIG_TERMS:]
        system.apply(delta, problem)
        if not np.isfinite(terms).all():
            return None
        corrected = with_terms(rig, terms)
    system, sigma = _equations(corrected, problem, sigma, hard=True)
    last = keyframes[-1]
    length = _length_by_terms(rig, problem.uv[:, 0, 0], problem.uv[:, 0, 1])
    turn = se3.log(se3.inverse(keyframes[0].odom_T_cam) @ last.odom_T_cam)[3:]
    information = _information(system, terms, problem.lens)
    return RigWindow(keyframes[0].kf_id, last.kf_id, last.stamp_ns, information, sigma, length, turn)


def _length_by_terms(rig: Rig, uv_left: F64, uv_right: F64) -> F64:
    """(8,) relative change by lengthening terms of the motion that the rig measures with points (N, 2): least squares.

    Points move in the image by the step times their inverse distance rho: step ~ sum(rho flow) / sum(rho^2).
    """
    rho = inverse_distances(rig, uv_left, uv_right)
    used, out = np.isfinite(rho), np.zeros(RIG_TERMS)
    for k, changed in _lengthening(rig).items():
        change = inverse_distances(changed, uv_left, uv_right) - rho
        out[k] = (rho * change)[used & np.isfinite(change)].sum()
    return -out / (DERIVATIVE * max(float((rho[used] ** 2).sum()), 1e-12))


@functools.lru_cache(maxsize=1)
def _lengthening(rig: Rig) -> dict[int, Rig]:
    """Terms that trade lengths with one another, rotation across the baseline and LENSES: the rig with more of each."""
    across = int(np.argmin(np.abs(rig.left_T_right[:2, 3])))
    return {k: with_terms(rig, DERIVATIVE * np.eye(RIG_TERMS)[k]) for k in (across, *range(RIG_TERMS)[LENSES])}


def _problem(rig: Rig, keyframes: Sequence[SeenPoints]) -> _Problem | None:
    first = keyframes[0]
    both = np.isfinite(first.uv_left).all(1) & np.isfinite(first.uv_right).all(1)
    later = np.concatenate([k.point_ids for k in keyframes[1:]])
    ids = first.point_ids[both & np.isin(first.point_ids, later)]
    ids = ids[:: max(1, -(-len(ids) // MAX_POINTS))]
    if len(ids) < MIN_POINTS:
        return None
    uv = np.full((len(ids), len(keyframes), 2, 2), np.nan)
    for f, keyframe in enumerate(keyframes):
        _, at, of = np.intersect1d(ids, keyframe.point_ids, assume_unique=True, return_indices=True)
        uv[at, f, 0], uv[at, f, 1] = keyframe.uv_left[of], keyframe.uv_right[of]
    uv[np.isnan(uv[:, :, 0, 0]), 1] = np.nan
    bearing, rho = rig.left.unproject(uv[:, 0, 0]), inverse_distances(rig, uv[:, 0, 0], uv[:, 0, 1])
    good = np.isfinite(bearing).all(1) & np.isfinite(rho)
    frames = np.array([se3.inverse(k.odom_T_cam) @ first.odom_T_cam for k in keyframes])
    uv = uv[good]
    return _Problem(uv, bearing[good], rho[good], frames, _shapes(rig.left, uv), np.zeros(len(LENS_PRIOR)))


def _shapes(camera: Camera, uv: F64) -> F64:
    """(..., 2, L) displacements of pixels by errors that both lenses may share, half the width at the image's border.

    Magnification, the first radial order, a shift and the second orders: they bend the flow of a turning camera, which
    is similar to an error of disparity.
    """
    side = max(camera.width, camera.height)
    x, y = 2 * uv[..., 0] / side - camera.width / side, (2 * uv[..., 1] - camera.height) / side
    r2, one, zero = x * x + y * y, np.ones_like(x), np.zeros_like(x)
    u = [x, x * r2, one, zero, x * x, x * y, y * y, zero, zero, zero]
    v = [y, y * r2, zero, one, zero, zero, zero, x * x, x * y, y * y]
    return np.asarray(0.5 * side * np.nan_to_num(np.stack([np.stack(u, -1), np.stack(v, -1)], -2)), float)


def _equations(rig: Rig, problem: _Problem, sigma: float, hard: bool) -> tuple[Eliminated, float]:
    """The equations of the rig's terms and the lens's at the problem's present state, and the noise of a coordinate.

    Args: sigma, px, the scale of Cauchy's loss: tracks' errors have long tails, and lean to one side there.
    """
    residual, by_point, by_rest = _linearised(rig, problem)
    weight = robust_weights(residual, sigma, OUTLIER_SIGMAS * sigma if hard else np.inf) / sigma**2
    sizes = point_noise(residual)
    noise = float(np.clip(median(sizes), *NOISE_PX)) if len(sizes) else NOISE_PX[1]
    return Eliminated.of(residual, by_point, by_rest, weight, len(SHARED_PRIOR)), noise


def _linearised(rig: Rig, problem: _Problem) -> tuple[F64, F64, F64]:
    """Residuals (N, 4 F), derivatives of the prediction by the point (N, 4 F, 3) and by the other unknowns (N, 4 F, R).

    The other unknowns are the rig's terms, the lens's, and left perturbations of all moments' poses but the first's.
    """
    assert rig.right is not None
    count, frames = problem.uv.shape[:2]
    shared, rho = len(SHARED_PRIOR), problem.rho[:, None, None]
    rotation, t = rig.left_T_right[:3, :3], rig.left_T_right[:3, 3]
    by_direction = -rig.baseline * (rotation.T @ rectifying_rotations(rig.left_T_right)[0][1:].T)
    turn, pos = problem.frame_T_first[:, :3, :3], problem.frame_T_first[:, :3, 3]
    p = (turn @ problem.bearing[:, None, :, None])[..., 0] + rho * pos  # (N, F, 3), scaled by rho
    q = (p - rho * t) @ rotation
    by_rho = np.broadcast_to(pos[..., None], (count, frames, 3, 1))
    p_point = np.concatenate([turn @ tangents(problem.bearing)[:, None], by_rho], -1)
    q_point = rotation.T @ np.concatenate([p_point[..., :2], p_point[..., 2:] - t[:, None]], -1)
    uv_left, left = rig.left.project_jacobian(p)
    uv_right, right = rig.right.project_jacobian(q)
    uv, by_point = np.stack([uv_left, uv_right], 2), np.stack([left @ p_point, right @ q_point], 2)
    by_rest = np.zeros((count, frames, 2, 2, shared + 6 * (frames - 1)))
    by_rest[..., RIG_TERMS:shared] = problem.shapes
    of_right = by_rest[:, :, 1]
    of_right[..., :3] = right @ se3.skew(q)
    of_right[..., 3:5] = rho[..., None] * (right @ by_direction)
    of_right[..., 5] = uv_right - rig.right.params[2:4]
    if rig.left.model_id == PINHOLE and rig.right.model_id <= RADTAN:  # a calibrated distortion has its decentering
        a, b = q[..., 0] / q[..., 2], q[..., 1] / q[..., 2]
        shifted = np.stack([np.stack([-b * b, -a * b], -1), np.stack([a * b, a * a], -1)], -2)
        of_right[..., 6:8] = rig.right.params[:2, None] * shifted
    by_pose = np.concatenate([rho[..., None] * np.broadcast_to(np.eye(3), (*p.shape, 3)), -se3.skew(p)], -1)
    both = np.stack([left @ by_pose, right @ rotation.T @ by_pose], 2)
    for f in range(1, frames):
        by_rest[:, f, :, :, shared + 6 * (f - 1) : shared + 6 * f] = both[:, f]
    residual = problem.uv - uv - problem.shapes @ problem.lens
    missing: Bool = np.isnan(residual[..., 0]) | np.isnan(residual[..., 1])
    missing[..., 1] |= missing[..., 0]
    residual[missing], by_point[missing], by_rest[missing] = np.nan, 0.0, 0.0
    return residual.reshape(count, -1), by_point.reshape(count, -1, 3), by_rest.reshape(count, 4 * frames, -1)


def _information(system: Eliminated, terms: F64, lens: F64) -> RigInformation:
    """About the rig's terms alone, whatever the lens is."""
    own = system.matrix[RIG_TERMS:, RIG_TERMS:] + np.diag(LENS_PRIOR**-2)
    gain = np.linalg.solve(own, system.matrix[RIG_TERMS:, :RIG_TERMS]).T
    matrix = system.matrix[:RIG_TERMS, :RIG_TERMS] - gain @ system.matrix[RIG_TERMS:, :RIG_TERMS]
    gradient = system.gradient[:RIG_TERMS] - gain @ (system.gradient[RIG_TERMS:] + lens / LENS_PRIOR**2)
    return RigInformation(matrix, matrix @ terms - gradient)
