"""What one insertion costs while the map grows: 100, 1,000 and 10,000 keyframes, 1,000,000 points, 4,000,000 sightings.

    python benchmarks/map_growth.py

Every keyframe sees 400 points: 300 of the one before it, 100 new ones; every tenth also sees the 100 that were new 500
keyframes earlier, as in a loop; each brings 400 corners to be known by. An insertion is what the mapper asks of the
map: new points, observations, covisibility, neighbours, the delta. Medians and 99th percentiles of the 100 insertions
before each size; the worst one holds the doubling of a column.
"""

from __future__ import annotations

import os

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(variable, "1")

import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np
import psutil

from stereo_sfm.mapping.map import Map
from stereo_sfm.types import I64, Corners, Keyframe

SIZES = (100, 1_000, 10_000)
TRACKED, NEW, BACK = 300, 100, 500
CORNERS = 400


def keyframe(kf_id: int, point_ids: I64, rng: np.random.Generator) -> Keyframe:
    """Somewhere, seeing these points anyhow."""
    n = len(point_ids)
    return Keyframe(
        kf_id=kf_id,
        frame_id=kf_id,
        stamp_ns=kf_id,
        odom_T_cam=np.eye(4),
        point_ids=point_ids,
        uv_left=rng.uniform(0, 800, (n, 2)),
        uv_right=rng.uniform(0, 800, (n, 2)),
        points_cam=rng.uniform(1, 5, (n, 3)),
        descriptors=rng.integers(0, 256, (n, 32), dtype=np.uint8),
        corners=Corners(
            rng.uniform(0, 800, (CORNERS, 2)).astype(np.float32),
            rng.uniform(0, 800, (CORNERS, 2)).astype(np.float32),
            rng.uniform(1, 5, (CORNERS, 3)).astype(np.float32),
            rng.integers(0, 256, (CORNERS, 32), dtype=np.uint8),
        ),
    )


def insert(map_: Map, kf: Keyframe) -> None:
    """All that one keyframe asks of the map."""
    row = map_.add_keyframe(kf, kf.odom_T_cam)
    new = map_.point_rows(kf.point_ids) < 0
    map_.add_points(kf.point_ids[new], kf.points_cam[new], row)
    map_.observe(row, map_.point_rows(kf.point_ids), kf.uv_left, kf.uv_right, kf.descriptors)
    neighbours, _ = map_.covisibility.neighbours(row, 15)
    if len(neighbours):
        map_.observations_of_points(map_.observations.pt[map_.observations_of_keyframe(int(neighbours[0]))])
    map_.take_delta()


def main() -> None:
    """Print the table."""
    rng = np.random.default_rng(0)
    map_, process = Map(), psutil.Process()
    seen: list[I64] = []
    new: list[I64] = []
    times: list[float] = []
    base = process.memory_info().rss
    names = ("keyframes", "points", "sightings", "median ms", "p99 ms", "MiB", "RSS MiB")
    print("".join(f"{name:>11}" for name in names))
    for k in range(SIZES[-1]):
        old = rng.permutation(seen[-1])[:TRACKED] if seen else np.zeros(0, np.int64)
        again = new[-BACK] if k % 10 == 0 and k >= BACK else np.zeros(0, np.int64)
        new.append(len(map_.points) + np.arange(NEW))
        ids = np.unique(np.concatenate([old, again, new[-1]]))
        kf = keyframe(k, ids, rng)
        seen.append(ids)
        start = time.perf_counter()
        insert(map_, kf)
        times.append((time.perf_counter() - start) * 1e3)
        if k + 1 in SIZES:
            last = times[-100:]
            rss = (process.memory_info().rss - base) / 2**20
            print(
                f"{k + 1:11d}{len(map_.points):11d}{len(map_.observations):11d}{np.median(last):11.2f}"
                f"{np.percentile(last, 99):11.2f}{map_.nbytes / 2**20:11.1f}{rss:11.1f}",
                flush=True,
            )
    print(f"worst insertion {max(times[10:]):.1f} ms (a column doubled), {sum(times) / 1e3:.1f} s for all")
    start = time.perf_counter()
    snapshot = map_.snapshot()
    print(f"snapshot of {len(snapshot.pt_ids)} points: {(time.perf_counter() - start) * 1e3:.0f} ms")


if __name__ == "__main__":
    main()
