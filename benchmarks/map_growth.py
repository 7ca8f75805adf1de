"""Time of a keyframe while the map grows, and in a place that the robot does not leave.

    python benchmarks/map_growth.py [--drive back|round --keyframes 10000]

Without options: one insertion at 100, 1,000 and 10,000 keyframes, 1,000,000 points, 4,000,000 sightings. Every keyframe
sees 400 points: 300 of the one before it, 100 new ones; every tenth also sees the 100 that were new 500 keyframes
earlier, as in a loop; each has 400 corners for place recognition. An insertion is the mapper's work on the map: new
points, observations, neighbours, the delta. Medians and 99th percentiles of the 100 insertions before each size; the
worst one includes the doubling of a column.

With --drive: a robot back and forth in one aisle, or around a gondola, for hours: the whole mapper and the
loop closer on keyframes as from a tracker, without images (`_aisle.py`). Processor time by stage, medians of
each tenth of the drive, beside that of ORB on a pair of images of noise in the same tenth, for a busy machine slows
both; fails where a keyframe in the end takes more than 1.1 times as many ORBs as around the 500th.
"""

from __future__ import annotations

import argparse
import os

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(variable, "1")

import sys
import time
from collections import deque
from collections.abc import Generator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

import cv2
import numpy as np
import psutil
from _aisle import Aisle, SimulatedTracker, round_and_round, there_and_back

from stereo_sfm.config import Config
from stereo_sfm.geometry import se3
from stereo_sfm.loop.closer import LoopCloser
from stereo_sfm.loop.vocabulary_file import default_vocabulary
from stereo_sfm.mapping.map import Map
from stereo_sfm.mapping.mapper import Mapper, run_job
from stereo_sfm.timing import Spans
from stereo_sfm.types import F64, I64, Corners, Keyframe, LoopResult
from tests.synthetic import fisheye_rig

SIZES = (100, 1_000, 10_000)
TRACKED, NEW, BACK = 300, 100, 500
CORNERS = 400
DRIVES = {"back": there_and_back, "round": round_and_round}
STAGES = ("map", "associate", "local_ba", "cull", "full_ba", "loop", "loop_words", "loop_query", "loop_verify")
EARLY, LARGEST_GROWTH = (400, 600), 1.1
ORB_EVERY = 10  # keyframes


def keyframe(kf_id: int, point_ids: I64, rng: np.random.Generator) -> Keyframe:
    """A keyframe at any pose with these points."""
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
    """The work of one keyframe on the map."""
    row = map_.add_keyframe(kf, kf.odom_T_cam)
    new = map_.point_rows(kf.point_ids) < 0
    map_.add_points(kf.point_ids[new], kf.points_cam[new], row)
    map_.observe(row, map_.point_rows(kf.point_ids), kf.uv_left, kf.uv_right, kf.descriptors)
    neighbours = map_.neighbours(row, 15)
    if len(neighbours):
        map_.sightings(map_.seen_by(int(neighbours[0])))
    map_.take_delta()


def insertions() -> None:
    """Print the table of insertions."""
    rng = np.random.default_rng(0)
    map_, process = Map(), psutil.Process()
    seen: list[I64] = []
    new: list[I64] = []
    times: list[float] = []
    base = process.memory_info().rss
    names = ("keyframes", "points", "sightings", "median ms", "p99 ms", "RSS MiB")
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
                f"{np.percentile(last, 99):11.2f}{rss:11.1f}",
                flush=True,
            )
    print(f"worst insertion {max(times[10:]):.1f} ms (a column doubled), {sum(times) / 1e3:.1f} s for all")
    start = time.perf_counter()
    snapshot = map_.snapshot()
    print(f"snapshot of {len(snapshot.pt_ids)} points: {(time.perf_counter() - start) * 1e3:.0f} ms")


class ProcessorSpans(Spans):
    """Stages in milliseconds of processor time: the machine may be busy."""

    @contextmanager
    def span(self, name: str) -> Generator[None, None, None]:
        start = time.process_time()
        try:
            yield
        finally:
            self._ms[name] = self._ms.get(name, 0.0) + (time.process_time() - start) * 1e3


