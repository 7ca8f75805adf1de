"""Rectified projections of a stereo pair: the common virtual camera, and the tables that resample images to it.

The pinhole projection keeps straight lines straight and crops a fisheye's field of view; the epipolar-aligned
projection (Abraham and Foerstner, ISPRS Journal 59, 2005) keeps the field of view, rows being epipolar planes.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry.cameras import Camera, Epipolar, Pinhole
from stereo_sfm.types import F64, Bool

PINHOLE_LIMIT_DEG = 150.0  # wider pinhole images consist mostly of stretched borders
EPIPOLAR_LIMIT_DEG = 175.0  # the poles of the epipolar projection lie on the baseline
FISHEYE_PINHOLE_DEG = 100.0  # default field of view of a fisheye's pinhole rectification


def pinhole_camera(
    left: Camera,
    right: Camera,
    rect_R_left: F64,
    rect_R_right: F64,
    hfov_deg: float | None = None,
    size: tuple[int, int] | None = None,
) -> Pinhole:
    """The ideal camera of a pinhole rectification.

    The default field of view is the largest one without black borders for cameras below 120 degrees, else
    `FISHEYE_PINHOLE_DEG`. A rectified pair keeps its camera.
    """
    width, height = size or left.size
    if size is None and hfov_deg is None and _is_rectified(left, right, rect_R_left, rect_R_right):
        return Pinhole(width, height, left.fx, left.fy, left.cx, left.cy)
    if hfov_deg is None and _horizontal_fov(left) > np.deg2rad(120):
        hfov_deg = FISHEYE_PINHOLE_DEG
    if hfov_deg is not None:
        _check_fov(hfov_deg, PINHOLE_LIMIT_DEG, "pinhole")
        focal = 0.5 * width / np.tan(np.deg2rad(hfov_deg) / 2)
        forward = _middle(left, rect_R_left) + _middle(right, rect_R_right)
        cx = 0.5 * (width - 1) - focal * forward[0] / forward[2]
        cy = 0.5 * (height - 1) - focal * forward[1] / forward[2]
        return Pinhole(width, height, focal, focal, cx, cy)
    x0, x1, y0, y1 = _inner_rectangle(left, right, rect_R_left, rect_R_right)
    focal = max((width - 1) / (x1 - x0), (height - 1) / (y1 - y0))
    cx = 0.5 * (width - 1) - focal * 0.5 * (x0 + x1)
    cy = 0.5 * (height - 1) - focal * 0.5 * (y0 + y1)
    return Pinhole(width, height, focal, focal, cx, cy)


def epipolar_camera(
    left: Camera,
    right: Camera,
    rect_R_left: F64,
    rect_R_right: F64,
    hfov_deg: float | None = None,
    size: tuple[int, int] | None = None,
) -> Epipolar:
    """The wide camera of an epipolar-aligned rectification.

    It covers the views of both within `hfov_deg` (default: all, at most `EPIPOLAR_LIMIT_DEG`) along the baseline
    and at most as much across it, at the resolution of the left camera's centre unless a size is given.
    """
    limit = np.deg2rad(EPIPOLAR_LIMIT_DEG if hfov_deg is None else hfov_deg) / 2
    _check_fov(np.rad2deg(2 * limit), EPIPOLAR_LIMIT_DEG, "epipolar")
    across, along = [], []
    for camera, rotation in ((left, rect_R_left), (right, rect_R_right)):
        x, y, z = np.moveaxis(camera.unproject(_lattice(camera)) @ rotation.T, -1, 0)
        near_axis = np.abs(np.arctan2(y, z)) < np.deg2rad(10)
        along.append(np.arcsin(np.clip(x[near_axis], -1, 1)))
        upright = (np.abs(x) < np.sin(np.deg2rad(10))) & (z > -0.5)
        across.append(np.arctan2(y[upright], z[upright]))
    if hfov_deg is None:
        a0, a1 = _extent(along, limit)
    else:
        a0, a1 = -limit, limit
    b0, b1 = _extent(across, limit)
    if size is None:
        fx = fy = 0.5 * (left.fx + left.fy)
        width, height = round((a1 - a0) * fx), round((b1 - b0) * fy)
    else:
        width, height = size
        fx = fy = (width - 1) / (a1 - a0)
    return Epipolar(
        width, height, fx, fy, 0.5 * (width - 1) - fx * 0.5 * (a0 + a1), 0.5 * (height - 1) - fy * 0.5 * (b0 + b1)
    )


def remap_tables(
    source: Camera, target: Camera, target_R_source: F64
) -> tuple[NDArray[np.int16], NDArray[np.uint16], Bool]:
    """Fixed-point tables for `cv2.remap` from images of `source` to images of `target`.

    Returns:
        (H, W, 2) and (H, W) tables, and the (H, W) mask of pixels that have a source.
    """
    import cv2

    uv = source.project(target.bearing_grid() @ target_R_source)
    valid = source.inside(uv, -1e-6)  # a rectified pair keeps its border pixels
    uv = np.where(valid[..., None], uv, -100.0).astype(np.float32)
    tables: Any = cv2.convertMaps(uv[..., 0], uv[..., 1], cv2.CV_16SC2)
    return tables[0], tables[1], valid


def _check_fov(hfov_deg: float, limit_deg: float, projection: str) -> None:
    if not 10 <= hfov_deg <= limit_deg:
        raise StereoSfmError(f"invalid {projection} field of view of {hfov_deg:g} degrees: choose 10 to {limit_deg:g}")


def _is_rectified(left: Camera, right: Camera, rect_R_left: F64, rect_R_right: F64) -> bool:
    straight = np.allclose(rect_R_left, np.eye(3), atol=1e-9) and np.allclose(rect_R_right, np.eye(3), atol=1e-9)
    plain = left.model == right.model == "pinhole" and left.size == right.size
    return straight and plain and np.allclose(left.params, right.params)


def _lattice(camera: Camera, count: int = 65) -> F64:
    """(count, count, 2) pixels spread over the whole image."""
    u, v = np.meshgrid(np.linspace(0, camera.width - 1, count), np.linspace(0, camera.height - 1, count))
    return np.stack([u, v], -1)


def _middle(camera: Camera, rect_R_cam: F64) -> F64:
    """(3,) rectified bearing of the image centre."""
    return rect_R_cam @ camera.unproject(np.array([0.5 * (camera.width - 1), 0.5 * (camera.height - 1)]))


def _horizontal_fov(camera: Camera) -> float:
    """Radians between the bearings at the ends of the middle row; 180 degrees beyond the range of the lens model."""
    ends = camera.unproject(np.array([[0.0, camera.cy], [camera.width - 1.0, camera.cy]]))
    if not np.isfinite(ends).all():
        return float(np.pi)
    return float(np.arctan2(ends[1, 0], ends[1, 2]) - np.arctan2(ends[0, 0], ends[0, 2]))


def _inner_rectangle(left: Camera, right: Camera, rect_R_left: F64, rect_R_right: F64) -> tuple[float, ...]:
    """x0 x1 y0 y1 on the plane z = 1 that both cameras cover entirely."""
    x0 = y0 = -np.inf
    x1 = y1 = np.inf
    for camera, rotation in ((left, rect_R_left), (right, rect_R_right)):
        rays = camera.unproject(_lattice(camera)) @ rotation.T
        x, y = rays[..., 0] / rays[..., 2], rays[..., 1] / rays[..., 2]
        if any(np.isnan(edge).all() for edge in (x[:, 0], x[:, -1], y[0], y[-1])):
            raise StereoSfmError("the lens model does not cover the whole image: give a field of view")
        # Corners beyond the lens model's range lie further out than the edges that count here.
        x0, x1 = max(x0, np.nanmax(x[:, 0])), min(x1, np.nanmin(x[:, -1]))
        y0, y1 = max(y0, np.nanmax(y[0])), min(y1, np.nanmin(y[-1]))
    if not (x1 - x0 > 0.05 and y1 - y0 > 0.05):
        raise StereoSfmError("the cameras have no common pinhole view: check the extrinsics, or give a field of view")
    return float(x0), float(x1), float(y0), float(y1)


def _extent(angles: list[F64], limit: float) -> tuple[float, float]:
    finite = np.concatenate([a[np.isfinite(a)] for a in angles])
    if len(finite) == 0:
        raise StereoSfmError("the cameras do not cover the common viewing direction: check the extrinsics")
    return float(max(finite.min(), -limit)), float(min(finite.max(), limit))
