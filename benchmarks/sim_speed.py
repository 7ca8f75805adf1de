"""How fast the simulated store renders: stereo frames a second on one core, over frames spread along each scene.

    python benchmarks/sim_speed.py [SOURCE ...]

CPU seconds of this process, single-threaded, so that other programs on the machine matter little.
"""

from __future__ import annotations

import sys
import time

import numpy as np

from drivers.sim.source import SimSource
from drivers.source import open_source

SOURCES = ("sim:loop", "sim:people", "sim:identical-aisles", "sim:loop?camera=pinhole", "sim:loop?size=424x400")
FRAMES = 12


def measure(spec: str) -> str:
    """One line of the table."""
    begin = time.process_time()
    source = open_source(spec)
    assert isinstance(source, SimSource)
    source.frame(0)  # builds the store and the rays, compiles
    ready = time.process_time() - begin
    clean, whole = list[float](), list[float]()
    for k in np.linspace(30, source.frame_ids[-1], FRAMES).astype(int).tolist():
        begin = time.process_time()
        source.clean(k)
        middle = time.process_time()
        source.frame(k)
        clean.append(middle - begin)
        whole.append(time.process_time() - middle)
    width, height = source.rig.left.size
    return (
        f"{spec:28s} {width}x{height}  {1 / np.mean(whole):5.2f} stereo frames/s/core  "
        f"(rays {1e3 * np.mean(clean):4.0f} ms, sensor {1e3 * (np.mean(whole) - np.mean(clean)):4.0f} ms, "
        f"first frame after {ready:.1f} s)"
    )


if __name__ == "__main__":
    for spec in sys.argv[1:] or SOURCES:
        print(measure(spec), flush=True)
