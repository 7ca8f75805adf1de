"""The service for hours of camera time, with everything that goes wrong on a robot: what grows, what recovers.

    python -m benchmarks soak -- [--minutes 240] [--realtime 30] [--attacks] [--most MINUTES]
                               [--source SPEC] [--work DIR]

Images come from memory, a lap through the store there and back again and again: first at 30 Hz by the clock, for an
eighth of the time, then as fast as the pipeline takes them. The camera is unplugged, the lights go out, the disk fills
up (by its limits), each stage is killed or stopped; the last part is left alone. All outputs that are installed are on
but ROS 2, and a client reads the pose socket. Printed: the resident memory of each process with its slope per hour of
camera time (without the first half hour after its start), every fault and how long it took, missing poses, dropped
images, delays in the part by the clock, recordings against their quota. The exit code is 1 if anything is wrong.

With `--attacks`, turns alone, with attacks and beside eight busy loops alternate in the part by the clock; printed is
how many poses of each were late. Not more may be with attacks than alone. Turns alone and with attacks go on after it.
"""

from __future__ import annotations

import argparse
import importlib.util
import itertools
import json
import multiprocessing
import os
import signal
import socket
import sys
import tempfile
import threading
import time
from array import array
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks._soak_attacks import SURE_S, Turns
from stereo_sfm.calib.formats.native import read_native, write_native
from stereo_sfm.drivers.choice import MadeSource
from stereo_sfm.drivers.source import BaseSource, open_source
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.log.reader import LogReader
from stereo_sfm.recording.segments import recordings, segments
from stereo_sfm.service.config import MapConfig, RecordingConfig, RobotConfig
from stereo_sfm.service.health import rss
from stereo_sfm.service.messages import HealthReport, PoseUpdate, Started, Status
from stereo_sfm.service.outputs import OUTPUTS
from stereo_sfm.service.outputs.settings import (
    FoxgloveConfig,
    OutputsConfig,
    PageConfig,
    PoseSocketConfig,
    SecurityConfig,
)
from stereo_sfm.service.service import Service
from stereo_sfm.types import F64, StereoImage

RATE = 30.0
PAUSE_S = 0.5  # between two images: a fault, not the rate
UNPLUGGED_S, DARK_FRAMES = 2.0, 60
STAGES = ("capture", "tracker", "mapper", "loop", "optimizer", "recorder")
SETTLE_S = 60.0  # for the service to run again after a fault
SLOPE_MB_H = 1.0  # allowed growth of a process
LONG_MIN = 60.0  # minutes of camera time from which growth can be measured
WARM_MIN = 30.0  # minutes of camera time after the start of a process that its slope leaves out
MIN_MINUTES = 20.0  # of camera time that a slope must cover to mean anything
QUOTA_GB, SEGMENT_MIN = 0.4, 0.1
SIZES_EVERY = 60  # reports, each of a second: what is kept of them grows, too
RESTART_S = 5.0  # from the death of a stage to the next pose
FOUND_FRAMES = 300  # for a pose after the lights are on again
TOKEN = "of-the-soak-and-its-client"
SOCKET_PORT, FOXGLOVE_PORT, PAGE_PORT = 17100, 18865, 18180


class StoreCamera(BaseSource):
    """Images in a file in memory, there and back; each life goes on where the one before ended."""

    name = "soak"

    def __init__(
        self, folder: Path, count: int, unplugged: tuple[int, ...], dark: tuple[int, ...], by_clock: int = 0
    ) -> None:
        """Args: by_clock, that many of the first frames come at 30 Hz."""
        self.rig = read_native(folder / "rig.yaml")
        self._left, self._right = (np.load(folder / f"{side}.npy", mmap_mode="r") for side in ("left", "right"))
        self._at = np.memmap(folder / "at", np.int64, "r+", shape=(1,))
        self._count, self._unplugged, self._dark = count, set(unplugged), dark
        self._by_clock = by_clock

    def __iter__(self) -> Iterator[StereoImage]:
        n = len(self._left)
        due = time.monotonic()
        for k in range(int(self._at[0]), self._count):
            self._at[0] = k + 1
            if k in self._unplugged:
                time.sleep(UNPLUGGED_S)
                due = time.monotonic()
            if k < self._by_clock:
                time.sleep(max(0.0, due - time.monotonic()))
                due = max(due + 1.0 / RATE, time.monotonic())  # a camera does not make up for what it has not taken
            at = k % (2 * n - 2)
            at = at if at < n else 2 * n - 2 - at
            left, right = np.array(self._left[at]), np.array(self._right[at])
            if any(begin <= k < begin + DARK_FRAMES for begin in self._dark):
                left, right = np.zeros_like(left), np.zeros_like(right)
            yield StereoImage(k, 1_000_000_000 + round(k * 1e9 / RATE), left, right)


