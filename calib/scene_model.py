"""Predicted observations of points seen by both cameras at several moments, with derivatives.

The unknowns of extrinsics and lenses form one vector, shared by all windows; see `calib.consistency`.
"""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.calib.tracks import Window
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Camera, Pinhole, RadTan
from stereo_sfm.geometry.kernels import njit
from stereo_sfm.geometry.stereo import rectifying_rotations
from stereo_sfm.types import F64, Bool

ROTATION, DIRECTION, FOCAL, FOCAL_RIGHT, SKEW = slice(0, 3), slice(3, 5), 5, 6, 7
NUISANCE = 10  # terms of one camera's lens displacement
SHARED = 8 + 2 * NUISANCE


@dataclass(eq=False)
class Problem:
    """The measurements and the unknowns of one window."""

    left: F64  # (F, N, 2)
    right: F64
    velocity: F64  # zero where unknown
    bearing: F64  # (N, 3) unit, in the first left image
    rho: F64  # (N,) inverse distance
    frame_T_first: F64  # (F, 4, 4) motion of the left camera
    weight: F64  # (N, 4 F) of each row


def moved(rig: Rig, vector: F64) -> Rig:
    """The rig with corrected rotation, baseline direction and focal lengths; skew and lens displacement are ignored."""
    assert rig.right is not None
    rect_R_left, _ = rectifying_rotations(rig.left_T_right)
    t = rig.left_T_right[:3, 3] + rig.baseline * (vector[DIRECTION] @ rect_R_left[1:])
    transform = np.eye(4)
    transform[:3, :3] = rig.left_T_right[:3, :3] @ se3.so3_exp(vector[ROTATION])
    transform[:3, 3] = t * (rig.baseline / np.linalg.norm(t))
    left = _focal(rig.left, float(np.exp(vector[FOCAL])))
    right = _focal(rig.right, float(np.exp(vector[FOCAL] + vector[FOCAL_RIGHT])))
    return replace(rig, left=left, right=right, left_T_right=transform)


def decentered(rig: Rig, along_x: float, along_y: float) -> Rig:
    """The rig with the right lens decentered relative to the left: tangential distortion p2 = -along_x, p1 = along_y.

    Tangential distortion is mostly a rotation and a shift (Brown, Photogrammetric Engineering 32, 1966). Both are
    removed, so that what is left shifts a pixel at (x, y) times the focal length from the principal point by
    along_x (-y^2, x y) + along_y (-x y, x^2), of which stereo sees the vertical part. The rotation's second order is
    removed by focal lengths and radial distortion. Fisheye models have no such terms and stay.
    """
    right = rig.right
    if not (along_x or along_y) or not isinstance(right, Pinhole | RadTan):
        return rig
    about_x, about_y = -3.0 * along_y, -3.0 * along_x
    k1, k2, p1, p2, *rest = (*right.distortion, 0.0, 0.0, 0.0, 0.0)[: max(4, len(right.distortion))]
    second = about_x**2, about_y**2
    distortion = (k1 + sum(second), k2, p1 + along_y, p2 - along_x, *rest)
    fx, fy = right.fx * (1 + second[1]), right.fy * (1 + second[0])
    cx, cy = right.cx + right.fx * about_y, right.cy - right.fy * about_x
    transform = rig.left_T_right.copy()
    transform[:3, :3] = transform[:3, :3] @ se3.so3_exp(np.array([about_x, about_y, 0.0]))
    lens = type(right) if isinstance(right, RadTan) else RadTan
    return replace(rig, right=lens(right.width, right.height, fx, fy, cx, cy, distortion), left_T_right=transform)


def _focal(camera: Camera, factor: float) -> Camera:
    return camera if factor == 1.0 else replace(camera, fx=camera.fx * factor, fy=camera.fy * factor)


def in_both(window: Window) -> Bool:
    """(N,) the points that both cameras see at the first moment."""
    return np.isfinite(window.left[0]).all(1) & np.isfinite(window.right[0]).all(1)


