"""Local bundle adjustment compared with GTSAM's Levenberg-Marquardt on the same window, one thread.

    python benchmarks/bundle.py

12 keyframes, 1,500 points, 7,000 stereo observations (u left, v, u right), the first two keyframes fixed. GTSAM builds
a GenericStereoFactor3D per observation; its time is given with and without building the graph. Best of three each.
"""

from __future__ import annotations

import os

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS", "TBB_NUM_THREADS"):
    os.environ.setdefault(variable, "1")
os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})  # GTSAM's TBB would take every core

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

import dataclasses

import numpy as np

from stereo_sfm.mapping.bundle import Bundle, BundleConfig, bundle_adjust
from tests import gtsam_oracle
from tests.synthetic import disturb, make_scene, pinhole_rig


def timed(function: Callable[[], Any], repeats: int = 3) -> tuple[float, Any]:
    """Best milliseconds of several calls, and the last result."""
    best, result = float("inf"), None
    for _ in range(repeats):
        start = time.perf_counter()
        result = function()
        best = min(best, (time.perf_counter() - start) * 1e3)
    return best, result


def window() -> tuple[Any, Bundle]:
    """The rig and the window of the benchmark."""
    rig = pinhole_rig()
    scene = make_scene(rig, 12, 1500, noise_px=0.7)
    right = scene.uv_right.copy()
    both = np.flatnonzero(np.isfinite(right[:, 0]))
    rows = np.random.default_rng(0).permutation(both)[:7000]
    right[:, 1] = np.nan
    poses, points = disturb(scene, 0.02, 0.05)
    poses[1] = scene.world_T_kf[1]
    fixed = np.arange(12) < 2
    return rig, Bundle(poses, fixed, points, scene.obs_kf[rows], scene.obs_pt[rows], scene.uv_left[rows], right[rows])


def main() -> None:
    """Print the table."""
    rig, bundle = window()
    print(f"{len(bundle.points)} points, {len(bundle.obs_kf)} stereo observations, 12 keyframes (2 fixed)")
    print(f"{'loss':>8} {'ours ms':>9} {'GTSAM ms':>9} {'with graph':>10} {'ratio':>6} {'cost ours':>10} {'GTSAM':>10}")
    for huber in (0.0, 1.345):
        config = BundleConfig(rounds=1, huber=huber, joint_loss=True, tolerance=1e-5, iterations=50)
        bundle_adjust(rig, bundle, config)  # compiled before it is timed
        ours_ms, ours = timed(lambda c=config: bundle_adjust(rig, bundle, c))
        build_ms, graph = timed(lambda h=huber: gtsam_oracle.stereo_graph(rig, bundle, h))
        values = gtsam_oracle.start_values(bundle)
        theirs_ms, theirs = timed(lambda g=graph, v=values: gtsam_oracle.optimize(g, v, tight=False))
        cost = graph.error(theirs)
        print(
            f"{'Huber' if huber else 'squares':>8} {ours_ms:9.1f} {theirs_ms:9.1f} {build_ms + theirs_ms:10.1f} "
            f"{theirs_ms / ours_ms:6.1f} {ours.cost:10.3f} {cost:10.3f}"
        )
        if not ours.cost <= cost * 1.001:
            raise SystemExit("costs differ by more than 0.1 %")
    compiled = dataclasses.replace(config, rounds=2)
    print(f"two rounds with removal of outliers: {timed(lambda: bundle_adjust(rig, bundle, compiled))[0]:.1f} ms")


if __name__ == "__main__":
    main()