def store(spec: str, distinct: int, folder: Path) -> None:
    """Render or read the images, once for a folder."""
    if not (folder / "rig.yaml").exists():
        with open_source(spec) as source:
            images = list(itertools.islice(source, distinct))
            rig = source.rig
        np.save(folder / "left.npy", np.stack([image.left for image in images]))
        np.save(folder / "right.npy", np.stack([image.right for image in images if image.right is not None]))
        write_native(rig, folder / "rig.yaml")
    np.zeros(1, np.int64).tofile(folder / "at")


@dataclass(frozen=True)
class Sizes:
    """The processes over a minute by the clock."""

    frame: int
    least: dict[str, int]  # resident bytes
    most: dict[str, int]
    pids: dict[str, int]


@dataclass
class Watch:
    """What the service says."""

    frame: int = -1
    by_clock: int = 0  # that many of the first frames
    poses: int = 0
    untracked: int = 0
    losses: list[list[int]] = field(default_factory=list[list[int]])  # first and last frame without a pose
    counts_from_s: float = 0.0  # a while after the last start and the last loss
    arrived: array[float] = field(default_factory=lambda: array("d"))  # when captured, when posed: by the clock
    missing: dict[int, int] = field(default_factory=dict[int, int])  # first missing frame -> how many
    states: list[tuple[int, str, str]] = field(default_factory=list[tuple[int, str, str]])
    sessions: list[int] = field(default_factory=list[int])  # frames at which they began
    rss: list[Sizes] = field(default_factory=list["Sizes"])
    minute: list[tuple[dict[str, int], dict[str, int]]] = field(
        default_factory=list[tuple[dict[str, int], dict[str, int]]]
    )  # sizes and process ids so far
    health: HealthReport | None = None
    segment: int = 0  # bytes of the largest one
    over_quota: float = 0.0
    tracked: bool = False
    session: int = 0
    turns: Turns | None = None

    def pose(self, pose: PoseUpdate) -> None:
        if pose.frame_id > self.frame + 1:
            self.missing[self.frame + 1] = pose.frame_id - self.frame - 1
        if not pose.tracked:
            if self.tracked or not self.losses:
                self.losses.append([pose.frame_id, pose.frame_id])
            self.losses[-1][1] = pose.frame_id
        self.frame, self.tracked = pose.frame_id, pose.tracked
        self.poses += 1
        self.untracked += not pose.tracked
        now = time.monotonic()
        if not pose.tracked:
            self.counts_from_s = now + SURE_S
        if pose.frame_id >= self.by_clock:
            if self.turns is not None:
                self.turns.rest()
        elif now >= self.counts_from_s and (self.turns is None or self.turns.pose(pose.captured_s, now)):
            self.arrived.extend((pose.captured_s, now))

    def start(self, started: Started) -> None:
        if started.session > self.session:  # else it tells how the camera is mounted
            self.session = started.session
            self.sessions.append(self.frame + 1)
            self.counts_from_s = time.monotonic() + SURE_S

    def status(self, status: Status) -> None:
        if not self.states or self.states[-1][1] != status.state:
            self.states.append((self.frame, str(status.state), status.reason))

    def report(self, report: HealthReport, pids: dict[str, int]) -> None:
        self.health = report
        self.minute.append(({**report.rss, "service": rss(os.getpid())}, {**pids, "service": os.getpid()}))
        if len(self.minute) == SIZES_EVERY:
            pids = self.minute[-1][1]
            seen = {n: [sizes[n] for sizes, of in self.minute if sizes.get(n) and of.get(n) == pids[n]] for n in pids}
            least, most = ({n: of(sizes) for n, sizes in seen.items() if sizes} for of in (min, max))
            self.rss.append(Sizes(self.frame, least, most, pids))
            self.minute.clear()