def inverse_distances(rig: Rig, left: F64, right: F64) -> F64:
    """(N,) 1/m along the left rays of pixels (N, 2) in both images, negative beyond infinity, NaN outside a lens.

    (b - rho t) seen from the right camera is parallel to its bearing r: r x R'b = rho r x R't, least squares in rho.
    """
    assert rig.right is not None
    bearing, in_right = rig.left.unproject(left), rig.right.unproject(right)
    rotation, t = rig.left_T_right[:3, :3], rig.left_T_right[:3, 3]
    return _inverse_distances(bearing @ rotation, in_right, t @ rotation)


@njit
def _inverse_distances(bearing, in_right, t):
    """(N,) 1/m, all in the right camera's axes; bearings (N, 3) of both cameras, t (3,)."""
    out = np.empty(len(bearing))
    t0, t1, t2 = t
    for i in range(len(bearing)):
        b0, b1, b2 = bearing[i]
        r0, r1, r2 = in_right[i]
        a0, a1, a2 = r1 * b2 - r2 * b1, r2 * b0 - r0 * b2, r0 * b1 - r1 * b0
        c0, c1, c2 = r1 * t2 - r2 * t1, r2 * t0 - r0 * t2, r0 * t1 - r1 * t0
        out[i] = (a0 * c0 + a1 * c1 + a2 * c2) / max(c0 * c0 + c1 * c1 + c2 * c2, 1e-12)
    return out


def make_problem(rig: Rig, window: Window) -> Problem:
    seen = in_both(window)
    left, right = window.left[:, seen], window.right[:, seen]
    velocity = np.nan_to_num(window.right_velocity[:, seen])
    bearing = rig.left.unproject(left[0])
    rho = inverse_distances(rig, left[0], right[0])
    frames = np.broadcast_to(np.eye(4), (len(left), 4, 4)).copy()
    problem = Problem(left, right, velocity, bearing, rho, frames, np.ones((len(bearing), 4 * len(left))))
    for f in range(1, len(left)):
        frames[f] = _first_pose(rig.left, left[f], bearing, rho, frames[f - 1])
    return problem


def part(problem: Problem, points: slice) -> Problem:
    """The window with a subset of its points."""
    return Problem(
        problem.left[:, points], problem.right[:, points], problem.velocity[:, points], problem.bearing[points].copy(),
        problem.rho[points].copy(), problem.frame_T_first.copy(), problem.weight[points].copy(),
    )  # fmt: skip


def _first_pose(camera: Camera, uv: F64, bearing: F64, rho: F64, pose: F64) -> F64:
    """frame_T_first (4, 4) by robust Gauss-Newton on the left images with fixed points, from `pose`."""
    seen = np.isfinite(uv[:, 0]) & (np.abs(rho) < 1e3)
    uv, bearing, rho = uv[seen], bearing[seen], rho[seen]
    for _ in range(20):
        p = bearing @ pose[:3, :3].T + rho[:, None] * pose[:3, 3]
        predicted, jac = camera.project_jacobian(p)
        residual = uv - predicted
        good = np.isfinite(residual).all(1)
        if good.sum() < 6:
            return pose
        j = np.concatenate([jac * rho[:, None, None], -jac @ se3.skew(p)], -1)[good]
        r = residual[good]
        size = np.linalg.norm(r, axis=1)
        scale = max(float(np.median(size)), 0.3)
        w = (1 / (1 + (size / scale) ** 2))[:, None]
        h = np.einsum("nij,nik,ni->jk", j, j, np.broadcast_to(w, r.shape)) + 1e-6 * np.eye(6)
        step = np.linalg.solve(h, np.einsum("nij,ni->j", j, r * w))
        pose = se3.exp(step) @ pose
    return pose


def displacement(camera: Camera, uv: F64) -> F64:
    """(N, 2, NUISANCE) smooth displacement fields of about one pixel at the image border.

    A shift, all second-order terms and the first two radial ones: the leading errors of a lens model.
    """
    x, y = 2 * uv[:, 0] / camera.width - 1, 2 * uv[:, 1] / camera.height - 1
    one, zero = np.ones_like(x), np.zeros_like(x)
    aspect = camera.height / camera.width
    r2 = x * x + (aspect * y) ** 2
    u = [one, zero, x * x, x * y, y * y, zero, zero, zero, x * r2, x * r2 * r2]
    v = [zero, one, zero, zero, zero, x * x, x * y, y * y, aspect * y * r2, aspect * y * r2 * r2]
    return np.stack([np.stack(u, -1), np.stack(v, -1)], 1)


