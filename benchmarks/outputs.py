"""What the outputs of the service add to a pose's way, and what they cost the tracker.

    python benchmarks/outputs.py [--source SPEC] [--frames N] [--rate HZ]

The tracker takes images by the clock, as of a camera; each pose goes to every output, in its own process behind its
queue, as the service does it. Clients, processes of their own, read them: lines of the pose socket, the WebSocket of
Foxglove, and the topic `odom` where rclpy is installed; one more client of the pose socket never reads. Printed is, for
each output, the time from the image to the pose at the client beside the tracker's own.

Then a whole service runs with every output, a page that is viewed, and that same client: what its tracker's process
spends a frame (processor time of all its threads) while messages are published, and while none is, in turns over the
same images.
"""

# The packages of ROS come with a robot's ROS, not from this project's environment.
# pyright: reportMissingImports=false

from __future__ import annotations

import argparse
import importlib.util
import json
import multiprocessing
import pickle
import socket
import struct
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from _sequences import one_thread

one_thread()

import numpy as np
from soak import StoreCamera, store

from stereo_sfm.drivers.choice import MadeSource
from stereo_sfm.drivers.source import open_source
from stereo_sfm.service.config import MapConfig, RecordingConfig, RobotConfig
from stereo_sfm.service.link import OutputProcess
from stereo_sfm.service.messages import PoseUpdate, PreviewImage, ServiceState, Started, Status
from stereo_sfm.service.outputs import OUTPUTS
from stereo_sfm.service.outputs.settings import (
    FoxgloveConfig,
    OutputsConfig,
    PageConfig,
    PoseSocketConfig,
    Ros2Config,
    SecurityConfig,
)
from stereo_sfm.service.publisher import Reply
from stereo_sfm.service.service import Service
from stereo_sfm.system import Tracker
from stereo_sfm.types import Frame, StereoImage

SOCKET_PORT, FOXGLOVE_PORT, PAGE_PORT = 17000, 18765, 18080
Arrivals = dict[int, float]  # frame id (or stamp) -> monotonic seconds


def update_of(frame: Frame, captured_s: float) -> PoseUpdate:
    """A frame of the tracker as the service sends it."""
    return PoseUpdate(
        frame.frame_id, frame.stamp_ns, frame.stamp_ns, captured_s, frame.state.name, frame.reason, np.eye(4),
        frame.odom_T_cam, frame.covariance, np.zeros(6), np.eye(6), frame.map_version, 1, False, True, np.zeros(3),
    )  # fmt: skip


def read_socket(arrivals: Arrivals) -> None:
    """A client of the pose socket."""
    for line in socket.create_connection(("127.0.0.1", SOCKET_PORT)).makefile():
        arrivals[json.loads(line)["stamp_ns"]] = time.monotonic()


def read_foxglove(arrivals: Arrivals) -> None:
    """A client of Foxglove's WebSocket that wants `/odom`."""
    from websockets.exceptions import ConnectionClosed
    from websockets.sync.client import connect

    address = f"ws://127.0.0.1:{FOXGLOVE_PORT}"
    with suppress(ConnectionClosed), connect(address, subprotocols=["foxglove.sdk.v1"], max_size=None) as client:  # type: ignore[list-item]
        while True:
            said = client.recv()
            if isinstance(said, bytes) and said[0] == 1:
                arrivals[struct.unpack_from("<Q", said, 5)[0]] = time.monotonic()
            elif isinstance(said, str) and json.loads(said)["op"] == "advertise":
                rows = [c for c in json.loads(said)["channels"] if c["topic"] == "/odom"]
                wanted = [{"id": 1, "channelId": c["id"]} for c in rows]
                client.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))


def read_ros2(arrivals: Arrivals) -> None:
    """A node that subscribes to `odom`."""
    import rclpy
    from nav_msgs.msg import Odometry

    def received(message: Any) -> None:
        stamp = message.header.stamp
        arrivals[stamp.sec * 10**9 + stamp.nanosec] = time.monotonic()

    rclpy.init(args=[])
    node = rclpy.create_node("benchmark")
    node.create_subscription(Odometry, "odom", received, 100)
    rclpy.spin(node)


READERS: dict[str, Callable[[Arrivals], None]] = {
    "pose_socket": read_socket,
    "foxglove": read_foxglove,
    "ros2": read_ros2,
}


def run_reader(name: str, end: Connection) -> None:
    """Body of a client's process: read until asked for what has arrived."""
    arrivals = Arrivals()
    threading.Thread(target=READERS[name], args=(arrivals,), daemon=True).start()
    end.recv()
    end.send(dict(arrivals))