def plan(count: int, times: int, kills: int) -> tuple[list[tuple[int, str]], tuple[int, ...], tuple[int, ...]]:
    """(frame, fault) in order, and the frames of unplugging and darkness.

    The first 24th is left alone. In a long soak restarts come in the first quarter, so that the last life of every
    process is long, and other faults in the first half; in a short one they are spread over most of it.
    """
    long = count >= LONG_MIN * 60 * RATE
    kinds = (
        ([f"kill {s}" for _ in range(kills) for s in STAGES] + ["stop tracker", "stop mapper"], 0.25 if long else 0.9),
        ([*["disk full"] * 2, *["unplug"] * times, *["dark"] * times], 0.5 if long else 0.9),
    )
    rng, events = np.random.default_rng(1), list[tuple[int, str]]()
    for faults, end in kinds:
        rng.shuffle(faults)
        events += zip(np.linspace(count / 24, end * count, len(faults)).astype(int).tolist(), faults, strict=True)
    unplugged = tuple(f for f, kind in events if kind == "unplug")
    dark = tuple(f for f, kind in events if kind == "dark")
    return sorted(e for e in events if e[1] not in ("unplug", "dark")), unplugged, dark


def cause(service: Service, watch: Watch, fault: str) -> float:
    """Make one fault happen; seconds until poses come again."""
    kind, _, what = fault.partition(" ")
    began, session = time.monotonic(), len(watch.sessions)
    if kind == "disk":
        service.set_setting("recording.min_free_gb", "900000")
        wait_for(lambda: watch.states[-1][1] == "disk_full")
        service.set_setting("recording.min_free_gb", "0.05")
        wait_for(lambda: watch.states[-1][1] != "disk_full")
        return time.monotonic() - began
    wait_for(lambda: service.pids.get(what) is not None)
    pid = service.pids[what]
    os.kill(pid, signal.SIGKILL if kind == "kill" else signal.SIGSTOP)
    if what in ("recorder", "loop"):  # which cost no session
        wait_for(lambda: service.pids.get(what) not in (None, pid))
    else:
        wait_for(lambda: len(watch.sessions) > session and watch.tracked)
    return time.monotonic() - began


def wait_for(what: Any) -> None:
    end = time.monotonic() + SETTLE_S
    while not what():
        if time.monotonic() > end:
            raise TimeoutError(f"the service did not recover within {SETTLE_S:.0f} s")
        time.sleep(0.02)


@dataclass(frozen=True)
class Growth:
    """Of one process: its least or its largest size of every minute."""

    mb: float  # of the last minute
    mb_h: float  # an hour of camera time


def slope(hours: F64, sizes: list[int]) -> float:
    """MB an hour; NaN if there are no two sizes."""
    return float(np.polyfit(hours, np.array(sizes) / 1e6, 1)[0]) if len(sizes) > 1 else float("nan")


def growth(rss: list[Sizes]) -> dict[str, tuple[Growth, Growth, float]]:
    """Process -> least size, largest size, and hours of its last life without the first half hour, in camera time."""
    out: dict[str, tuple[Growth, Growth, float]] = {}
    for name in sorted({name for sizes in rss for name in sizes.least}):
        seen = [sizes for sizes in rss if name in sizes.least]
        life = [sizes for sizes in seen if sizes.pids[name] == seen[-1].pids[name]]
        warm = [sizes for sizes in life if sizes.frame >= life[0].frame + WARM_MIN * 60 * RATE]
        x = np.array([sizes.frame / RATE / 3600 for sizes in warm])
        least = Growth(life[-1].least[name] / 1e6, slope(x, [sizes.least[name] for sizes in warm]))
        most = Growth(life[-1].most[name] / 1e6, slope(x, [sizes.most[name] for sizes in warm]))
        out[name] = least, most, float(np.ptp(x)) if len(x) else 0.0
    return out


