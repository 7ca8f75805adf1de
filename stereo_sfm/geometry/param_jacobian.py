"""Derivatives of a pixel by the camera's own parameters, for calibration."""

from __future__ import annotations

import numpy as np

from stereo_sfm.geometry.cameras import Camera
from stereo_sfm.types import F64

STEP = 1e-6  # of a coefficient: rounding and the cubic term are both about 1e-10 of the derivative


def parameter_vector(camera: Camera) -> F64:
    """(4 + n,) fx fy cx cy and the n distortion coefficients of the camera."""
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion])


def with_parameters(camera: Camera, vector: F64) -> Camera:
    """A camera of the same model with other parameters, in the order of `parameter_vector`."""
    fx, fy, cx, cy, *distortion = (float(v) for v in vector)
    return type(camera)(camera.width, camera.height, fx, fy, cx, cy, tuple(distortion))


def parameter_jacobian(camera: Camera, points: F64) -> F64:
    """Derivative of the pixel by fx fy cx cy and the distortion coefficients.

    Args:
        camera: of any model.
        points: (N, 3) in the camera.

    Returns:
        (N, 2, 4 + n); rows of points outside the camera's view are meaningless.
    """
    count = len(camera.distortion)
    jac = np.zeros((len(points), 2, 4 + count))
    distorted, by_coefficients = _distorted(camera, points)
    jac[:, 0, 0], jac[:, 1, 1] = distorted[:, 0], distorted[:, 1]
    jac[:, 0, 2] = jac[:, 1, 3] = 1.0
    jac[:, :, 4:] = by_coefficients * np.array([camera.fx, camera.fy])[:, None]
    return jac


def _distorted(camera: Camera, points: F64) -> tuple[F64, F64]:
    """(N, 2) pixel before focal length and principal point, and its derivative (N, 2, n) by the coefficients."""
    uv = camera.project(points)
    distorted = (uv - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    if camera.model == "kannala_brandt":
        radius = np.maximum(np.hypot(points[:, 0], points[:, 1]), 1e-300)
        theta = np.arctan2(radius, points[:, 2])
        powers = theta[:, None] ** np.arange(3, 3 + 2 * len(camera.distortion), 2)  # theta^3, theta^5, ...
        direction = points[:, :2] / radius[:, None]
        return distorted, direction[:, :, None] * powers[:, None, :]
    if camera.model == "radtan":
        return distorted, _brown(camera, points)
    return distorted, _differences(camera, points)


def _differences(camera: Camera, points: F64) -> F64:
    """(N, 2, n) by central differences, for models that are read from files and not calibrated here."""
    columns = np.zeros((len(points), 2, len(camera.distortion)))
    vector, focal = parameter_vector(camera), [camera.fx, camera.fy]
    for i, step in enumerate(STEP * np.eye(len(vector))[4:]):
        ahead, behind = (with_parameters(camera, vector + s * step).project(points) for s in (1, -1))
        columns[:, :, i] = (ahead - behind) / (2 * STEP * np.array(focal))
    return columns


def _brown(camera: Camera, points: F64) -> F64:
    """(N, 2, n) of OpenCV's k1 k2 p1 p2 k3 k4 k5 k6."""
    with np.errstate(divide="ignore", invalid="ignore"):
        x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    r2 = x * x + y * y
    k1, k2, _, _, k3, k4, k5, k6 = camera.params[4:12]
    denominator = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
    gain = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / denominator
    xy = np.stack([x, y], -1)
    rising = (r2 / denominator)[:, None] * xy  # by k1; k2 and k3 follow with r2, r4
    falling = -(gain * r2 / denominator)[:, None] * xy  # by k4
    columns = [
        rising,
        rising * r2[:, None],
        np.stack([2 * x * y, r2 + 2 * y * y], -1),
        np.stack([r2 + 2 * x * x, 2 * x * y], -1),
        rising * (r2 * r2)[:, None],
        falling,
        falling * r2[:, None],
        falling * (r2 * r2)[:, None],
    ]
    return np.stack(columns[: len(camera.distortion)], -1)
