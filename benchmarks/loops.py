"""Effect of mapping and loops on the trajectory: odometry alone, with mapping, with mapping and loops, in one pass.

Every frame is rendered once and goes through all runs, so the numbers are of the same images. The last lines
check that mapping and loops never increase the odometry's error by more than 5 %.

    python benchmarks/loops.py                       # sim:loop with the fisheye and the pinhole pair
    python benchmarks/loops.py sim:loop --frames 300
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from _sequences import one_thread

one_thread()

import numpy as np
from _runs import recorded_together

from stereo_sfm.config import Config
from stereo_sfm.drivers.source import Source, open_source
from stereo_sfm.eval.evaluate import evaluate
from stereo_sfm.eval.record import RunRecord
from stereo_sfm.geometry import se3
from stereo_sfm.types import F64, StereoImage


def configurations(only: str = "") -> dict[str, Config]:
    """The runs to compare."""
    base = Config()
    table = {
        "odometry": replace(base, mapper=replace(base.mapper, enabled=False), loop=replace(base.loop, enabled=False)),
        "mapping": replace(base, loop=replace(base.loop, enabled=False)),
        "loops": base,
        "averaging": replace(base, loop=replace(base.loop, correction="averaging")),
    }
    return {name: config for name, config in table.items() if not only or name in only.split(",")}


def images(source: Source, frames: int, stored: Path | None) -> Iterator[StereoImage]:
    """The source's images; with `stored` (N, 2, H, W) the pixels are read from that file instead of rendered."""
    if stored is None:
        for n, image in enumerate(source):
            if frames and n >= frames:
                return
            yield image
        return
    pictures = np.load(stored, mmap_mode="r")
    assert source.ground_truth is not None
    for n, stamp in enumerate(source.ground_truth.stamp_ns[: frames or None].tolist()):
        yield StereoImage(n, stamp, np.array(pictures[n, 0]), np.array(pictures[n, 1]))


def measure(spec: str, frames: int, stored: Path | None, only: str) -> None:
    """One sequence through all runs, and the table."""
    with open_source(spec) as source:
        truth = source.ground_truth
        assert truth is not None
        configs = configurations(only)
        begin = time.perf_counter()
        together = recorded_together(source, list(configs.values()), images(source, frames, stored))
        records = dict(zip(configs, together, strict=True))
        by_stamp = dict(zip(truth.stamp_ns.tolist(), truth.poses, strict=True))
        print(f"\n{spec}: {len(next(iter(records.values())).frames)} frames in {time.perf_counter() - begin:.0f} s")
        print("run         ATE mm  % of path  Sim(3) mm  end mm  keyframes  loops  rejected")
        for name, record in records.items():
            trajectory = record.mapped() if name != "odometry" else record.odometry()
            assert trajectory is not None
            e = evaluate(trajectory, truth)
            end = _end_error(trajectory.poses, np.array([by_stamp[s] for s in trajectory.stamp_ns.tolist()]))
            rejected = ", ".join(f"{n} {reason}" for reason, n in sorted(record.rejected.items())) or "-"
            print(
                f"{name:11s} {1e3 * e.ape_m.rmse:6.1f}  {e.ate_percent:9.3f}  {1e3 * e.ate_sim3_m:9.1f}"
                f"  {1e3 * end:6.1f}  {len(record.keyframes):9d}  {len(record.loops):5d}  {rejected}"
            )
        for name in ("loops", "averaging"):
            if name in records:
                _print_loops(name, records[name], by_stamp)


def _end_error(estimate: F64, truth: F64) -> float:
    """Metres between the end points with aligned start poses."""
    a, b = se3.inverse(estimate[0]) @ estimate[-1], se3.inverse(truth[0]) @ truth[-1]
    return float(np.linalg.norm(a[:3, 3] - b[:3, 3]))


def _print_loops(name: str, record: RunRecord, by_stamp: dict[int, F64]) -> None:
    """Accepted loops with their true errors."""
    for loop in record.loops:
        a, b = record.keyframes[loop.candidate_kf_id], record.keyframes[loop.kf_id]
        true = se3.inverse(by_stamp[a.stamp_ns]) @ by_stamp[b.stamp_ns]
        error = se3.inverse(true) @ loop.candidate_T_kf
        print(
            f"{name}: keyframe {loop.kf_id} at {loop.candidate_kf_id}, {1e3 * np.linalg.norm(error[:3, 3]):.1f} mm off"
        )
    if record.loops:
        print(f"{name}: {len(record.loops)} accepted, {Counter(record.rejected).total()} candidates rejected")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sources", nargs="*", default=["sim:loop", "sim:loop?camera=pinhole"])
    parser.add_argument("--frames", type=int, default=0, help="at most so many")
    parser.add_argument("--stored", type=Path, help="pictures (N, 2, H, W) in a .npy file instead of the renderer's")
    parser.add_argument("--only", default="", help="runs to make, separated by commas")
    args = parser.parse_args()
    for spec in args.sources:
        measure(spec, args.frames, args.stored, args.only)
    return 0


if __name__ == "__main__":
    sys.exit(main())