class Reader:
    """A client of an output in a process of its own: it takes no time from the interpreter of the tracker."""

    def __init__(self, name: str) -> None:
        spawn = multiprocessing.get_context("spawn")
        self._end, other = spawn.Pipe()
        self._process = spawn.Process(target=run_reader, args=(name, other), daemon=True)
        self._process.start()

    def arrivals(self) -> Arrivals:
        """Ends it."""
        self._end.send("end")
        found = self._end.recv()
        self._process.kill()
        return found


def waits(port: int) -> bool:
    """Whether somebody listens."""
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


def installed() -> list[str]:
    """The outputs that can run here."""
    return [n for n in OUTPUTS if n != "ros2" or importlib.util.find_spec("rclpy") is not None]


def everything() -> RobotConfig:
    """Every output on."""
    sections = OutputsConfig(
        PoseSocketConfig(True, f"tcp://127.0.0.1:{SOCKET_PORT}"),
        FoxgloveConfig(True, port=FOXGLOVE_PORT),
        Ros2Config(True),
    )
    security = SecurityConfig(auth="none")
    return RobotConfig(outputs=sections, page=PageConfig(True, port=PAGE_PORT), security=security)


class Outputs:
    """Every output with its client, and one client that does not read."""

    def __init__(self, started: Started) -> None:
        config, names = everything(), installed()
        self.processes = [OutputProcess(name, config, lambda *_: Reply(True)) for name in names]
        for process in self.processes:
            process.start()
        while not all(process.wants for process in self.processes) or not waits(SOCKET_PORT):
            time.sleep(0.05)
        self.readers = {name: Reader(name) for name in names if name in READERS}
        self._silent = socket.create_connection(("127.0.0.1", SOCKET_PORT))
        self._silent.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        self.offer(started)
        self.offer(Status(ServiceState.RUNNING))
        time.sleep(5.0)  # for the readers to be there

    def offer(self, message: Any) -> None:
        """To every output that wants it."""
        data = pickle.dumps(message, pickle.HIGHEST_PROTOCOL)
        for process in self.processes:
            process.offer(type(message), data)

    def close(self) -> None:
        """End the processes."""
        for process in self.processes:
            process.close()


def drive(
    tracker: Tracker, images: list[StereoImage], first: int, rate: float, outputs: Outputs | None, captured: Arrivals,
    done: Arrivals,
) -> None:  # fmt: skip
    """Track images by the clock."""
    begin = time.monotonic()
    for i, image in enumerate(images):
        stamp = 10**9 + round((first + i) * 1e9 / rate)
        time.sleep(max(0.0, begin + i / rate - time.monotonic()))
        now = time.monotonic()
        frame = tracker.step(image.left, image.right, stamp)
        captured[stamp], done[stamp] = now, time.monotonic()
        if outputs is not None:
            outputs.offer(update_of(replace(frame, frame_id=first + i), now))
            if i % 6 == 0:
                seen = frame.observations
                outputs.offer(PreviewImage(first + i, stamp, image.left, None, seen.uv_left, seen.age, seen.inlier))


class PacedCamera(StoreCamera):
    """Images from memory, there and back, by the clock."""

    def __init__(self, folder: Path, count: int, rate: float) -> None:
        super().__init__(folder, count, (), ())
        self._rate = rate

    def __iter__(self) -> Iterator[StereoImage]:
        begin = time.monotonic()
        for k, image in enumerate(super().__iter__()):
            time.sleep(max(0.0, begin + k / self._rate - time.monotonic()))
            yield image


def processor_ms(pid: int) -> float:
    """Processor time of all threads of a process so far, from the scheduler's nanoseconds."""
    with suppress(OSError):
        files = list(Path(f"/proc/{pid}/task").glob("*/schedstat"))
        return sum(int(file.read_text().split()[0]) for file in files) / 1e6
    return 0.0


def view_page() -> None:
    """Read the live state and images of the page as a browser does."""
    address = f"http://127.0.0.1:{PAGE_PORT}/api/"
    while True:
        with suppress(OSError):
            urllib.request.urlopen(f"{address}image.jpg", timeout=5).read()
            urllib.request.urlopen(f"{address}map", timeout=5).read()
        time.sleep(0.3)


