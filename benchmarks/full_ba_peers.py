"""Full bundle adjustment of saved maps beside GTSAM and Ceres, on the same graph, one core.

    python benchmarks/full_ba_peers.py MAP... [--without gtsam]

The maps are of fisheye pairs, of different sizes for the growth with the map. Every keyframe and point is disturbed
(10 mm and 0.2°, 30 mm), then all systems minimise the same cost: Huber's of 1 px in each image, the first keyframe
fixed, until a step decreases it by less than 1e-5. Printed: processor time of the minimisation (without building the
graph) in all and for a keyframe, the cost that each ends with, evaluated by the same function, and how far its
keyframes are from ours. GTSAM runs Levenberg-Marquardt, Ceres (by pycolmap) its sparse Schur solver. The exit code is 1
where another system is faster, or finds a cost lower by more than 0.1 %.
"""

from __future__ import annotations

import os

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS", "TBB_NUM_THREADS"):
    os.environ.setdefault(variable, "1")
os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})  # GTSAM's TBB would take every core

import argparse
import dataclasses
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np
import pycolmap

from stereo_sfm.export.colmap import export_colmap
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import KannalaBrandt
from stereo_sfm.mapping import window
from stereo_sfm.mapping.bundle import Bundle, BundleConfig, bundle_adjust
from stereo_sfm.maps.merge import subset
from stereo_sfm.maps.saved_map import SavedMap, load_map, restore_map
from stereo_sfm.types import F64
from tests import gtsam_oracle

HUBER_PX, TOLERANCE, STEPS = 1.0, 1e-5, 100
KF_M, KF_DEG, POINT_M = 0.01, 0.2, 0.03  # disturbance
System = Callable[[SavedMap, Bundle], tuple[F64, F64, float]]  # poses (K, 4, 4), points (P, 3), seconds


def disturbed(saved: SavedMap) -> SavedMap:
    """The map with only the points that constrain poses, its keyframes and points moved."""
    s, rng = saved.snapshot, np.random.default_rng(0)
    whole = np.isfinite(s.uv_left).all(1)
    seen = np.bincount(s.obs_pt[whole], minlength=len(s.pt_ids)) > 1
    s = subset(s, np.ones(len(s.kf_ids), bool), seen, whole & seen[s.obs_pt])
    xi = rng.normal(0, [KF_M] * 3 + [np.radians(KF_DEG)] * 3, (len(s.kf_ids), 6))
    xi[0] = 0.0
    points = s.points + rng.normal(0, POINT_M, s.points.shape)
    return dataclasses.replace(saved, snapshot=dataclasses.replace(s, map_T_kf=s.map_T_kf @ se3.exp(xi), points=points))


def bundle_of(saved: SavedMap) -> Bundle:
    """Rows as in the snapshot; every pixel counts the same."""
    part = window.whole_map(restore_map(saved.snapshot))
    return dataclasses.replace(part.bundle, sigma=None, level=None)


def ours(saved: SavedMap, bundle: Bundle, steps: int = STEPS) -> tuple[F64, F64, float]:
    config = BundleConfig(rounds=1, iterations=steps, huber=HUBER_PX, tolerance=TOLERANCE)
    start = time.process_time()
    result = bundle_adjust(saved.rig, bundle, config)
    return result.world_T_kf, result.points, time.process_time() - start


def cost(saved: SavedMap, bundle: Bundle, poses: F64, points: F64) -> float:
    state = dataclasses.replace(bundle, world_T_kf=poses, points=points)
    return bundle_adjust(saved.rig, state, BundleConfig(rounds=1, iterations=0, huber=HUBER_PX)).cost


def gtsam(saved: SavedMap, bundle: Bundle) -> tuple[F64, F64, float]:
    graph = gtsam_oracle.fisheye_graph(saved.rig, bundle, HUBER_PX)
    values = gtsam_oracle.start_values(bundle)
    start = time.process_time()
    found = gtsam_oracle.optimize(graph, values, tight=False)
    seconds = time.process_time() - start
    return gtsam_oracle.poses(found, len(bundle.world_T_kf)), gtsam_oracle.points(found, len(bundle.points)), seconds


def ceres(saved: SavedMap, bundle: Bundle) -> tuple[F64, F64, float]:
    with tempfile.TemporaryDirectory() as folder:
        export_colmap(saved, Path(folder))
        model = pycolmap.Reconstruction(folder)
    options = pycolmap.BundleAdjustmentOptions(
        refine_focal_length=False, refine_extra_params=False, refine_sensor_from_rig=False, print_summary=False
    )
    options.ceres.loss_function_type = pycolmap.LossFunctionType.HUBER
    options.ceres.loss_function_scale = HUBER_PX
    options.ceres.solver_options.function_tolerance = TOLERANCE
    options.ceres.solver_options.num_threads = 1
    options.ceres.min_num_residuals_for_cpu_multi_threading = 2**31 - 1
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in model.reg_image_ids():
        config.add_image(image_id)
    for frame in np.flatnonzero(bundle.fixed).tolist():
        config.set_constant_rig_from_world_pose(frame + 1)
    start = time.process_time()
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    seconds = time.process_time() - start
    poses = np.array([model.frame(k + 1).rig_from_world.matrix() for k in range(len(bundle.world_T_kf))])
    points = np.array([model.point3D(p + 1).xyz for p in range(len(bundle.points))])
    return se3.inverse(se3.from_rotation_translation(poses[:, :, :3], poses[:, :, 3])), points, seconds


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("maps", nargs="*", metavar="MAP", help="maps of fisheye pairs, as `run --map-out` saves them")
    parser.add_argument("--without", default="", help="of gtsam, ceres")
    args = parser.parse_args()
    if not args.maps:
        print("not compared, this needs saved maps of fisheye pairs: stereo-sfm run SOURCE --map-out MAP")
    systems: dict[str, System] = {"ours": ours, "gtsam": gtsam, "ceres": ceres}
    for name in filter(None, args.without.split(",")):
        del systems[name]
    passed = True
    for folder in args.maps:
        saved = disturbed(load_map(folder))
        if not isinstance(saved.rig.left, KannalaBrandt):
            parser.error(f"{folder} is not the map of a fisheye pair")
        bundle = bundle_of(saved)
        ours(saved, bundle, steps=1)  # compiled before it is timed
        print(
            f"{folder}: {len(bundle.world_T_kf)} keyframes, {len(bundle.points)} points, {len(bundle.obs_kf)}"
            f" observations, cost {cost(saved, bundle, bundle.world_T_kf, bundle.points):.0f}",
            flush=True,
        )
        rows = list[tuple[float, float]]()
        reference: F64 | None = None
        for name, system in systems.items():
            poses, points, seconds = system(saved, bundle)
            reference = poses if reference is None else reference
            off = np.sqrt(((poses - reference)[:, :3, 3] ** 2).sum(1).mean())
            rows.append((seconds, cost(saved, bundle, poses, points)))
            print(
                f"  {name:>5}: {seconds:7.1f} s, {1e3 * seconds / len(poses):6.1f} ms a keyframe,"
                f" cost {rows[-1][1]:.1f}, {1e3 * off:.2f} mm from ours",
                flush=True,
            )
        passed &= all(rows[0][0] <= seconds and rows[0][1] <= 1.001 * value for seconds, value in rows)
    return 0 if passed else 1


if __name__ == "__main__":
    sys.exit(main())
