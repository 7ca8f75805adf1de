"""Rendering speed of the simulated store: stereo frames a second on one core, for frames spread over each scene.

    python benchmarks/sim_speed.py [SOURCE ...]

CPU seconds of this process, single-threaded; for each frame the fastest of three renderings is used.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

import numpy as np

from stereo_sfm.drivers.sim.source import SimSource
from stereo_sfm.drivers.source import open_source

SOURCES = ("sim:loop", "sim:people", "sim:identical-aisles", "sim:loop?camera=pinhole", "sim:loop?size=424x400")
FRAMES, REPEATS = 12, 3


def _best(render: Callable[[int], object], frame_id: int) -> float:
    """CPU seconds of the fastest of REPEATS: other programs on the machine only add to the time."""
    taken = list[float]()
    for _ in range(REPEATS):
        begin = time.process_time()
        render(frame_id)
        taken.append(time.process_time() - begin)
    return min(taken)


def measure(spec: str) -> str:
    """One line of the table."""
    begin = time.process_time()
    source = open_source(spec)
    assert isinstance(source, SimSource)
    source.frame(0)  # builds the store and the rays, compiles
    ready = time.process_time() - begin
    frames = np.linspace(30, source.frame_ids[-1], FRAMES).astype(int).tolist()
    clean = [_best(source.clean, k) for k in frames]
    whole = [_best(source.frame, k) for k in frames]
    width, height = source.rig.left.size
    return (
        f"{spec:28s} {width}x{height}  {1 / np.mean(whole):5.2f} stereo frames/s/core  "
        f"(rays {1e3 * np.mean(clean):4.0f} ms, sensor {1e3 * (np.mean(whole) - np.mean(clean)):4.0f} ms, "
        f"first frame after {ready:.1f} s)"
    )


if __name__ == "__main__":
    for spec in sys.argv[1:] or SOURCES:
        print(measure(spec), flush=True)