def connected(until_s: float) -> socket.socket:
    """To the pose socket, as soon as it listens."""
    while True:
        try:
            return socket.create_connection(("127.0.0.1", SOCKET_PORT))
        except ConnectionRefusedError:
            if time.monotonic() > until_s:
                raise
        time.sleep(0.1)


def read_poses(send: Any) -> None:
    """Body of a client of the pose socket: poses, how many it missed as stated, and (frame, count) of other gaps."""
    seen, missed, gaps, last = 0, 0, list[tuple[int, int]](), (-1, -1)
    with suppress(OSError):
        connection = connected(time.monotonic() + SETTLE_S)
        connection.sendall(TOKEN.encode() + b"\n")
        for line in connection.makefile():
            pose = json.loads(line)
            now, stated = (pose["session"], pose["frame_id"]), pose["missed"]
            seen, missed = seen + 1, missed + stated
            if now[0] == last[0] and now[1] - last[1] - 1 > stated:
                gaps.append((last[1] + 1, now[1] - last[1] - 1 - stated))
            last = now
    send.send((seen, missed, gaps))


def run(o: argparse.Namespace, work: Path) -> list[str]:
    """One soak; what is not as it must be."""
    count = int(o.minutes * 60 * RATE)
    by_clock = int((o.minutes / 8 if o.realtime is None else o.realtime) * 60 * RATE)
    store(o.source, o.distinct, work)
    events, unplugged, dark = plan(count, o.times, o.kills)
    turns = Turns(work, PAGE_PORT, FOXGLOVE_PORT, SOCKET_PORT) if o.attacks else None
    watch, wrong, took = Watch(by_clock=by_clock, turns=turns), list[str](), list[tuple[int, str, float]]()
    source = MadeSource.of(StoreCamera, work, count, unplugged, dark, by_clock)
    spawn = multiprocessing.get_context("spawn")
    receive, send = spawn.Pipe(False)
    client = spawn.Process(target=read_poses, args=(send,), daemon=True)
    began = time.monotonic()
    installed = {n: m for n, m in OUTPUTS.items() if n in outputs_here()}
    with Service(configuration(work), source, outputs=installed) as service:
        client.start()
        service.on(PoseUpdate, watch.pose)
        service.on(Status, watch.status)
        service.on(HealthReport, lambda report: watch.report(report, service.pids))
        service.on(Started, watch.start)
        observing = threading.Thread(target=observe, args=(service, work / "recordings", watch, count), daemon=True)
        observing.start()
        if turns is not None:
            wait_for(lambda: watch.poses)
            turns.start()
        for frame, fault in events:
            while watch.frame < frame and not service.wait(0.05):
                pass
            try:
                took.append((frame, fault, cause(service, watch, fault)))
                print(f"  frame {frame:7d}  {fault:16s} {took[-1][2]:5.1f} s", flush=True)
                if not fault.startswith("disk") and took[-1][2] > RESTART_S:
                    wrong.append(f"frame {frame}, {fault}: {took[-1][2]:.1f} s until the next pose")
            except TimeoutError as error:
                wrong.append(f"frame {frame}, {fault}: {error}")
        cut = False
        while not (cut or service.wait(1.0)):
            cut = o.most is not None and time.monotonic() - began > 60 * o.most
        if turns is not None:
            turns.end()
        stop_s = time.monotonic()
    print(f"{watch.frame + 1} frames, {watch.frame / RATE / 60:.0f} of {o.minutes:g} min of camera time "
          f"in {(time.monotonic() - began) / 60:.1f} min")  # fmt: skip
    print(f"poses {watch.poses}, without a pose {watch.untracked}, sessions {len(watch.sessions)}; "
          f"ended in {time.monotonic() - stop_s:.1f} s")  # fmt: skip
    if service.error is not None:
        wrong.append(f"the service ended by itself: {service.error}")
    elif not cut and watch.frame < count - RATE:
        wrong.append(f"it ended at frame {watch.frame} of {count}")
    socket_seen = receive.recv() if receive.poll(10.0) else None
    wrong += judge_memory(watch) + judge_poses(watch, dark, socket_seen) + judge_faults(watch, o.times)
    wrong += turns.judge() if turns is not None else []
    return wrong + judge_recordings(watch, work / "recordings") + judge_clock(watch)