def tracker_cost(spec: str, distinct: int, rate: float, rounds: int) -> tuple[list[float], list[float]]:
    """Milliseconds a frame of a service's tracker: of each round with all outputs, and of each without."""
    lap = 2 * distinct - 2
    with TemporaryDirectory() as name:
        work = Path(name)
        store(spec, distinct, work)
        config = replace(
            everything(), map=MapConfig(str(work / "map"), "none"), recording=RecordingConfig(str(work / "recordings"))
        )
        source = MadeSource.of(PacedCamera, work, lap * (2 * rounds + 2), rate)
        poses = list[PoseUpdate]()
        with Service(config, source, outputs={name: OUTPUTS[name] for name in installed()}) as service:
            hub = service._hub  # pyright: ignore[reportPrivateUsage]
            publish, silent = hub.publish, threading.Event()

            def some(message: Any) -> None:
                if not silent.is_set():
                    publish(message)
                elif isinstance(message, PoseUpdate):
                    poses.append(message)

            hub.publish = some
            service.on(PoseUpdate, poses.append)
            for port in (SOCKET_PORT, FOXGLOVE_PORT, PAGE_PORT):
                while not waits(port):
                    time.sleep(0.5)
            not_reading = socket.create_connection(("127.0.0.1", SOCKET_PORT))
            not_reading.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            for reader, arguments in ((read_socket, ({},)), (read_foxglove, ({},)), (view_page, ())):
                threading.Thread(target=reader, args=arguments, daemon=True).start()
            spent: dict[bool, list[float]] = {True: [], False: []}
            while not poses:
                time.sleep(0.1)
            first = lap * (poses[-1].frame_id // lap + 1)  # of a lap in which every kernel is loaded
            for k in range(2 * rounds):
                before = after = 0.0
                for end in (first + k * lap, first + (k + 1) * lap):
                    while poses[-1].frame_id < end and not service.wait(0.0):
                        time.sleep(0.005)
                    before, after = after, processor_ms(service.pids.get("tracker", 0))
                if service.wait(0.0):
                    break
                spent[k % 2 == 0].append((after - before) / lap)
                print(f"{'with' if k % 2 == 0 else 'without'} outputs: {(after - before) / lap:.2f} ms", flush=True)
                silent.clear() if k % 2 else silent.set()
            service.stop()
        return spent[True], spent[False]


def print_latencies(args: argparse.Namespace) -> None:
    """A table of the time from image to pose at each output."""
    with open_source(f"{args.source}{'&' if '?' in args.source else '?'}frames={args.frames}") as source:
        rig, name, images = source.rig, source.name, list(source)
    images += images[::-1]  # forth and back, so that the tracker can go on
    tracker, captured, done = Tracker(rig), Arrivals(), Arrivals()
    drive(tracker, images, 0, args.rate, None, captured, done)  # kernels
    with ExitStack() as open_:
        outputs = Outputs(Started(1, name, rig, True))
        open_.callback(outputs.close)
        for k in range(args.rounds):
            drive(tracker, images, (k + 1) * len(images), args.rate, outputs, captured, done)
        time.sleep(0.5)
        found = {output: reader.arrivals() for output, reader in outputs.readers.items()}
    own = np.array([done[s] - captured[s] for s in done]) * 1e3
    print(f"| output | image to pose, median | 95 % | added, median | 95 % | poses |\n|{'---|' * 6}")
    print(f"| tracker | {np.median(own):.1f} ms | {np.percentile(own, 95):.1f} ms | | | {len(own)} |")
    sent = args.rounds * len(images)
    for output, arrivals in found.items():
        whole = np.array([at - captured[s] for s, at in arrivals.items() if s in captured]) * 1e3
        added = np.array([at - done[s] for s, at in arrivals.items() if s in done]) * 1e3
        if not len(whole):
            print(f"| {output} | no pose arrived | | | | 0 of {sent} |")
            continue
        cells = [np.median(whole), np.percentile(whole, 95), np.median(added), np.percentile(added, 95)]
        print(f"| {output} | {' | '.join(f'{c:.1f} ms' for c in cells)} | {len(whole)} of {sent} |")


def main() -> None:
    """Print a table of latencies, and the tracker's time with and without the outputs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--source", default="sim:loop?size=424x400&start=60")
    parser.add_argument("--frames", type=int, default=60, help="distinct images")
    parser.add_argument("--rate", type=float, default=30.0)
    parser.add_argument("--rounds", type=int, default=4)
    parser.add_argument("--what", choices=("latency", "cost", "both"), default="both")
    args = parser.parse_args()
    if args.what != "cost":
        print_latencies(args)
    if args.what != "latency":
        on, off = (np.array(times) for times in tracker_cost(args.source, args.frames, args.rate, args.rounds))
        n = min(len(on), len(off))
        ratios = on[:n] / off[:n] - 1
        error = ratios.std(ddof=1) / np.sqrt(n) if n > 1 else float("nan")
        print(f"\ntracker: {off.mean():.2f} ms a frame without messages, {on.mean():.2f} ms with all outputs: "
              f"{ratios.mean():+.1%} ± {error:.1%} over {n} pairs")  # fmt: skip


if __name__ == "__main__":
    main()
