"""What the viewer costs: its own process, and the tracker beside it.

    python benchmarks/viewer.py [--source SPEC] [--pairs N] [--frames N]

The pipeline of processes runs over the source with and without the viewer in turn, so that a busy machine slows both
alike. The viewer writes to a file, which is what it does for a window as well, without drawing. Its cost is the
processor time of its process, from its first frame on; the tracker's is the time of its step.
"""

from __future__ import annotations

import argparse
import functools
import tempfile
from dataclasses import dataclass
from pathlib import Path

from _sequences import one_thread

one_thread()

import numpy as np
import psutil

from drivers.select import SelectedFrames
from drivers.source import Source, open_source
from stereo_sfm.config import Config
from stereo_sfm.demo import demo_recording
from stereo_sfm.pipeline.processes import ProcessRun
from stereo_sfm.pipeline.sinks import StageTimes
from stereo_sfm.pipeline.workers import ViewerOptions

WARM_UP = 20  # frames


class Times:
    """A sink: the tracker's milliseconds a frame."""

    def __init__(self) -> None:
        self.track: list[float] = []

    def put(self, message: object) -> None:
        if isinstance(message, StageTimes) and "track" in message.ms:
            self.track.append(message.ms["track"])


@dataclass(frozen=True)
class Cost:
    """Of one run."""

    track_ms: float  # median
    viewer_ms: float  # processor time a frame, NaN without a viewer


def opened(spec: str, frames: int) -> Source:
    """The first frames of a source, in the capture process."""
    return SelectedFrames(open_source(spec), max_frames=frames)


def measure(spec: str, frames: int, viewer: ViewerOptions | None) -> Cost:
    """One run."""
    times = Times()
    spent: list[float] = []
    with ProcessRun(functools.partial(opened, spec, frames), Config(), [times], viewer=viewer) as run:
        shown = psutil.Process(run.pids["viewer"]) if viewer is not None else None
        for _ in run:
            if shown is not None and shown.is_running():
                cpu = shown.cpu_times()
                spent.append(cpu.user + cpu.system)
    steps = times.track[WARM_UP:]
    per_frame = 1e3 * (spent[-1] - spent[WARM_UP]) / (len(spent) - 1 - WARM_UP) if spent else float("nan")
    return Cost(float(np.median(steps)), per_frame)


def main() -> None:
    """Print one line a pair of runs, then the medians."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--source", default=str(demo_recording()))
    parser.add_argument("--frames", type=int, default=250)
    parser.add_argument("--pairs", type=int, default=3)
    args = parser.parse_args()
    print("| tracking step alone | with the viewer | ratio | viewer's process, processor time a frame |")
    print("|---|---|---|---|")
    rows: list[tuple[float, float, float, float]] = []
    with tempfile.TemporaryDirectory() as folder:
        for k in range(args.pairs):
            shown = measure(args.source, args.frames, ViewerOptions("save", Path(folder) / f"{k}.rrd"))
            alone = measure(args.source, args.frames, None)
            rows.append((alone.track_ms, shown.track_ms, shown.track_ms / alone.track_ms, shown.viewer_ms))
            print(_line(rows[-1]), flush=True)
    print(_line(tuple(np.median(np.array(rows), axis=0).tolist())), "(medians)")


def _line(row: tuple[float, ...]) -> str:
    alone, shown, ratio, viewer = row
    return f"| {alone:.1f} ms | {shown:.1f} ms | {ratio:.2f} | {viewer:.1f} ms |"


if __name__ == "__main__":
    main()
