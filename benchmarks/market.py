"""A supermarket: sessions along a real robot's paths, their common map, and growth over long drives.

    python benchmarks/market.py --size 424x400 --rate 15
    python benchmarks/market.py --parts map --length 40 --size 212x200 --rate 10 --queries 10
    python benchmarks/market.py --parts growth --length 20000 --distinct 600 --size 424x400 --rate 10

Parts: `map` puts the sessions of `sim:market` into one map (`map update`) and prints ATE after alignment (keyframes of
all sessions together, also as a share of the metres driven), size, and times; then single images of a further session,
driven a bit aside, are asked in it; it fails where one of them takes more than 0.3 s of processor time. `growth` drives
on from session to session in one run and prints, for each stretch, processor time a frame (without rendering; also in
units of ORB on both images, for a busy machine slows both), resident memory, keyframes and points, and medians of the
time of a keyframe; at some places also the size of the map and the time to open it, and the size of the log (lean and
without views of the whole map, as the service writes it). It fails where the last tenth
needs more than 1.2 times the ORBs of the stretch around 600 m (medians), or 1.5 times the memory. With `--distinct` so
many metres are rendered into a file and driven there and back again and again, so that all after them is known.
"""

from __future__ import annotations

import argparse
import multiprocessing
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from _sequences import one_thread

one_thread()

import cv2
import numpy as np
import psutil
from both_directions import aligned, drive
from sessions import Truth, asked, on_disk, put_in, truth_of

from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import Config
from stereo_sfm.drivers.source import BaseSource, open_source
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.export.floor_plan import make_floor_plan
from stereo_sfm.log.run_log import RunLog
from stereo_sfm.log.writer import LogWriter
from stereo_sfm.mapping.mapper import Mapper
from stereo_sfm.maps.folders import saved_map_of
from stereo_sfm.maps.saved_map import SavedMap
from stereo_sfm.messages import StageTimes
from stereo_sfm.pipeline.allocator import return_large_blocks
from stereo_sfm.pipeline.inline import InlineRun
from stereo_sfm.types import StereoImage, Trajectory

ATE_SHARE, GOOD_SHARE = 0.0005, 0.96  # required of the map of three sessions
QUERY_S = 0.3  # processor time allowed for every single image
ORB_EVERY = 20  # frames
DESCRIBED_M = 100.0, 600.0, 5000.0  # where the map is saved and opened, besides the end
FROM_M, TIME_RATIO, MEMORY_RATIO = 600.0, 1.2, 1.5  # required of the growth


def one_map(options: str, sessions: int, queries: int, seed: int) -> bool:
    """Sessions in one map; whether it is as exact as required."""
    saved: SavedMap | None = None
    truth: Truth = {}
    metres = 0.0
    for n in range(sessions):
        spec = f"sim:market?seed={seed}&walk={n}{options}"
        begin = time.perf_counter()
        walk = drive(spec)
        drove, begin = time.perf_counter() - begin, time.perf_counter()
        metres += float(np.linalg.norm(np.diff(walk.truth[:, :3, 3], axis=0), axis=1).sum())
        try:
            saved, session, loops, _ = put_in(saved, walk.saved)
        except StereoSfmError as error:
            print(f"session {n + 1}: NOT joined ({error})", flush=True)
            continue
        took = time.perf_counter() - begin
        s = walk.saved.snapshot
        truth |= {
            (session, stamp): walk.true_kf[k] for k, stamp in zip(s.kf_ids.tolist(), s.stamp_ns.tolist(), strict=True)
        }
        print(
            f"session {n + 1}: {len(walk.saved)} keyframes, driven in {drove:.0f} s with rendering; {loops} loops to"
            f" the map, put in in {took:.1f} s: {len(saved)} keyframes, {len(saved.snapshot.pt_ids)} points",
            flush=True,
        )
    assert saved is not None
    true = truth_of(saved, truth)
    off = (aligned(saved.snapshot.map_T_kf, true) @ saved.snapshot.map_T_kf - true)[:, :3, 3]
    ate = float(np.sqrt((off**2).sum(1).mean()))
    megabytes, opening = on_disk(saved)
    begin = time.perf_counter()
    plan = make_floor_plan(saved.snapshot)
    planned = time.perf_counter() - begin
    found = asked(saved, truth, f"sim:market?seed={seed}&walk={sessions}{options}", queries, seed)
    joined = len(saved.session_ids)
    print(
        f"{joined} of {sessions} sessions in one map, {metres:.0f} m, ATE {1e3 * ate:.1f} mm"
        f" ({100 * ate / metres:.3f} %); {megabytes:.1f} MB, opened in {opening:.2f} s; floor plan"
        f" {plan.image.shape[1]}x{plan.image.shape[0]} in {planned:.1f} s; of {queries}: {found}"
    )
    sure = found.good >= GOOD_SHARE * queries and not found.wrong and found.most_s <= QUERY_S
    return ate <= ATE_SHARE * metres and sure and joined == sessions


