"""A simulated T265 at 30 Hz through the real driver for a minute: frames lost, and the processor time of the driver.

Run: python -m benchmarks.t265_stream [--seconds 60] [--images room] [--faults none]
"""

from __future__ import annotations

import argparse
import os
import sys
import time

import numpy as np

from stereo_sfm.drivers.source import open_source
from stereo_sfm.drivers.t265 import messages as m
from stereo_sfm.drivers.t265.simulated.bus import SimulatedBus
from stereo_sfm.drivers.t265.simulated.source import SimulatedT265Source


def measure(seconds: float, images: str, faults: str, frames: int) -> dict[str, float]:
    """Stream and count. Images are made before the clock starts; the consumer only takes them."""
    count = round(seconds * m.FRAME_RATE)
    with open_source("t265:simulated", images=images, faults=faults, frames=frames) as source:
        assert isinstance(source, SimulatedT265Source)
        bus = source._access.backend
        assert isinstance(bus, SimulatedBus)
        stamps: list[int] = []
        late_ms: list[float] = []
        first_dropped = 0
        wall, cpu, simulated = time.monotonic(), time.process_time(), bus.thread_ns
        for image in source:
            segment = source._segment
            assert segment is not None
            first_dropped = image.dropped_before if not stamps else first_dropped
            stamps.append(image.stamp_ns)
            late_ms.append((time.monotonic_ns() - segment.clock.to_host(image.stamp_ns - source._time.stamp(0))) * 1e-6)
            if time.monotonic() - wall >= seconds or len(stamps) >= count:
                break
        wall, cpu = time.monotonic() - wall, time.process_time() - cpu
        simulated = (bus.thread_ns - simulated) * 1e-9
        c = source.counters
        shown = source.frame_shown(stamps[-1]) - source.frame_shown(stamps[0]) + 1  # frames the camera made meanwhile
        return {
            "seconds": wall,
            "pairs": c["pairs"],
            "dropped": c["dropped"],
            "lost_without_being_counted": shown - len(stamps) - (c["dropped"] - first_dropped),
            "camera_overruns": source.camera.overruns,
            "imu_samples": c["imu_samples"],
            "rate_hz": (len(stamps) - 1) / ((stamps[-1] - stamps[0]) * 1e-9),
            "megabytes_per_s": c["pairs"] * 2 * m.VIDEO_BYTES / wall * 1e-6,
            "cpu_percent_process": 100 * cpu / wall,
            "cpu_percent_simulated_camera": 100 * simulated / wall,
            "cpu_percent_driver": 100 * (cpu - simulated) / wall,
            "latency_ms_p50": float(np.percentile(late_ms, 50)),
            "latency_ms_p99": float(np.percentile(late_ms, 99)),
            "load_average": os.getloadavg()[0],
        }


def main() -> int:
    """Command line; 3 when a frame was lost without being counted."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60)
    parser.add_argument("--images", default="room", help="room, or a source such as sim:loop")
    parser.add_argument("--faults", default="none", help="names of stereo_sfm.drivers.t265.simulated.faults.PRESETS")
    parser.add_argument("--frames", type=int, default=30, help="images rendered before the start")
    options = parser.parse_args()
    numbers = measure(options.seconds, options.images, options.faults, options.frames)
    for name, value in numbers.items():
        print(f"{name:30} {value:10.2f}")
    return 3 if numbers["lost_without_being_counted"] else 0


if __name__ == "__main__":
    sys.exit(main())
