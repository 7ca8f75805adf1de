"""The same bundles solved by GTSAM, as a reference of mapping/bundle.py in tests and benchmarks."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Camera
from stereo_sfm.mapping.bundle import Bundle
from stereo_sfm.types import F64

Graph = Any


DEPTH = np.array([[1.0, 1.0, 0.0], [1.0, 2.0, 0.0], [0.0, 0.0, 1.0]])  # (u, computed u of the right image, v) px^2


def _noise(dimension: int, huber: float, depth: bool = False) -> Any:
    plain = gtsam.noiseModel.Isotropic.Sigma(dimension, 1.0)
    if depth:
        plain = gtsam.noiseModel.Gaussian.Covariance(DEPTH)
    if huber <= 0:
        return plain
    return gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Huber.Create(huber), plain)


def stereo_graph(rig: Rig, bundle: Bundle, huber: float = 0.0) -> Graph:
    """GenericStereoFactor3D for observations with both cameras, GenericProjectionFactor for the left camera alone."""
    cam = rig.left
    stereo = gtsam.Cal3_S2Stereo(cam.fx, cam.fy, 0, cam.cx, cam.cy, rig.baseline)
    mono = gtsam.Cal3_S2(cam.fx, cam.fy, 0, cam.cx, cam.cy)
    graph = gtsam.NonlinearFactorGraph()
    noise3, noise2 = _noise(3, huber, rig.depth), _noise(2, huber)
    for k, p, left, right in zip(bundle.obs_kf, bundle.obs_pt, bundle.uv_left, bundle.uv_right, strict=True):
        x, landmark = gtsam.symbol("x", int(k)), gtsam.symbol("l", int(p))
        if np.isfinite(right[0]):
            measured = gtsam.StereoPoint2(left[0], right[0], left[1])
            graph.add(gtsam.GenericStereoFactor3D(measured, noise3, x, landmark, stereo))
        else:
            graph.add(gtsam.GenericProjectionFactorCal3_S2(left, noise2, x, landmark, mono))
    return _fix(graph, bundle)


def _fisheye(camera: Camera) -> Any:
    return gtsam.Cal3Fisheye(camera.fx, camera.fy, 0, camera.cx, camera.cy, *camera.distortion)


def fisheye_graph(rig: Rig, bundle: Bundle, huber: float = 0.0) -> Graph:
    """One projection factor per camera, the right one behind left_T_right."""
    assert rig.right is not None
    left_k, right_k, offset = _fisheye(rig.left), _fisheye(rig.right), gtsam.Pose3(rig.left_T_right)
    graph, noise = gtsam.NonlinearFactorGraph(), _noise(2, huber)
    factor = gtsam.GenericProjectionFactorCal3Fisheye
    for k, p, left, right in zip(bundle.obs_kf, bundle.obs_pt, bundle.uv_left, bundle.uv_right, strict=True):
        x, landmark = gtsam.symbol("x", int(k)), gtsam.symbol("l", int(p))
        graph.add(factor(left, noise, x, landmark, left_k))
        if np.isfinite(right[0]):
            graph.add(factor(right, noise, x, landmark, right_k, offset))
    return _fix(graph, bundle)


def _fix(graph: Graph, bundle: Bundle) -> Graph:
    for k in np.flatnonzero(bundle.fixed):
        graph.add(gtsam.NonlinearEqualityPose3(gtsam.symbol("x", int(k)), gtsam.Pose3(bundle.world_T_kf[k])))
    return graph


def start_values(bundle: Bundle) -> Any:
    """The bundle's poses and points as GTSAM's values."""
    values = gtsam.Values()
    for k in np.unique(bundle.obs_kf):
        values.insert(gtsam.symbol("x", int(k)), gtsam.Pose3(se3.orthonormalize(bundle.world_T_kf[k])))
    for p in np.unique(bundle.obs_pt):
        values.insert(gtsam.symbol("l", int(p)), bundle.points[p])
    return values


def optimize(graph: Graph, values: Any, tight: bool = True) -> Any:
    """Levenberg-Marquardt; `tight`: to full convergence."""
    params = gtsam.LevenbergMarquardtParams()
    if tight:
        params.setRelativeErrorTol(1e-12)
        params.setAbsoluteErrorTol(1e-10)
    return gtsam.LevenbergMarquardtOptimizer(graph, values, params).optimize()


def poses(values: Any, keyframes: int) -> F64:
    """(K, 4, 4)"""
    return np.array([values.atPose3(gtsam.symbol("x", k)).matrix() for k in range(keyframes)])


def points(values: Any, count: int) -> F64:
    """(P, 3)"""
    return np.array([values.atPoint3(gtsam.symbol("l", p)) for p in range(count)])
