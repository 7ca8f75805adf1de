"""Full bundle adjustment of a large map, one core: time, memory, and the size from which the sparse solver is faster.

    python benchmarks/full_ba.py            1,000 keyframes, 100,000 points, 600,000 observations
    python benchmarks/full_ba.py --solvers  one step of either solver at growing numbers of keyframes

The camera passes the same 125 m circuit twice, so that the reduced camera system has loops.
"""

from __future__ import annotations

import os

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(variable, "1")

import multiprocessing
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

import resource

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.geometry import se3
from stereo_sfm.mapping.bundle import Bundle, BundleConfig, bundle_adjust
from tests.synthetic import camera_path, fisheye_rig, points_around, see


def circuit(rig: Rig, keyframes: int, points: int, observations: int) -> tuple[Bundle, np.ndarray]:
    """Two laps on one circle, 0.25 m between keyframes; initial poses with drift. Bundle, true poses."""
    rng = np.random.default_rng(0)
    truth = camera_path(keyframes, 0.25, 4 * np.pi / keyframes)
    xyz = points_around(truth, points, rng)
    tables: list[tuple[np.ndarray, ...]] = []
    for k, pose in enumerate(truth):
        near = np.flatnonzero(np.linalg.norm(xyz - pose[:3, 3], axis=1) < 7.0)
        seen, left, right = see(rig, pose, xyz[near], 7.0)
        rows = np.flatnonzero(seen)
        tables.append((np.full(len(rows), k), near[rows], left[rows], right[rows]))
    kf, pt, left, right = (np.concatenate(column) for column in zip(*tables, strict=True))
    keep = np.sort(rng.permutation(len(kf))[:observations])
    left = left[keep] + rng.normal(0, 0.6, (len(keep), 2))
    right = right[keep] + rng.normal(0, 0.6, (len(keep), 2))
    xi = np.tile([0.001, 0.0, 0.001, 0.0, 2e-5, 0.0], (keyframes, 1)) * np.arange(keyframes)[:, None]
    start = truth @ se3.exp(xi + rng.normal(0, 0.005, xi.shape))
    start[0] = truth[0]
    fixed = np.arange(keyframes) == 0
    noisy = xyz + rng.normal(0, 0.05, xyz.shape)
    return Bundle(start, fixed, noisy, kf[keep], pt[keep], left, right), truth


def peak_mib() -> float:
    """Largest resident memory of this process so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def full() -> None:
    """The table's row of the full map."""
    rig = fisheye_rig()
    bundle_adjust(rig, circuit(rig, 20, 500, 2000)[0], BundleConfig(dense=False))  # compiled before it is timed
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:  # its memory is not counted
        bundle, truth = pool.submit(circuit, rig, 1000, 100_000, 600_000).result()
    before = peak_mib()
    start = time.process_time()
    result = bundle_adjust(rig, bundle, BundleConfig())
    seconds = time.process_time() - start
    first = np.linalg.norm(bundle.world_T_kf[:, :3, 3] - truth[:, :3, 3], axis=1)
    last = np.linalg.norm(result.world_T_kf[:, :3, 3] - truth[:, :3, 3], axis=1)
    print(f"{len(truth)} keyframes, {len(bundle.points)} points, {len(bundle.obs_kf)} observations")
    print(f"{seconds:.1f} s CPU, {result.iterations} steps, converged: {result.converged}")
    print(f"peak memory of the process {peak_mib():.0f} MiB, {before:.0f} MiB of it before the optimisation")
    print(f"cost {result.initial_cost:.0f} -> {result.cost:.0f}")
    print(f"keyframe error RMSE {np.sqrt((first**2).mean()):.4f} m -> {np.sqrt((last**2).mean()):.4f} m")


def solvers() -> None:
    """Milliseconds of one step by either solver."""
    rig = fisheye_rig()
    for keyframes in (30, 60, 120, 240, 480):
        bundle, _ = circuit(rig, keyframes, 60 * keyframes, 400 * keyframes)
        times: list[float] = []
        for dense in (True, False):
            config = BundleConfig(rounds=1, iterations=1, dense=dense)
            bundle_adjust(rig, bundle, config)
            start = time.perf_counter()
            bundle_adjust(rig, bundle, config)
            times.append((time.perf_counter() - start) * 1e3)
        print(f"{keyframes:5d} keyframes: dense {times[0]:8.1f} ms, sparse {times[1]:8.1f} ms")


if __name__ == "__main__":
    solvers() if "--solvers" in sys.argv else full()