def linearised(rig: Rig, problem: Problem, vector: F64) -> tuple[F64, F64, F64]:
    """Residuals (N, 4 F), derivatives of the prediction by the point (N, 4 F, 3) and by the other unknowns (N, 4 F, R).

    The other unknowns are the shared vector and the poses of all moments but the first, R = SHARED + 6 (F - 1).
    """
    assert rig.right is not None
    count, frames = len(problem.bearing), len(problem.left)
    residual = np.full((count, 4 * frames), np.nan)
    by_point = np.zeros((count, 4 * frames, 3))
    by_rest = np.zeros((count, 4 * frames, SHARED + 6 * (frames - 1)))
    rotation, t = rig.left_T_right[:3, :3], rig.left_T_right[:3, 3]
    rect_R_left, _ = rectifying_rotations(rig.left_T_right)
    by_direction = -rig.baseline * (rotation.T @ rect_R_left[1:].T)  # (3, 2) of rho-scaled right coordinates
    tangent = tangents(problem.bearing)
    rho = problem.rho[:, None]
    for f in range(frames):
        move = problem.frame_T_first[f]
        p = problem.bearing @ move[:3, :3].T + rho * move[:3, 3]
        q = (p - rho * t) @ rotation
        p_point = np.concatenate([move[:3, :3] @ tangent, np.broadcast_to(move[:3, 3, None], (count, 3, 1))], -1)
        q_point = rotation.T @ np.concatenate([p_point[..., :2], p_point[..., 2:] - t[:, None]], -1)
        p_pose = np.concatenate([rho[..., None] * np.eye(3), -se3.skew(p)], -1)
        for side, camera, points, point_d in ((0, rig.left, p, p_point), (1, rig.right, q, q_point)):
            rows = slice(4 * f + 2 * side, 4 * f + 2 * side + 2)
            seen = problem.right[f] if side else problem.left[f]
            uv, jac = camera.project_jacobian(points)
            shape = displacement(camera, np.nan_to_num(seen))
            own = slice(8 + side * NUISANCE, 8 + (side + 1) * NUISANCE)
            predicted = uv + shape @ vector[own]
            by_point[:, rows] = jac @ point_d
            rest = by_rest[:, rows]
            rest[..., own] = shape
            rest[..., FOCAL] = uv - [camera.cx, camera.cy]
            pose = slice(SHARED + 6 * (f - 1), SHARED + 6 * f)
            if side:
                predicted = predicted + vector[SKEW] * problem.velocity[f]
                rest[..., FOCAL_RIGHT] = rest[..., FOCAL]
                rest[..., SKEW] = problem.velocity[f]
                rest[..., ROTATION] = jac @ se3.skew(q)
                rest[..., DIRECTION] = (jac @ by_direction) * rho[..., None]
            if f:
                rest[..., pose] = jac @ (rotation.T @ p_pose if side else p_pose)
            residual[:, rows] = seen - predicted
    missing = ~np.isfinite(residual) | ~np.isfinite(by_point).all(2) | ~np.isfinite(by_rest).all(2)
    by_point[missing], by_rest[missing], residual[missing] = 0.0, 0.0, np.nan
    return residual, by_point, by_rest


@njit
def tangents(bearing):
    """(N, 3, 2) two unit vectors perpendicular to each bearing (N, 3)."""
    out = np.empty((len(bearing), 3, 2))
    for i in range(len(bearing)):
        x, y, z = bearing[i]
        u, v, w = (0.0, z, -y) if abs(x) < 0.9 else (-z, 0.0, x)  # bearing x (an axis)
        size = math.sqrt(u * u + v * v + w * w)
        u, v, w = u / size, v / size, w / size
        out[i, 0, 0], out[i, 1, 0], out[i, 2, 0] = u, v, w
        out[i, 0, 1], out[i, 1, 1], out[i, 2, 1] = y * w - z * v, z * u - x * w, x * v - y * u
    return out
