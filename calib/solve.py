"""Calibration of one or two cameras from views of a flat target: initialization, bundle adjustment, covariance.

Unknowns are each camera's focal lengths, principal point and distortion, the transform between the cameras, and the
target's pose in every view. Levenberg-Marquardt with analytic derivatives and Huber weights; outlier corners and views
are removed and the fit is repeated (Triggs et al., Bundle Adjustment - A Modern Synthesis, 1999, sections 3 and 4).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.calib.targets import Detection
from stereo_sfm.errors import StereoSfmError, one_of
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Camera, KannalaBrandt, RadTan
from stereo_sfm.geometry.param_jacobian import parameter_jacobian, parameter_vector, with_parameters
from stereo_sfm.types import F64, I64, Bool

MODELS = {"pinhole": 5, "rational": 8, "kb4": 4}  # name -> number of distortion coefficients
MIN_CORNERS = 8  # in a view


@dataclass(frozen=True, eq=False)
class Observed:
    """All corners of all views, one row each."""

    view: I64  # (M,)
    side: I64  # (M,) 0 left, 1 right
    point: F64  # (M, 3) on the target, metres
    uv: F64  # (M, 2) px

    def where(self, mask: Bool) -> Observed:
        """The rows selected by a mask."""
        return Observed(self.view[mask], self.side[mask], self.point[mask], self.uv[mask])


@dataclass(frozen=True, eq=False)
class Calibration:
    """The result of `solve`."""

    rig: Rig
    left_T_target: F64  # (V, 4, 4)
    observed: Observed  # the corners used
    residual: F64  # (M, 2) px, measured minus predicted
    sigma: F64  # (S,) standard deviations of the parameters, in the order of `names`
    names: tuple[str, ...]
    removed_corners: int
    removed_views: int

    @property
    def rms(self) -> float:
        """Root mean square reprojection error of a corner (distance), px."""
        return float(np.sqrt((self.residual**2).sum(1).mean()))


def calibrate(
    left: list[Detection], right: list[Detection] | None, points: F64, size: tuple[int, int], model: str = "pinhole"
) -> Calibration:
    """Calibrate a camera or a stereo rig.

    Args:
        left: one detection per view, empty where the target is not visible. right: the same, None for one camera.
        points: (N, 3) the target's corners by number.
        size: (width, height) px of both cameras.
        model: pinhole (5 coefficients), rational (8), kb4.

    Raises:
        StereoSfmError: too few views, or the initialization fails.
    """
    one_of(model, MODELS, "lens model")
    observed = _gather(left, right, points)
    n_cameras = 1 if right is None else 2
    for side in range(n_cameras):
        if len(np.unique(observed.view[observed.side == side])) < 4:
            which = ("left", "right")[side]
            raise StereoSfmError(f"the {which} camera sees the target in fewer than 4 views: take more images")
    cameras = [_single(observed.where(observed.side == e), size, model) for e in range(n_cameras)]
    count = len(left)
    left_T_right = np.eye(4)
    poses = [_poses(observed.where(observed.side == e), c, count) for e, c in enumerate(cameras)]
    if n_cameras == 2:
        left_T_right = _relative(poses[0], poses[1])
        missing = np.isnan(poses[0][:, 0, 0])
        poses[0][missing] = left_T_right @ poses[1][missing]
    state = _State(cameras, left_T_right, poses[0])
    return _robust(state, observed, n_cameras)


def _gather(left: list[Detection], right: list[Detection] | None, points: F64) -> Observed:
    views: list[I64] = []
    sides: list[I64] = []
    xyz: list[F64] = []
    uv: list[F64] = []
    for side, detections in enumerate([left] if right is None else [left, right]):
        for v, d in enumerate(detections):
            if len(d) >= MIN_CORNERS:
                views.append(np.full(len(d), v, np.int64))
                sides.append(np.full(len(d), side, np.int64))
                xyz.append(points[d.ids])
                uv.append(d.uv)
    if not uv:
        raise StereoSfmError("the target was not found in any image: check its type, columns, rows and dictionary")
    return Observed(np.concatenate(views), np.concatenate(sides), np.concatenate(xyz), np.concatenate(uv))


@dataclass(eq=False)
class _State:
    cameras: list[Camera]
    left_T_right: F64
    left_T_target: F64  # (V, 4, 4)


def _single(observed: Observed, size: tuple[int, int], model: str) -> Camera:
    """One camera, initialized with the best of several focal lengths."""
    width, height = size
    kind = KannalaBrandt if model == "kb4" else RadTan
    found: list[tuple[float, _State]] = []
    for fraction in (0.3, 0.4, 0.55, 0.75, 1.0, 1.4):
        focal = fraction * width
        camera = kind(width, height, focal, focal, 0.5 * (width - 1), 0.5 * (height - 1), (0.0,) * MODELS[model])
        poses = _poses(observed, camera, int(observed.view.max()) + 1)
        state = _State([camera], np.eye(4), poses)
        usable = observed.where(np.isfinite(poses[observed.view, 0, 0]))
        if len(np.unique(usable.view)) < 3:
            continue
        few = usable.where(np.isin(usable.view, np.unique(usable.view)[:12]))
        cost = _minimise(state, few, 1, iterations=12, free=4 + min(2, MODELS[model]))
        found.append((cost, state))
    if not found:
        raise StereoSfmError("no focal length fits the views: check the layout of the target")
    state = min(found, key=lambda f: f[0])[1]
    _minimise(state, observed.where(np.isfinite(state.left_T_target[observed.view, 0, 0])), 1, iterations=25)
    return state.cameras[0]


def _poses(observed: Observed, camera: Camera, count: int) -> F64:
    """(count, 4, 4) camera_T_target of each view by a homography of bearings, NaN where there is none."""
    out = np.full((count, 4, 4), np.nan)
    for v in np.unique(observed.view):
        rows = observed.view == v
        out[v] = plane_pose(camera.unproject(observed.uv[rows]), observed.point[rows])
    return out


def plane_pose(bearings: F64, points: F64) -> F64:
    """Pose of a flat target from bearings: b x (H (x, y, 1)) = 0, at any field of view.

    Args:
        bearings: (K, 3) unit. points: (K, 3) with z = 0.

    Returns:
        (4, 4) camera_T_target, NaN where fewer than six corners have a bearing.
    """
    good = np.isfinite(bearings).all(1)
    if good.sum() < 6:
        return np.full((4, 4), np.nan)
    b, xy = bearings[good], points[good, :2]
    centre, scale = xy.mean(0), max(float(np.abs(xy - xy.mean(0)).max()), 1e-9)
    plane = np.column_stack([(xy - centre) / scale, np.ones(len(xy))])
    rows = (se3.skew(b)[:, :, :, None] * plane[:, None, None, :]).reshape(-1, 9)
    h = np.linalg.svd(rows, full_matrices=False)[2][-1].reshape(3, 3)
    if np.median(np.einsum("ki,ij,kj->k", b, h, plane)) < 0:
        h = -h
    h = h @ np.array([[1 / scale, 0, -centre[0] / scale], [0, 1 / scale, -centre[1] / scale], [0, 0, 1]])
    size = np.sqrt(np.linalg.norm(h[:, 0]) * np.linalg.norm(h[:, 1]))
    x, y, t = (h / max(size, 1e-12)).T
    rotation = np.column_stack([x, y, np.cross(x, y)])
    u, _, vt = np.linalg.svd(rotation)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt, t
    return pose


def _relative(left: F64, right: F64) -> F64:
    """left_T_right of the view that agrees best with all others."""
    both = np.flatnonzero(np.isfinite(left[:, 0, 0]) & np.isfinite(right[:, 0, 0]))
    if len(both) < 3:
        raise StereoSfmError("both cameras see the target at once in fewer than 3 views: take more images")
    candidates = left[both] @ se3.inverse(right[both])
    spread = [float(np.median(np.linalg.norm(se3.log(se3.inverse(c) @ candidates), axis=1))) for c in candidates]
    return candidates[int(np.argmin(spread))]


def _robust(state: _State, observed: Observed, n_cameras: int) -> Calibration:
    """Fit, remove outliers, fit again."""
    observed = observed.where(np.isfinite(state.left_T_target[observed.view, 0, 0]))
    total, views = len(observed.view), len(np.unique(observed.view))
    for _ in range(3):
        _minimise(state, observed, n_cameras, iterations=30)
        residual = _residual(state, observed)
        size = np.linalg.norm(residual, axis=1)
        typical = float(np.median(size)) / 1.177  # of one coordinate: the median of a Rayleigh distribution
        keep = size < max(5 * typical, 0.3)
        for v in np.unique(observed.view):
            for e in range(n_cameras):
                rows = (observed.view == v) & (observed.side == e)
                if rows.any() and (keep & rows).sum() < max(MIN_CORNERS, 0.6 * rows.sum()):
                    keep &= ~rows
        if keep.all():
            break
        observed = observed.where(keep)
        if len(np.unique(observed.view)) < 4:
            raise StereoSfmError("the views are inconsistent: check the size, columns and rows of the target")
    hessian, _, _, noise = _normal(state, observed, n_cameras, huber=np.inf)
    shared = _shared_count(state, n_cameras)
    covariance = np.linalg.inv(hessian + 1e-12 * np.eye(len(hessian)))[:shared, :shared] * noise**2
    kept_views = np.unique(observed.view)
    rig = Rig(state.cameras[0], state.cameras[1] if n_cameras == 2 else None, state.left_T_right)
    return Calibration(
        rig,
        state.left_T_target,
        observed,
        _residual(state, observed),
        np.sqrt(np.maximum(np.diag(covariance), 0)),
        _names(state, n_cameras),
        total - len(observed.view),
        views - len(kept_views),
    )


def _names(state: _State, n_cameras: int) -> tuple[str, ...]:
    coefficient = state.cameras[0].coefficients
    names: list[str] = []
    for side in ("left", "right")[:n_cameras]:
        own = ("fx", "fy", "cx", "cy", *coefficient[: len(state.cameras[0].distortion)])
        names += [f"{side} {n}" for n in own]
    if n_cameras == 2:
        names += [f"left_T_right {n}" for n in ("tx", "ty", "tz", "rx", "ry", "rz")]
    return tuple(names)


def _shared_count(state: _State, n_cameras: int) -> int:
    return sum(4 + len(c.distortion) for c in state.cameras) + (6 if n_cameras == 2 else 0)


def _residual(state: _State, observed: Observed) -> F64:
    """(M, 2) px."""
    out = np.full_like(observed.uv, np.nan)
    in_left = se3.transform(state.left_T_target[observed.view], observed.point[:, None])[:, 0]
    for side, camera in enumerate(state.cameras):
        rows = observed.side == side
        p = in_left[rows] if side == 0 else se3.transform(se3.inverse(state.left_T_right), in_left[rows])
        out[rows] = observed.uv[rows] - camera.project(p)
    return np.nan_to_num(out, nan=50.0)


def _normal(state: _State, observed: Observed, n_cameras: int, huber: float) -> tuple[F64, F64, float, float]:
    """Gauss-Newton matrix and gradient (shared unknowns, then view poses), cost, and noise of a coordinate in px."""
    shared = _shared_count(state, n_cameras)
    views, index = np.unique(observed.view, return_inverse=True)
    size = shared + 6 * len(views)
    hessian, gradient = np.zeros((size, size)), np.zeros(size)
    residual = _residual(state, observed)
    norm = np.linalg.norm(residual, axis=1)
    weight = np.where(norm > huber, huber / np.maximum(norm, 1e-12), 1.0)
    cost = float(np.where(norm > huber, huber * (2 * norm - huber), norm**2).sum())
    in_left = se3.transform(state.left_T_target[observed.view], observed.point[:, None])[:, 0]
    right_R_left, offset = state.left_T_right[:3, :3].T, 0
    for side, camera in enumerate(state.cameras):
        own = 4 + len(camera.distortion)
        mine = np.flatnonzero(observed.side == side)
        mine = mine[np.argsort(index[mine], kind="stable")]
        p = in_left[mine]
        q = p if side == 0 else se3.transform(se3.inverse(state.left_T_right), p)
        _, by_point = camera.project_jacobian(q)
        by_left = by_point if side == 0 else by_point @ right_R_left
        by_shared, where = [parameter_jacobian(camera, q)], [np.arange(offset, offset + own)]
        if side == 1:  # left_T_right exp(xi): q moves by -(rho + phi x q)
            by_shared.append(np.concatenate([-by_point, by_point @ se3.skew(q)], -1))
            where.append(np.arange(shared - 6, shared))
        by_pose = np.concatenate([by_left, -by_left @ se3.skew(p)], -1)  # exp(xi) left_T_target
        jac = np.nan_to_num(np.concatenate([*by_shared, by_pose], -1))
        weighted = jac * weight[mine, None, None]
        ends = np.searchsorted(index[mine], np.arange(len(views) + 1))
        for k in range(len(views)):
            rows = slice(ends[k], ends[k + 1])
            block, heavy = jac[rows].reshape(-1, jac.shape[2]), weighted[rows].reshape(-1, jac.shape[2])
            columns = np.concatenate([*where, np.arange(shared + 6 * k, shared + 6 * k + 6)])
            hessian[np.ix_(columns, columns)] += block.T @ heavy
            gradient[columns] -= heavy.T @ residual[mine[rows]].ravel()
        offset += own
    free = max(2 * len(norm) - size, 1)
    return hessian, gradient, cost, float(np.sqrt((norm**2).sum() / free))


def _stepped(state: _State, observed: Observed, n_cameras: int, step: F64) -> _State:
    shared = _shared_count(state, n_cameras)
    cameras: list[Camera] = []
    offset = 0
    for camera in state.cameras:
        own = 4 + len(camera.distortion)
        cameras.append(with_parameters(camera, parameter_vector(camera) + step[offset : offset + own]))
        offset += own
    left_T_right = state.left_T_right @ se3.exp(step[shared - 6 : shared]) if n_cameras == 2 else state.left_T_right
    poses = state.left_T_target.copy()
    views = np.unique(observed.view)
    poses[views] = se3.exp(step[shared:].reshape(-1, 6)) @ poses[views]
    return _State(cameras, left_T_right, poses)


def _minimise(state: _State, observed: Observed, n_cameras: int, iterations: int, free: int | None = None) -> float:
    """Levenberg-Marquardt in place; returns the mean robust cost. With `free` later parameters are fixed."""
    huber, damping = 2.0, 1e-3
    held = np.arange(free, _shared_count(state, n_cameras)) if free is not None else np.zeros(0, int)
    hessian, gradient, cost, _ = _normal(state, observed, n_cameras, huber)
    for _ in range(iterations):
        damped = hessian + np.diag(damping * np.maximum(np.diag(hessian), 1e-9))
        step = -gradient.copy()
        damped[held], damped[:, held], step[held] = 0.0, 0.0, 0.0
        damped[held, held] = 1.0
        try:
            step = np.asarray(np.linalg.solve(damped, step), float)
        except np.linalg.LinAlgError:
            damping *= 10
            continue
        if not _sane(state, step):
            damping *= 10
            continue
        trial = _stepped(state, observed, n_cameras, step)
        new = _normal(trial, observed, n_cameras, huber)
        if np.isfinite(new[2]) and new[2] < cost:
            done = cost - new[2] < 1e-9 * cost
            state.cameras, state.left_T_right, state.left_T_target = (
                trial.cameras,
                trial.left_T_right,
                trial.left_T_target,
            )
            hessian, gradient, cost, _ = new
            damping = max(damping / 5, 1e-9)
            if done:
                break
        else:
            damping *= 6
            if damping > 1e8:
                break
    return cost / max(len(observed.view), 1)


def _sane(state: _State, step: F64) -> bool:
    """Whether the focal lengths are positive and within a plausible range of the image size."""
    offset = 0
    for camera in state.cameras:
        fx, fy = camera.fx + step[offset], camera.fy + step[offset + 1]
        if min(fx, fy) < 0.1 * camera.width or max(fx, fy) > 10 * camera.width:
            return False
        offset += 4 + len(camera.distortion)
    return bool(np.isfinite(step).all())


def align_pairs(left: list[Detection], right: list[Detection]) -> list[Detection]:
    """Right detections of a symmetric board, reversed where their order starts at the opposite corner."""
    out: list[Detection] = []
    for a, b in zip(left, right, strict=True):
        if len(a) and len(a) == len(b) and float((a.uv[-1] - a.uv[0]) @ (b.uv[-1] - b.uv[0])) < 0:
            b = replace(b, uv=b.uv[::-1].copy())
        out.append(b)
    return out