def render(spec: str, path: Path) -> tuple[Rig, Trajectory]:
    """Write the images of a simulated drive into a file, left and right in turn."""
    with open_source(spec) as source, path.open("wb") as file:
        assert source.ground_truth is not None
        for image in source:
            assert image.right is not None
            file.write(image.left.tobytes() + image.right.tobytes())
        return source.rig, source.ground_truth


class RenderedDrive(BaseSource):
    """A simulated drive from a file of its images, there and back until a length is reached.

    Another process renders them: its memory is not that of the run.
    """

    name = "rendered"

    def __init__(self, spec: str, length: float, path: Path) -> None:
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
            self.rig, true = pool.submit(render, spec, path).result()
        self._path, self._shape = path, (2, self.rig.left.height, self.rig.left.width)
        self._interval_ns = int(true.stamp_ns[1] - true.stamp_ns[0])
        steps = np.linalg.norm(np.diff(true.poses[:, :3, 3], axis=0), axis=1)
        laps = int(np.ceil(length / steps.sum()))
        there = np.arange(len(steps) + 1)
        self._order = np.concatenate([there[:1], *((there[1:], there[-2::-1])[lap % 2] for lap in range(laps))])
        driven = np.concatenate(
            [[0.0], np.cumsum(np.concatenate([steps[:: 1 - 2 * (lap % 2)] for lap in range(laps)]))]
        )
        self.driven = driven[driven <= length]

    def __iter__(self) -> Iterator[StereoImage]:
        size = int(np.prod(self._shape))
        with self._path.open("rb") as file:
            for k, row in enumerate(self._order[: len(self.driven)].tolist()):
                file.seek(row * size)
                left, right = np.frombuffer(file.read(size), np.uint8).reshape(self._shape)
                yield StereoImage(k, 1_000_000_000 + k * self._interval_ns, left, right)


def orb_seconds(orb: cv2.ORB, image: StereoImage) -> float:
    """Processor time of ORB on both images."""
    assert image.right is not None
    start = time.process_time()
    for eye in (image.left, image.right):
        orb.detectAndCompute(eye, None)
    return time.process_time() - start


class Logged:
    """A sink: a run's log, with the processor time that it takes."""

    def __init__(self, path: Path, source: RenderedDrive) -> None:
        self.path, self.seconds = path, 0.0
        self._log = RunLog(
            LogWriter(path), source.rig, Config(),
            source="market", mode="inline", image_format="none", whole_map=False,
        )  # fmt: skip

    def put(self, message: object) -> None:
        start = time.process_time()
        self._log.put(message)
        self.seconds += time.process_time() - start


class StretchTimes:
    """A sink: milliseconds of each keyframe in mapper and loop closer since the last line."""

    def __init__(self) -> None:
        self._ms: dict[str, list[float]] = {"map": [], "loop": []}

    def put(self, message: object) -> None:
        if isinstance(message, StageTimes):
            for stage, values in self._ms.items():
                if stage in message.ms:
                    values.append(message.ms[stage])

    def take(self) -> str:
        """Medians, and forget them."""
        text = ", ".join(f"{stage} {np.median(ms) if ms else np.nan:.0f} ms" for stage, ms in self._ms.items())
        self._ms = {stage: [] for stage in self._ms}
        return text


