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
from stereo_sfm.types import F64

STEP = 5.0  # px of the differences
RIGHT, LEFT, DOWN, UP, BOTH, NEITHER, ALONG_X, ALONG_Y = range(1, 9)  # rays beside the centre's, and differences
OFFSETS = STEP * np.array([(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, -1)], float)
MAX_CURVATURE = 0.1  # 1/px, sum of the coefficients of a moderate deformation


def window_rays(camera: Camera, uv: F64, odom_R_cam: F64) -> F64:
    """(N, 7, 3) unit rays at the centres (N, 2) px of windows and around them, in odometry axes; NaN out of view."""
    around = camera.unproject((uv[:, None] + OFFSETS).reshape(-1, 2))
    return (around @ odom_R_cam.T).reshape(-1, len(OFFSETS), 3)


@njit
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit
def _plane(ray, base, rho, warp, model, params, normal):
    """The plane n X = 1, `normal` (3,), whose image a camera's motion deforms by a warp (2, 2).

    Args:
        ray: (9, 3) of its window, and its differences along x and y per pixel; rho: 1/m along the first; base: (3,) m
            from the new camera to the old one; in the new camera's axes.
    """
    p = project_one(model, params, ray[0, 0] + rho * base[0], ray[0, 1] + rho * base[1], ray[0, 2] + rho * base[2])
    dx, dy = ray[ALONG_X], ray[ALONG_Y]
    mu, mv = _dot(p[2:5], base), _dot(p[5:8], base)  # px by which a pixel moves for a change of rho
    power = mu * mu + mv * mv + 1 / (rho * rho)  # with less parallax than a pixel the plane faces the camera
    x = (mu * (warp[0, 0] - _dot(p[2:5], dx)) + mv * (warp[1, 0] - _dot(p[5:8], dx))) / power
    y = (mu * (warp[0, 1] - _dot(p[2:5], dy)) + mv * (warp[1, 1] - _dot(p[5:8], dy))) / power
    xx, xy, yy = _dot(dx, dx), _dot(dx, dy), _dot(dy, dy)
    det = xx * yy - xy * xy
    x, y = (yy * x - xy * y) / det, (xx * y - xy * x) / det
    for i in range(3):
        normal[i] = rho * ray[0, i] + x * dx[i] + y * dy[i]


@njit
def window_curvatures(slots, rays, origin, points, warp, cam_R_odom, position, model, params, out):
    """The quadratic parts of the maps from first appearances to an image, in pixels of the first appearance.

    What was at (x, y) from the centre is seen at centre + warp ((x, y) + c) with c_k = q_k0 x^2 / 2 + q_k1 x y +
    q_k2 y^2 / 2.

    Args:
        slots: (N,) rows of rays (M, 7, 3), see `window_rays`, and origin (M, 3): cameras' positions, odometry frame.
        points: (N, 3), odometry frame. warp: (N, 2, 2). cam_R_odom: (3, 3) and position (3,) of the camera.
        model, params: of its lens. out: (N, 6) 1/px, q; zero where it is not known.
    """
    ray, base, normal, at, second = np.zeros((9, 3)), np.zeros(3), np.zeros(3), np.zeros((2, 7)), np.zeros((2, 3))
    for row in range(slots.shape[0]):
        k, q, w = slots[row], out[row], warp[row]
        q[:] = 0.0
        distance = 0.0
        for i in range(3):
            distance += (points[row, i] - origin[k, i]) * rays[k, 0, i]
            base[i] = 0.0
            for j in range(3):
                base[i] += cam_R_odom[i, j] * (origin[k, j] - position[j])
            for n in range(7):
                ray[n, i] = _dot(cam_R_odom[i], rays[k, n])
            ray[ALONG_X, i] = (ray[RIGHT, i] - ray[LEFT, i]) / (2 * STEP)
            ray[ALONG_Y, i] = (ray[DOWN, i] - ray[UP, i]) / (2 * STEP)
        if not distance > 0:
            continue
        _plane(ray, base, 1.0 / distance, w, model, params, normal)
        for n in range(7):
            rho = _dot(ray[n], normal)
            x, y, z = ray[n, 0] + rho * base[0], ray[n, 1] + rho * base[1], ray[n, 2] + rho * base[2]
            p = project_one(model, params, x, y, z)
            at[0, n], at[1, n] = p[0], p[1]
        for i in range(2):
            across, along = at[i, RIGHT] + at[i, LEFT], at[i, DOWN] + at[i, UP]
            second[i, 0], second[i, 2] = across - 2 * at[i, 0], along - 2 * at[i, 0]
            second[i, 1] = 0.5 * (at[i, BOTH] + at[i, NEITHER] + 2 * at[i, 0] - across - along)
        det, largest = (w[0, 0] * w[1, 1] - w[0, 1] * w[1, 0]) * STEP * STEP, 0.0
        for n in range(3):
            q[n] = (w[1, 1] * second[0, n] - w[0, 1] * second[1, n]) / det
            q[3 + n] = (w[0, 0] * second[1, n] - w[1, 0] * second[0, n]) / det
            largest += abs(q[n]) + abs(q[3 + n])
        if not largest < MAX_CURVATURE:  # also when anything is NaN
            q[:] = 0.0