def outputs_here() -> set[str]:
    """Outputs whose libraries are installed; a node of ROS 2 would be seen by others."""
    needs = {"foxglove": "websockets", "page": "uvicorn", "pose_socket": "socket"}
    return {name for name, module in needs.items() if importlib.util.find_spec(module) is not None}


def configuration(work: Path) -> RobotConfig:
    """A map that is saved, a black box with a small quota, and outputs."""
    here = outputs_here()
    token = work / "state" / "stereo-sfm" / "token"
    token.parent.mkdir(parents=True, exist_ok=True)
    token.touch(0o600)
    token.write_text(TOKEN)
    return RobotConfig(
        map=MapConfig(str(work / "store"), "extend", save_every_min=5.0),
        recording=RecordingConfig(
            folder=str(work / "recordings"), mode="black_box", image_format="raw", segment_min=SEGMENT_MIN,
            mark_losses=False, quota_gb=QUOTA_GB, min_free_gb=0.05, black_box_min=1.0,
        ),
        outputs=OutputsConfig(
            PoseSocketConfig(True, f"tcp://127.0.0.1:{SOCKET_PORT}"),
            FoxgloveConfig("foxglove" in here, port=FOXGLOVE_PORT),
        ),
        page=PageConfig("page" in here, port=PAGE_PORT),
        security=SecurityConfig(token_file=str(token)),
    )  # fmt: skip


def observe(service: Service, root: Path, watch: Watch, count: int) -> None:
    """Compare recordings with their quota, and print how far it is."""
    began = time.monotonic()
    for k in itertools.count(1):
        if service.wait(1.0):
            return
        sizes = [segment.bytes for folder in recordings(root) for segment in segments(folder)]
        watch.segment = max(watch.segment, *sizes, 0)
        watch.over_quota = max(watch.over_quota, sum(sizes) - QUOTA_GB * 1e9)
        if k % 60 == 0:
            now = watch.rss[-1].least if watch.rss else {}
            listed = ", ".join(f"{name} {size / 1e6:.0f}" for name, size in sorted(now.items()))
            seconds = time.monotonic() - began
            print(f"  {seconds / 60:5.1f} min: frame {watch.frame} of {count}; MB: {listed}", flush=True)


def judge_memory(watch: Watch) -> list[str]:
    """Print the sizes of the processes; those that grow."""
    wrong: list[str] = []
    for name, (least, most, hours) in growth(watch.rss).items():
        sizes = [f"{size.mb:7.1f} MB {size.mb_h:+6.2f} MB/h" for size in (least, most)]
        print(f"  {name:12s} {', at most '.join(sizes)}, over {hours:.2f} h")
        if hours * 60 >= MIN_MINUTES and least.mb_h > SLOPE_MB_H:
            wrong.append(f"{name} grows by {least.mb_h:.1f} MB an hour")
    return wrong


def judge_poses(watch: Watch, dark: tuple[int, ...], read: tuple[int, int, list[tuple[int, int]]] | None) -> list[str]:
    """Print what is missing in callbacks and at the pose socket, and losses; what nothing explains."""
    unexplained = {k: n for k, n in watch.missing.items() if not any(k <= s <= k + n + 1 for s in watch.sessions)}
    print(f"  frames missing between poses: {sum(watch.missing.values())}, unexplained: {unexplained or 'none'}")
    wrong = [f"{n} frames missing from {k}" for k, n in unexplained.items()]
    if read is None:
        return [*wrong, "the client of the pose socket did not end"]
    print(f"  pose socket: {read[0]} poses read, {read[1]} stated as missed, gaps not stated: {read[2] or 'none'}")
    wrong += [f"pose socket: {n} poses missing from {k}, not stated" for k, n in read[2]]
    lit = [(begin, end) for begin, end in watch.losses if end - begin >= FOUND_FRAMES + DARK_FRAMES]
    in_dark = sum(any(d <= begin < d + DARK_FRAMES for begin, _ in watch.losses) for d in dark)
    longest = max((end - begin + 1 for begin, end in watch.losses), default=0)
    print(f"  losses: {len(watch.losses)}, {in_dark} of {len(dark)} in the dark, the longest {longest} frames")
    wrong += [f"lost from frame {begin} to {end}" for begin, end in lit]
    return wrong if watch.tracked else [*wrong, "tracking was lost at the end"]


