"""Keyframe optimisation as a pose graph (the retail paper's equation 22), robust against false loops.

The paper minimises |K_i - i_T_j K_j| over all edges with Levenberg-Marquardt; here an edge's error is the logarithm
of the same difference, weighted by its covariance, and loops have robust weights: graduated non-convexity (Yang et al.,
RA-L 5, 2020) keeps the edges of the odometry and drops loops that contradict them. Where keyframes measured gravity,
that holds their roll and pitch: four degrees of freedom are left to drift.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.chi_squared import chi_squared
from stereo_sfm.types import F64, I64, Bool

ROBUST = ("gnc", "switchable", "none")
HELD = 1e-6  # metres, radians: standard deviation of a pose that stays, far below that of any edge
TILT = 0.05  # radians, that of its roll and pitch where gravity is known: far above gravity's


@dataclass(frozen=True, eq=False)
class Edges:
    """Relative poses between keyframes, by their row."""

    i: I64  # (E,)
    j: I64  # (E,)
    i_T_j: F64  # (E, 4, 4)
    sigmas: F64  # (E, 2) metres, radians
    loop: Bool  # (E,) loops, which may be false; the others are odometry

    def __len__(self) -> int:
        return len(self.i)


@dataclass(frozen=True, eq=False)
class Gravity:
    """What keyframes measured of gravity."""

    rows: I64  # (G,) keyframes
    seen: F64  # (G, 3) unit vectors in their cameras
    sigma: F64  # (G,) radians
    down: F64  # (G, 3) unit vectors, the same direction in the world


@dataclass(frozen=True, eq=False)
class PoseGraphResult:
    """Refined poses, and the final weight of each edge."""

    poses: F64  # (K, 4, 4)
    weights: F64  # (E,) 1 for edges of the odometry, in [0, 1] for loops


def join(edges: list[Edges]) -> Edges:
    """All edges, in order."""
    return Edges(*(np.concatenate([getattr(e, f.name) for e in edges]) for f in dataclasses.fields(Edges)))


def edges_of_poses(poses: F64, i: I64, j: I64, metres_per_metre: float, radians_per_metre: float) -> Edges:
    """Edges of the current relative poses (K, 4, 4); uncertainty grows with the distance between the two."""
    relative = se3.inverse(poses[i]) @ poses[j]
    length = np.linalg.norm(relative[:, :3, 3], axis=1)
    turn = np.linalg.norm(se3.log(relative)[:, 3:], axis=1) if len(i) else np.zeros(0)
    sigmas = np.stack([0.001 + metres_per_metre * length, 0.0002 + radians_per_metre * length + 0.002 * turn], axis=1)
    return Edges(i, j, relative, sigmas, np.zeros(len(i), bool))


def optimise(
    poses: F64, edges: Edges, fixed: I64, robust: str = "gnc", gravity: Gravity | None = None
) -> PoseGraphResult:
    """Poses (K, 4, 4) that agree best with the edges; the rows `fixed` stay.

    Args:
        gravity: where it is given, the rows `fixed` keep their positions and headings, and tilt as it says.
        robust: "gnc" (loops are kept or dropped), "switchable" (dynamic covariance scaling, Agarwal et al., ICRA
            2013: the closed form of switchable constraints), or "none" (least squares, as the paper).
    """
    if robust not in ROBUST:
        raise StereoSfmError(f"loop.robust is '{robust}': choose one of {', '.join(ROBUST)}")
    import gtsam

    values = gtsam.Values()
    used = np.unique(np.concatenate([edges.i, edges.j, fixed]))
    for row, pose in zip(used.tolist(), se3.orthonormalize(poses[used]), strict=True):
        values.insert(row, gtsam.Pose3(pose))
    plain = _graph(gtsam, edges, fixed, values, robust=False, gravity=gravity)
    if robust == "gnc" and edges.loop.any():
        result, weights = _graduated(gtsam, plain, values, edges)
    else:
        result, weights = _levenberg(gtsam, plain, values), np.ones(len(edges))
        if robust == "switchable" and edges.loop.any():  # start from least squares: no true loop is far off
            result = _levenberg(gtsam, _graph(gtsam, edges, fixed, values, robust=True, gravity=gravity), result)
            for e in np.flatnonzero(edges.loop).tolist():  # the weight that the scaling gives to a squared error
                chi2 = 2 * plain.at(e).error(result)
                weights[e] = min(1.0, 2 * chi_squared(6) / (chi_squared(6) + chi2)) ** 2
    out = poses.copy()
    for row in used.tolist():
        out[row] = result.atPose3(row).matrix()
    return PoseGraphResult(out, weights)


def _graph(gtsam: Any, edges: Edges, fixed: I64, values: Any, robust: bool, gravity: Gravity | None) -> Any:
    """Factors in the order of the edges, then one prior for each fixed row, then gravity."""
    graph = gtsam.NonlinearFactorGraph()
    measured = se3.orthonormalize(edges.i_T_j)
    for e in range(len(edges)):
        metres, radians = edges.sigmas[e]
        noise: Any = gtsam.noiseModel.Diagonal.Sigmas(np.array([radians] * 3 + [metres] * 3))
        if edges.loop[e] and robust:
            noise = gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.DCS.Create(chi_squared(6)), noise)
        graph.add(gtsam.BetweenFactorPose3(int(edges.i[e]), int(edges.j[e]), gtsam.Pose3(measured[e]), noise))
    held = _held(fixed, values, gravity)
    for row in fixed.tolist():
        graph.add(gtsam.PriorFactorPose3(row, values.atPose3(row), gtsam.noiseModel.Gaussian.Covariance(held[row])))
    if gravity is not None:
        for row, seen, sigma, down in zip(
            gravity.rows.tolist(), gravity.seen, gravity.sigma, gravity.down, strict=True
        ):
            noise = gtsam.noiseModel.Isotropic.Sigma(2, float(sigma))
            graph.add(gtsam.AttitudeFactorPose3(row, gtsam.Unit3(down), noise, gtsam.Unit3(seen)))
    return graph


def _held(fixed: I64, values: Any, gravity: Gravity | None) -> dict[int, F64]:
    """Covariance (6, 6), rotation first, of the priors of fixed rows: with gravity only their tilt is free."""
    out = dict.fromkeys(fixed.tolist(), HELD**2 * np.eye(6))
    for row in out:
        measured = np.zeros(0, np.int64) if gravity is None else np.flatnonzero(gravity.rows == row)
        if gravity is not None and len(measured):
            down = values.atPose3(row).rotation().matrix().T @ gravity.down[measured[0]]
            tilt = np.zeros((6, 6))
            tilt[:3, :3] = np.eye(3) - np.outer(down, down)
            out[row] = out[row] + TILT**2 * tilt
    return out


def _levenberg(gtsam: Any, graph: Any, values: Any) -> Any:
    return gtsam.LevenbergMarquardtOptimizer(graph, values, gtsam.LevenbergMarquardtParams()).optimize()


def _graduated(gtsam: Any, graph: Any, values: Any, edges: Edges) -> tuple[Any, F64]:
    """Graduated non-convexity with a truncated loss; edges of the odometry are known inliers."""
    params = gtsam.GncLMParams(gtsam.LevenbergMarquardtParams())
    params.setLossType(gtsam.GncLossType.TLS)
    params.setKnownInliers([k for k in range(graph.size()) if k >= len(edges) or not edges.loop[k]])
    optimizer = gtsam.GncLMOptimizer(graph, values, params)
    optimizer.setInlierCostThresholdsAtProbability(0.999)
    result = optimizer.optimize()
    return result, np.where(edges.loop, np.asarray(optimizer.getWeights())[: len(edges)], 1.0)
