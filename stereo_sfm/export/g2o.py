"""The keyframes as a pose graph in g2o's text format, written by GTSAM."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import scipy.sparse

from stereo_sfm.geometry import se3
from stereo_sfm.mapping.correction import COVISIBLE_POINTS, ODOMETRY
from stereo_sfm.mapping.pose_graph import Edges, edges_of_poses
from stereo_sfm.mapping.snapshot import MapSnapshot
from stereo_sfm.maps.saved_map import SavedMap


def graph_edges(s: MapSnapshot) -> Edges:
    """Edges between consecutive keyframes of a submap, and between keyframes that share many points."""
    shape = (len(s.kf_ids), len(s.pt_ids))
    sees = scipy.sparse.csr_array((np.ones(len(s.obs_kf), np.int32), (s.obs_kf, s.obs_pt)), shape=shape)
    shared = scipy.sparse.triu(sees @ sees.T, 1).tocoo()
    strong = shared.data >= COVISIBLE_POINTS
    follow = np.flatnonzero(s.submap_ids[1:] == s.submap_ids[:-1])
    i = np.concatenate([follow, shared.row[strong]])
    j = np.concatenate([follow + 1, shared.col[strong]])
    pairs = np.unique(np.stack([i, j], axis=1), axis=0).astype(np.int64)
    return edges_of_poses(s.map_T_kf, pairs[:, 0], pairs[:, 1], *ODOMETRY)


def export_g2o(saved: SavedMap, path: Path) -> None:
    """VERTEX_SE3:QUAT and EDGE_SE3:QUAT; vertex ids are keyframe ids, poses are map_T_cam."""
    import gtsam

    s = saved.snapshot
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for kf_id, pose in zip(s.kf_ids.tolist(), se3.orthonormalize(s.map_T_kf), strict=True):
        values.insert(kf_id, gtsam.Pose3(pose))
    edges = graph_edges(s)
    for i, j, pose, (metres, radians) in zip(edges.i, edges.j, edges.i_T_j, edges.sigmas, strict=True):
        noise = gtsam.noiseModel.Diagonal.Sigmas(np.array([radians] * 3 + [metres] * 3))
        measured = gtsam.Pose3(se3.orthonormalize(pose))
        graph.add(gtsam.BetweenFactorPose3(int(s.kf_ids[i]), int(s.kf_ids[j]), measured, noise))
    path.open("ab").close()  # raises OSError where GTSAM would fail silently
    gtsam.writeG2o(graph, values, str(path))