class Drive:
    """One robot, its mapper and its loop closer."""

    def __init__(self, poses: F64, config: Config) -> None:
        rig = fisheye_rig()
        self._poses, self._lag = poses, config.pipeline.loop_lag_keyframes
        self._spans = ProcessorSpans()
        self.mapper = Mapper(config.mapper, rig, self._spans, config.loop)
        self.closer = LoopCloser(config.loop, rig, default_vocabulary(), self._spans)
        self._tracker = SimulatedTracker(Aisle(), rig)
        self._loops: deque[LoopResult] = deque()
        self.ms: list[dict[str, float]] = []
        self.error_m: list[float] = []
        self.loops = 0
        cv2.setNumThreads(1)
        size = rig.left.size[::-1]
        noise = np.random.default_rng(0).integers(0, 256, (2, *size), dtype=np.uint8)
        self._images = [cv2.GaussianBlur(image, (0, 0), 1.5) for image in noise]
        self._orb = cv2.ORB_create(1000)  # pyright: ignore[reportAttributeAccessIssue]

    def step(self, k: int) -> None:
        """All stages of the keyframe at the k-th pose; full bundle adjustments are not timed."""
        keyframe = self._tracker.step(self._poses[k])
        with self._spans.span("loop"):
            result = self.closer.step(keyframe)
        self.loops += result.candidate_kf_id >= 0
        self._loops.append(result)
        with self._spans.span("map"):
            update = self.mapper.step(keyframe, self._loops.popleft() if k >= self._lag else None)
        job = self.mapper.pending_job()
        if job is not None:
            self.mapper.finish_job(run_job(job))
        self._tracker.apply(update)
        if k % ORB_EVERY == 0:
            with self._spans.span("orb"):
                for image in self._images:
                    self._orb.detectAndCompute(image, None)
        self.ms.append(self._spans.take())
        truth = (se3.inverse(self._poses[0]) @ self._poses[k])[:3, 3]
        self.error_m.append(float(np.linalg.norm(self.mapper.map.keyframes.map_T_kf[-1, :3, 3] - truth)))

    def median(self, first: int, last: int, stage: str) -> float:
        """Milliseconds of a stage, of the keyframes from first to last."""
        return float(np.median([ms.get(stage, 0.0) for ms in self.ms[first:last]]))

    def mean(self, first: int, last: int, stage: str) -> float:
        """The mean, in units of ORB: a keyframe with a loop search takes many times the median."""
        return float(np.mean([ms.get(stage, 0.0) for ms in self.ms[first:last]])) / self.orb(first, last)

    def orb(self, first: int, last: int) -> float:
        """Milliseconds of ORB on two images in the same part of the drive."""
        return float(np.median([ms["orb"] for ms in self.ms[first:last] if "orb" in ms]))

    def row(self, first: int, last: int) -> str:
        """The table's row of the keyframes from first to last."""
        map_, cells = self.mapper.map, [self.median(first, last, stage) for stage in STAGES]
        p95 = [np.percentile([ms.get(stage, 0.0) for ms in self.ms[first:last]], 95) for stage in ("map", "loop")]
        living, error = int(map_.keyframes.alive.sum()), 1e3 * np.mean(self.error_m[first:last])
        rss = psutil.Process().memory_info().rss / 2**20
        cells = "".join(f"{ms:12.2f}" for ms in [*cells, *p95, self.orb(first, last)])
        return f"{last:11d}{cells}{living:9d}{int(map_.points.alive.sum()):9d}{error:9.2f}{rss:9.0f}"


def drive(name: str, count: int) -> int:
    """Print the table of a drive; 1 if the time of a keyframe grows."""
    run, edges = Drive(DRIVES[name](count), Config()), np.linspace(0, count, 11).astype(int).tolist()
    columns = "".join(f"{stage:>12}" for stage in (*STAGES, "map p95", "loop p95", "ORB"))
    print(f"{'keyframes':>11}{columns}{'living':>9}{'points':>9}{'error mm':>9}{'RSS MiB':>9}")
    for first, last in pairwise(edges):
        for k in range(first, last):
            run.step(k)
        print(run.row(first, last), flush=True)
    print(f"{run.loops} loops found")
    if count <= EARLY[1]:
        return 0
    first, last = (sum(run.mean(*part, stage) for stage in ("map", "loop")) for part in (EARLY, (edges[-2], count)))
    print(f"mean of mapper and loop closer: {first:.2f} ORB around the 500th keyframe, {last:.2f} in the last tenth")
    print(f"grown by a factor of {last / first:.2f}")
    return int(last / first > LARGEST_GROWTH)


def main() -> int:
    """Print one of the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--drive", choices=tuple(DRIVES), help="the whole mapper, in the same place for hours")
    parser.add_argument("--keyframes", type=int, default=10_000)
    args = parser.parse_args()
    if args.drive is None:
        insertions()
        return 0
    return drive(args.drive, args.keyframes)


if __name__ == "__main__":
    sys.exit(main())