def judge_faults(watch: Watch, times: int) -> list[str]:
    """Print states and dropped images; what should have been seen, and drops in the part without a clock."""
    states = [state for _, state, _ in watch.states]
    print("  states: " + ", ".join(f"{name} {states.count(name)}" for name in sorted(set(states))))
    dropped = {} if watch.health is None else watch.health.dropped
    print(f"  dropped images: {dropped or 'none'}")
    wrong = [f"dropped at {where}: {n} images" for where, n in dropped.items() if n]
    if states.count("camera_gone") < times:
        wrong.append(f"camera_gone {states.count('camera_gone')} of {times} times")
    return wrong


def judge_recordings(watch: Watch, root: Path) -> list[str]:
    """Open each file alone and each recording as a source; what cannot be read, or is too much."""
    wrong, files, images = list[str](), 0, 0
    for folder in recordings(root):
        for path in (path for s in segments(folder) for path in (s.poses, s.images) if path.exists()):
            files += 1
            try:
                with LogReader(path) as reader:
                    if not sum(1 for _ in reader.messages()):
                        wrong.append(f"{path.name} is empty")
            except StereoSfmError as error:
                wrong.append(str(error))
        if any(s.images.exists() for s in segments(folder)):
            with open_source(folder) as source:
                images += sum(1 for _ in source)
    print(f"  recordings: {files} files read, {images} images replayed, the largest segment "
          f"{watch.segment / 1e6:.0f} MB, quota exceeded by {max(watch.over_quota, 0) / 1e6:.0f} MB")  # fmt: skip
    if watch.over_quota > watch.segment:
        wrong.append(f"the quota was exceeded by {watch.over_quota / 1e6:.0f} MB")
    return wrong


def judge_clock(watch: Watch) -> list[str]:
    """Print rate and latency of the part by the clock; whether it kept up."""
    if not watch.by_clock:
        return []
    if len(watch.arrived) < 4:
        return ["no poses to measure a rate from"]
    captured, posed = np.array(watch.arrived).reshape(-1, 2).T
    steps, delay = np.diff(captured), (posed - captured) * 1e3
    rate = 1 / steps[steps < PAUSE_S].mean()
    print(f"  by the clock: {len(captured)} poses at {rate:.2f} Hz, image to pose at a callback "
          f"{np.median(delay):.0f} ms, 95 % {np.percentile(delay, 95):.0f} ms")  # fmt: skip
    return [f"{rate:.2f} poses a second instead of {RATE:g}"] if not rate >= 0.99 * RATE else []


def main(args: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=240.0, help="of camera time")
    parser.add_argument("--source", default="sim:loop?size=424x400")
    parser.add_argument("--realtime", type=float, help="minutes at the beginning that come by the clock")
    parser.add_argument("--most", type=float, help="minutes by the clock after which it ends, whatever is left")
    parser.add_argument("--attacks", action="store_true", help="and busy loops, in turn with minutes without")
    parser.add_argument("--distinct", type=int, default=1260, help="images in memory: one lap")
    parser.add_argument("--times", type=int, default=10, help="unplugged and dark so often")
    parser.add_argument("--kills", type=int, default=3, help="of each stage")
    parser.add_argument("--work", type=Path, help="folder, kept")
    o = parser.parse_args(args)
    with tempfile.TemporaryDirectory() as temporary:
        work = o.work or Path(temporary)
        work.mkdir(parents=True, exist_ok=True)
        wrong = run(o, work)
    print("\n".join(f"WRONG: {line}" for line in wrong) or "all as it must be")
    return bool(wrong)


if __name__ == "__main__":
    sys.exit(main())
