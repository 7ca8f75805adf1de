"""The second-order deformation of the image of a small plane, which the affine alignment of a window leaves out.

A window is aligned with its first appearance by an affine warp. The image of a plane through a perspective or a fisheye
lens is not affine: on surfaces seen at a grazing angle the quadratic part moves the aligned window against its centre
by up to a tenth of a pixel, always the same way while the camera approaches, and the path comes out too short. The
motion between the two images and the affine warp determine the plane, and the plane the quadratic part.
"""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false, reportMissingTypeArgument=false

from __future__ import annotations

import numpy as np

from stereo_sfm.geometry.cameras import Camera
from stereo_sfm.geometry.kernels import njit, project_one
from stereo_sfm.geometry.se3_kernels import dot, transform_point
from stereo_sfm.types import F64

STEP = 5.0  # px of the differences
# From the centre of a window: 0, right, left, down, up, right and down, left and up.
OFFSETS = STEP * np.array([(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, -1)], float)
MAX_CURVATURE = 0.1  # 1/px, sum of the coefficients of a moderate deformation


def window_rays(camera: Camera, uv: F64, odom_R_cam: F64) -> F64:
    """(N, 7, 3) unit rays of windows (N, 2) px at OFFSETS, odometry axes; NaN out of view."""
    rays = camera.unproject((uv[:, None] + OFFSETS).reshape(-1, 2)) @ odom_R_cam.T
    return rays.reshape(-1, len(OFFSETS), 3)


@njit
def _plane(rays, base, rho, warp, turn, model, params, normal):
    """The plane n X = 1, `normal` (3,), whose image a camera's motion deforms by a warp (2, 2).

    Args:
        rays: (7, 3) of its window; rho: 1/m along the first; base: (3,) m from the camera in which it is deformed to
            the one where it is not; in odometry axes. turn: (4, 4) from these to the axes of the former.
    """
    x, y, z = rays[0, 0] + rho * base[0], rays[0, 1] + rho * base[1], rays[0, 2] + rho * base[2]
    x, y, z = transform_point(turn, x, y, z)
    p, du, dv = project_one(model, params, x, y, z), np.zeros(3), np.zeros(3)
    for i in range(3):
        du[i] = p[2] * turn[0, i] + p[3] * turn[1, i] + p[4] * turn[2, i]
        dv[i] = p[5] * turn[0, i] + p[6] * turn[1, i] + p[7] * turn[2, i]
    dx, dy = (rays[1] - rays[2]) / (2 * STEP), (rays[3] - rays[4]) / (2 * STEP)
    mu, mv = dot(du, base), dot(dv, base)  # px by which a pixel moves for a change of rho
    power = mu * mu + mv * mv + 1 / (rho * rho)  # with less parallax than a pixel the plane faces the camera
    slope_x = (mu * (warp[0, 0] - dot(du, dx)) + mv * (warp[1, 0] - dot(dv, dx))) / power
    slope_y = (mu * (warp[0, 1] - dot(du, dy)) + mv * (warp[1, 1] - dot(dv, dy))) / power
    xx, xy, yy = dot(dx, dx), dot(dx, dy), dot(dy, dy)
    det = xx * yy - xy * xy
    slope_x, slope_y = (yy * slope_x - xy * slope_y) / det, (xx * slope_y - xy * slope_x) / det
    for i in range(3):
        normal[i] = rho * rays[0, i] + slope_x * dx[i] + slope_y * dy[i]


@njit
def window_curvatures(slots, rays, origin, points, warp, last, new, model, params, out):
    """The quadratic parts of the maps from first appearances to a new image, in pixels of the first appearance.

    What was at (x, y) from the centre is seen at centre + W ((x, y) + c) with the affine part W and
    c_k = q_k0 x^2 / 2 + q_k1 x y + q_k2 y^2 / 2.

    Args:
        slots: (N,) rows of rays (M, 7, 3), see `window_rays`, and origin (M, 3): cameras' positions, odometry frame.
        points: (N, 3), odometry frame. warp: (N, 2, 2) of an earlier image. last, new: (4, 4) odom_T_cam of that image
            and of the new one. model, params: of the lens. out: (N, 6) 1/px, q; zero where it is not known.
    """
    base, normal, at, second = np.zeros(3), np.zeros(3), np.zeros((2, len(OFFSETS))), np.zeros((2, 3))
    centre, right, left, down, up = at[:, 0], at[:, 1], at[:, 2], at[:, 3], at[:, 4]
    both, neither = at[:, 5], at[:, 6]
    to_last, to_new = last.T.copy(), new.T.copy()  # the first three rows turn odometry axes, and move nothing
    for row in range(slots.shape[0]):
        k, q = slots[row], out[row]
        r = rays[k]
        q[:] = 0.0
        distance = 0.0
        for i in range(3):
            distance += (points[row, i] - origin[k, i]) * r[0, i]
            base[i] = origin[k, i] - last[i, 3]
        if not distance > 0:
            continue
        _plane(r, base, 1.0 / distance, warp[row], to_last, model, params, normal)
        for i in range(3):
            base[i] = origin[k, i] - new[i, 3]
        for n in range(len(OFFSETS)):
            rho = dot(r[n], normal)
            x, y, z = r[n, 0] + rho * base[0], r[n, 1] + rho * base[1], r[n, 2] + rho * base[2]
            x, y, z = transform_point(to_new, x, y, z)
            p = project_one(model, params, x, y, z)
            at[0, n], at[1, n] = p[0], p[1]
        for i in range(2):
            across, along = right[i] + left[i], down[i] + up[i]
            second[i, 0], second[i, 2] = across - 2 * centre[i], along - 2 * centre[i]
            second[i, 1] = 0.5 * (both[i] + neither[i] + 2 * centre[i] - across - along)
        a, b = right[0] - left[0], down[0] - up[0]  # the affine part, times 2 STEP
        c, d = right[1] - left[1], down[1] - up[1]
        scale, largest = 2 / ((a * d - b * c) * STEP), 0.0
        for n in range(3):
            q[n] = scale * (d * second[0, n] - b * second[1, n])
            q[3 + n] = scale * (a * second[1, n] - c * second[0, n])
            largest += abs(q[n]) + abs(q[3 + n])
        if not largest < MAX_CURVATURE:  # also when anything is NaN
            q[:] = 0.0
