"""What the service's outputs keep in memory over hours of camera time.

    python benchmarks/outputs_memory.py [--hours 4] [--rate 30]

The messages of a service (poses, images, map, state, health, events) go to every output as fast as the slowest takes
them, each with clients that read, one that does not, and a page that is viewed. Printed is the resident memory of each
output's process and of this one, which has the service's queues, with its slope per hour of camera time after the first
quarter. `soak` does the same with a whole pipeline, which takes longer.
"""

from __future__ import annotations

import argparse
import os
import sys
import threading
import time
from typing import Any

from _sequences import one_thread

one_thread()

import numpy as np
from outputs import PAGE_PORT, SOCKET_PORT, Outputs, view_page, waits

from stereo_sfm.drivers.source import open_source
from stereo_sfm.messages import Health
from stereo_sfm.service.health import rss
from stereo_sfm.service.hub import Hub
from stereo_sfm.service.link import LIMIT, OutputProcess
from stereo_sfm.service.messages import (
    Event,
    HealthReport,
    MapCloud,
    PoseUpdate,
    PreviewImage,
    ServiceState,
    Started,
    Status,
)

SAMPLES = 80
POINTS, KEYFRAMES, TRACKS = 20_000, 500, 300
SLOPE_MB_H = 1.0  # allowed growth of a process


def messages(frame: int, rate: float, image: Any, rng: np.random.Generator) -> list[Any]:
    """What a service publishes at a frame; the map is as large all the time."""
    stamp = 10**9 + round(frame * 1e9 / rate)
    second = frame % round(rate) == 0
    out: list[Any] = [
        PoseUpdate(frame, stamp, stamp, time.monotonic(), "OK", "", np.eye(4), np.eye(4), np.eye(6) * 1e-4, np.zeros(6),
                   np.eye(6) * 1e-4, frame, 1, False, True, np.zeros(3))
    ]  # fmt: skip
    if frame % 6 == 0:
        uv = rng.uniform(0, min(image.shape), (TRACKS, 2))
        out.append(PreviewImage(frame, stamp, image, None, uv, np.zeros(TRACKS, np.int32), np.ones(TRACKS, np.bool_)))
    if second:
        stages = {n: Health(n, frame, rate, 0, 1.0, 2.0, 3.0, 0) for n in ("tracker", "mapper", "loop")}
        sizes = {f"stage {k}": frame for k in range(6)}
        out += [
            Status(ServiceState.RUNNING, reason=str(frame)),
            HealthReport(stamp, stages, rate, (10.0, 20.0), {}, {}, 10**10, 10**9, sizes, 0, 0.1),
            Event(stamp, "info", "tracker", f"line {frame}"),
        ]
    if frame % round(2 * rate) == 0:
        points = rng.uniform(-20, 20, (POINTS, 3)).astype(np.float32)
        poses = np.tile(np.eye(4), (KEYFRAMES, 1, 1))
        out.append(MapCloud(stamp, frame, 1, False, np.arange(POINTS), points, np.arange(KEYFRAMES), poses))
    return out


def waiting(process: OutputProcess) -> int:
    """Messages in the queue of an output."""
    outbox = process._outbox  # pyright: ignore[reportPrivateUsage]
    return 0 if outbox is None else len(outbox._waiting)  # pyright: ignore[reportPrivateUsage]


def sizes(outputs: Outputs) -> dict[str, float]:
    """Process -> MB."""
    pids = {process.name: process.pid or 0 for process in outputs.processes}
    return {name: rss(pid) / 1e6 for name, pid in {**pids, "queues": os.getpid()}.items()}


def main(args: list[str] | None = None) -> int:
    """Print a table; 1 where a process grows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hours", type=float, default=4.0, help="of camera time")
    parser.add_argument("--rate", type=float, default=30.0)
    o = parser.parse_args(args)
    with open_source("sim:loop?size=424x400&frames=1") as source:
        rig, image = source.rig, next(iter(source)).left
    outputs, rng, began = Outputs(Started(1, "sim:loop", rig, True)), np.random.default_rng(0), time.monotonic()
    hub, rows = Hub(outputs.processes), list[tuple[float, dict[str, float]]]()
    hub.on(PoseUpdate, lambda pose: None)
    hub.publish(Started(1, "sim:loop", rig, True))
    while not waits(PAGE_PORT):
        time.sleep(0.1)
    threading.Thread(target=view_page, daemon=True).start()
    count = round(o.hours * 3600 * o.rate)
    for frame in range(count):
        for message in messages(frame, o.rate, image, rng):
            hub.publish(message)
        while any(waiting(process) > LIMIT // 2 for process in outputs.processes):
            time.sleep(0.001)
        if frame % (count // SAMPLES) == 0:
            rows.append((frame / o.rate / 3600, sizes(outputs)))
    restarted = [process.name for process in outputs.processes if process.starts > 1]
    print(f"{count} frames, {o.hours:g} h of camera time in {(time.monotonic() - began) / 60:.1f} min, "
          f"ports {SOCKET_PORT} and {PAGE_PORT}")  # fmt: skip
    kept, wrong = rows[len(rows) // 4 :], [f"{name} died" for name in restarted]
    hours = np.array([hour for hour, _ in kept])
    for name in rows[0][1]:
        mb = np.array([size[name] for _, size in kept])
        slope, level = np.polyfit(hours, mb, 1)
        error = np.sqrt(np.mean((mb - slope * hours - level) ** 2) / len(mb)) / hours.std()
        print(f"  {name:12s} {rows[0][1][name]:7.1f} -> {mb[-1]:7.1f} MB  {slope:+8.2f} ± {error:.2f} MB/h")
        if slope > SLOPE_MB_H + 3 * error:
            wrong.append(f"{name} grows by {slope:.1f} MB an hour")
    outputs.close()
    print("\n".join(f"WRONG: {line}" for line in wrong) or "nothing grows")
    sys.stdout.flush()
    return bool(wrong)


if __name__ == "__main__":
    sys.exit(main())