def growth(spec: str, length: float, stretch: float) -> bool:
    """One long run; whether time and memory stay as flat as required."""
    return_large_blocks()  # as the processes of a pipeline do
    process, orb = psutil.Process(), cv2.ORB.create(1000)
    rows = list[tuple[float, float, float]]()  # metres, ORBs a frame, MiB
    with tempfile.TemporaryDirectory() as folder:
        source = RenderedDrive(spec, length, Path(folder) / "images")
        driven, times = source.driven, StretchTimes()
        log = Logged(Path(folder) / "run.mcap", source)
        run = InlineRun(source, Config(), [times, log], None)
        mapper = run.map_stage.mapper
        assert isinstance(mapper, Mapper)
        begun, spent, orbs, until = 0, 0.0, list[float](), stretch
        for k, image in enumerate(source):
            start, logging = time.process_time(), log.seconds
            run.step(image)
            spent += time.process_time() - start - (log.seconds - logging)
            if k % ORB_EVERY == 0:
                orbs.append(orb_seconds(orb, image))
            if driven[k] < until and k + 1 < len(driven):
                continue
            memory = process.memory_info().rss / 2**20
            frame_s = spent / (k + 1 - begun)
            rows.append((float(driven[k]), frame_s / float(np.median(orbs)), memory))
            print(
                f"{driven[k]:7.0f} m: {1e3 * frame_s:6.1f} ms a frame, {rows[-1][1]:.2f} x ORB, {memory:6.0f} MiB,"
                f" {len(mapper.map.living_keyframes())} keyframes, {len(mapper.map.living_points())} points;"
                f" a keyframe: {times.take()}",
                flush=True,
            )
            if any(until <= metres < until + stretch for metres in DESCRIBED_M) or k + 1 == len(driven):
                describe(mapper, log.path)
            begun, spent, orbs, until = k + 1, 0.0, [], until + stretch
    early = min(rows, key=lambda row: abs(row[0] - FROM_M))
    late = np.median(rows[-max(len(rows) // 10, 1) :], axis=0)
    return bool(late[1] <= TIME_RATIO * early[1] and late[2] <= MEMORY_RATIO * early[2])


def describe(mapper: Mapper, log: Path) -> None:
    """Print the size of the map on disk, the time to open it, its floor plan, and the size of the log."""
    saved = saved_map_of(mapper, Config())
    assert saved is not None
    megabytes, opening = on_disk(saved)
    begin = time.perf_counter()
    plan = make_floor_plan(saved.snapshot)
    print(
        f"           map: {megabytes:.1f} MB, opened in {opening:.2f} s; floor plan"
        f" {plan.image.shape[1]}x{plan.image.shape[0]} in {time.perf_counter() - begin:.1f} s;"
        f" log {log.stat().st_size / 1e6:.1f} MB",
        flush=True,
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", default="map,growth", help="of map, growth")
    parser.add_argument("--sessions", type=int, default=3)
    parser.add_argument("--queries", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--size", default="", help="WIDTHxHEIGHT, the camera's own without")
    parser.add_argument("--rate", type=float, default=30.0)
    parser.add_argument("--length", type=float, default=0.0, help="metres of a session or of the long drive")
    parser.add_argument("--distinct", type=float, default=0.0, help="rendered metres of the long drive, 0: all")
    parser.add_argument("--stretch", type=float, default=100.0, help="metres between two lines of the growth")
    args = parser.parse_args()
    size = f"&size={args.size}" if args.size else ""
    passed = True
    if "map" in args.parts.split(","):
        options = f"&rate={args.rate}&length={args.length}{size}"
        passed &= one_map(options, args.sessions, args.queries, args.seed)
    if "growth" in args.parts.split(","):
        length = args.length or 2 * FROM_M
        distinct = min(args.distinct or length, length)
        spec = f"sim:market?seed={args.seed}&rate={args.rate}&length={distinct}{size}"
        passed &= growth(spec, length, args.stretch)
    return 0 if passed else 3


if __name__ == "__main__":
    sys.exit(main())
