"""Processor time of the viewer: of its own process, and of the others.

    python benchmarks/viewer.py [--source SPEC] [--pairs N] [--frames N]

The pipeline of processes runs over the source with and without the viewer in turn. The processor time of each process
per frame is measured after the warm-up: it does not depend on the number of cores. The viewer writes to a file, which
is what it does for a window as well, without drawing. "hub" is the main process, which passes the messages on and
copies the images that are shown.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from _sequences import one_thread

one_thread()

import numpy as np
import psutil

from stereo_sfm.config import Config
from stereo_sfm.demo import demo_recording
from stereo_sfm.drivers.choice import MadeSource
from stereo_sfm.drivers.select import SelectedFrames
from stereo_sfm.drivers.source import Source, open_source
from stereo_sfm.pipeline.processes import ProcessRun
from stereo_sfm.pipeline.viewer import ViewerOptions

WARM_UP = 20  # frames


def opened(spec: str, frames: int) -> Source:
    """The first frames of a source, in the capture process."""
    return SelectedFrames(open_source(spec), max_frames=frames)


def spent_ms(process: psutil.Process) -> float:
    """Processor time until now."""
    cpu = process.cpu_times()
    return 1e3 * (cpu.user + cpu.system)


def measure(spec: str, frames: int, viewer: ViewerOptions | None) -> dict[str, float]:
    """Processor milliseconds a frame of the tracker, the hub, and the viewer, if any."""
    begin: dict[str, float] = {}
    end: dict[str, float] = {}
    seen = 0
    with ProcessRun(MadeSource.of(opened, spec, frames), Config(), viewer=viewer) as run:
        watched = {s: psutil.Process(pid) for s, pid in run.pids.items() if s in ("tracker", "viewer")}
        watched["hub"] = psutil.Process()
        for seen, _ in enumerate(run, 1):
            if seen in (WARM_UP, frames):
                end = {stage: spent_ms(process) for stage, process in watched.items()}
                begin = begin or end
    if seen != frames:
        raise SystemExit(f"{spec} has {seen} frames: use --frames {seen}")
    return {stage: (end[stage] - begin[stage]) / (frames - WARM_UP) for stage in end}


def main() -> None:
    """Print one line a pair of runs, then the medians."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--source", default=str(demo_recording()))
    parser.add_argument("--frames", type=int, default=250)
    parser.add_argument("--pairs", type=int, default=3)
    args = parser.parse_args()
    print("| tracker alone | with the viewer | ratio | hub alone | with the viewer | viewer |\n|" + "---|" * 6)
    rows: list[tuple[float, ...]] = []
    with tempfile.TemporaryDirectory() as folder:
        for k in range(args.pairs):
            shown = measure(args.source, args.frames, ViewerOptions("save", Path(folder) / f"{k}.rrd"))
            alone = measure(args.source, args.frames, None)
            ratio = shown["tracker"] / alone["tracker"]
            rows.append((alone["tracker"], shown["tracker"], ratio, alone["hub"], shown["hub"], shown["viewer"]))
            print(_line(rows[-1]), flush=True)
    print(_line(tuple(np.median(np.array(rows), axis=0).tolist())), "(medians, processor time a frame)")


def _line(row: tuple[float, ...]) -> str:
    parts = [f"{x:.2f}" if i == 2 else f"{x:.1f} ms" for i, x in enumerate(row)]
    return f"| {' | '.join(parts)} |"


if __name__ == "__main__":
    main()
