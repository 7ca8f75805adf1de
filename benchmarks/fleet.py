"""A fleet's nights with everything that goes wrong: workers killed, the storage away, uploads cut off and sent twice.

    python benchmarks/fleet.py                                    20 stores, 3 nights
    python benchmarks/fleet.py --stores 200 --kills 30            the whole fleet; hours on two cores
    python benchmarks/fleet.py --stores 2 --nights 2 --kills 2    a look

An S3 server (moto's, with conditional puts that are atomic) answers a tenth of all requests with 503, half of these
after it has carried them out, and is stopped for 20 s. A Ray cluster of three nodes on this computer loses workers at
random moments, and the driver is killed and started again. Each store gets the map of a session from a robot each
night. The first store's robot is offline for all nights and sends everything at the end; the second one's sends
everything twice; an upload of the third one is cut off and sent again; a version of the last one is rolled back. For
each sentence it prints whether it holds.
"""

from __future__ import annotations

import argparse
import itertools
import os

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(variable, "1")

import random
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

import _figures
import psutil
from _figures import Figure

from stereo_sfm.config import Config
from stereo_sfm.fleet.catalogue import ask, delta_bytes, opened
from stereo_sfm.fleet.copies import fetch_version
from stereo_sfm.fleet.editing import checked_out, session_id
from stereo_sfm.fleet.versions import current, history, publish, read_head, roll_back
from stereo_sfm.maps.put_session import put_session
from stereo_sfm.maps.saved_map import load_map, save_map
from stereo_sfm.storage import objects
from stereo_sfm.storage.folders import send_folder
from stereo_sfm.storage.objects import Changed
from stereo_sfm.storage.remote import Remote
from tests.fleet.s3_server import BUCKET, Server, server
from tests.loop.store_sequence import make_sequence
from tests.maps.maps import map_of_sequence, same

ROOT = Path(__file__).parents[1]
NODES = 3
FAILING, HELD_S = 0.1, 20.0
MOST_DELTA = 2_000_000  # bytes a night


class Verdicts:
    """One row a sentence."""

    def __init__(self) -> None:
        self.failed = 0
        self.figures: list[Figure] = []

    def row(self, sentence: str, holds: bool, figure: str) -> None:
        self.failed += not holds
        self.figures.append(Figure(sentence, "", f"{figure}: {'holds' if holds else 'does not hold'}"))
        print(f"| {sentence} | {figure} | {'PASS' if holds else 'FAIL'} |", flush=True)


def make_sessions(folder: Path, nights: int, points: int, keyframes: int) -> list[Path]:
    """The maps that a robot makes in the same aisle, one a night."""
    out: list[Path] = []
    for night in range(nights):
        sequence = make_sequence([0], seed=5, noise_px=0.2 + 0.01 * night, max_points=points)
        out.append(folder / f"session{night}")
        save_map(
            map_of_sequence(sequence.first(min(keyframes, len(sequence.keyframes)) - night)), out[-1], compress=False
        )
    return out


def by_hand(folder: Path, sessions: list[Path]) -> float:
    """The store as `map update` makes it; returns the seconds it took."""
    begin = time.perf_counter()
    for session in sessions:
        put_session(folder, load_map(session), session.name, Config(), compress=False)
    return time.perf_counter() - begin


def night_of(k: int) -> str:
    return f"2026-11-{20 + k:02d}"


class Driver:
    """`stereo-sfm fleet run` in a process that can be killed."""

    def __init__(self, plan: Path, address: str) -> None:
        command = [sys.executable, "-m", "stereo_sfm.cli", "fleet", "run", str(plan), "--address", address]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)

    def wait(self) -> tuple[int, str]:
        text = self.process.communicate()[0]
        return self.process.returncode, text.strip().splitlines()[-1] if text.strip() else ""


class Killer:
    """Kills workers of this cluster, and now and then the driver, at random moments."""

    def __init__(self, count: int, pause_s: float, seed: int) -> None:
        self._left, self._pause_s, self._random = count, pause_s, random.Random(seed)
        self.killed, self._over = 0, threading.Event()
        self._ours = psutil.Process().pid
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def _work(self) -> None:
        while self._left and not self._over.wait(self._random.uniform(0, 2 * self._pause_s)):
            workers = [p for p in psutil.Process(self._ours).children(recursive=True) if _busy(p)]
            if workers:
                with_pid = self._random.choice(workers)
                try:
                    with_pid.kill()
                except psutil.Error:
                    continue
                self.killed += 1
                self._left -= 1

    def close(self) -> None:
        self._over.set()
        self._thread.join()


def _busy(process: psutil.Process) -> bool:
    """Whether it is a worker that carries out a job."""
    try:
        return "ray::_within" in " ".join(process.cmdline())
    except psutil.Error:
        return False


def night(verdicts: Verdicts, options: argparse.Namespace, s3: Server, folder: Path) -> None:
    """All nights of all stores under faults, then the sentences."""
    sessions = make_sessions(folder, options.nights, options.points, options.keyframes)
    hand_s = by_hand(folder / "hand", sessions)
    hand = load_map(folder / "hand")
    root, names = Remote("s3", BUCKET, "chain"), [f"{k:03d}" for k in range(options.stores)]
    plan = folder / "plan.toml"
    plan.write_text(f'[fleet]\nroot = "{root}"\n[job]\nmemory_gb = 0.0\nminutes = 30.0\nretries = 20\n')
    from ray.cluster_utils import Cluster

    cluster: Any = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    for _ in range(NODES - 1):
        cluster.add_node(num_cpus=1)
    s3.faults(FAILING)
    killer = Killer(options.kills, options.pause, options.seed)
    begin = time.perf_counter()
    drivers, held_s, whole = 0, 0.0, b""
    try:
        for k, session in enumerate(sessions):
            last = k == len(sessions) - 1
            for store in names:
                walks = root / store / "walks" / "r1"
                send = [session] if store != names[0] else (sessions if last else [])  # offline until the last night
                for one in send:
                    send_folder(one, walks / f"{night_of(int(one.name[-1]))}_2200")
                if store == names[1 % len(names)] and send:
                    send_folder(session, walks / f"{night_of(k)}_2200")
                    send_folder(session, walks / f"{night_of(k)}_2200_again")
            if len(names) > 2 and last:  # cut off, then sent again after a first run
                cut = root / names[2] / "walks" / "r1" / f"{night_of(k)}_2200" / "points.npz"
                whole = objects.read(cut)
                objects.write(cut, whole[: len(whole) // 2])
            driver = Driver(plan, cluster.address)
            drivers += 1
            time.sleep(options.pause)
            driver.process.kill()  # at some moment of its work
            driver.wait()
            driver = Driver(plan, cluster.address)
            drivers += 1
            if k == 0:
                time.sleep(options.pause)
                s3.hold()
                time.sleep(HELD_S)
                s3.go_on()
                held_s += HELD_S
            code, text = driver.wait()
            print(f"# night {k}: exit {code}, {text}", file=sys.stderr, flush=True)
        if len(names) > 2:
            cut = root / names[2] / "walks" / "r1" / f"{night_of(len(sessions) - 1)}_2200" / "points.npz"
            objects.write(cut, whole)
            code, text = Driver(plan, cluster.address).wait()
            print(f"# after the second upload: exit {code}, {text}", file=sys.stderr, flush=True)
        fault_s = time.perf_counter() - begin
        killer.close()
        s3.faults(0.0)
        code, again = Driver(plan, cluster.address).wait()
        verdicts.row("a run that has nothing to do does nothing", code == 0 and " 0 of " in again, again)
    finally:
        killer.close()
        cluster.shutdown()
    verdicts.row(
        f"{options.stores} stores x {options.nights} nights with {killer.killed} workers and {len(sessions)} drivers "
        f"killed, the storage held for {held_s:.0f} s, {100 * FAILING:.0f} % failing answers", code == 0,
        f"{fault_s:.0f} s, {drivers} drivers",
    )  # fmt: skip
    stores = {name: current(root / name / "map") for name in names}
    wanted = {session_id(load_map(session)) for session in sessions}
    complete = sum(set(version.sessions) == wanted for version in stores.values())
    verdicts.row("nothing lost, nothing double", complete == len(names), f"{complete} of {len(names)} stores")
    equal = 0
    for name, version in stores.items():
        fetch_version(root / name / "map", version, folder / "robots" / name)
        equal += same(load_map(folder / "robots" / name).snapshot, hand.snapshot)
    verdicts.row("same bits as `map update` by hand", equal == len(names), f"{equal} of {len(names)} stores")
    with opened(root, names) as connection:
        rows = ask(connection, "SELECT count(*), count(DISTINCT (store, session)) FROM walks WHERE ok")[1]
    count = options.nights * (len(names) + (1 if len(names) > 1 else 0))
    verdicts.row("a catalogue row for each walk", rows == f"{count},{options.nights * len(names)}", rows)
    numbers = history(root / names[-1] / "map")
    deltas = [delta_bytes(a, b) for a, b in itertools.pairwise(numbers)]
    most = max(deltas, default=0)
    verdicts.row("a robot's nightly delta", most <= MOST_DELTA, f"{most / 1e6:.3f} MB of "
                 f"{sum(f.stored for f in numbers[0].files.values()) / 1e6:.3f} MB")  # fmt: skip
    before = numbers[1] if len(numbers) > 1 else None
    if before is not None:
        rolled = roll_back(root / names[-1] / "map")
        verdicts.row("a version rolled back", rolled.name == before.name, f"version {rolled.number} again")
    print(f"# by hand one store took {hand_s:.1f} s", file=sys.stderr)


def two_writers(verdicts: Verdicts, folder: Path) -> None:
    """Both write the same store at the same time, ten times."""
    store = Remote("s3", BUCKET, "writers")
    (folder / "x").mkdir()
    (folder / "x" / "map.json").write_text("0")
    publish(store, folder / "x", read_head(store), {"begin": ""}, [], "benchmark")
    outcomes: list[bool] = []
    for turn in range(10):
        barrier = threading.Barrier(2)

        def write(k: int, barrier: threading.Barrier = barrier) -> None:
            try:
                with checked_out(store) as out:
                    (out.folder / "map.json").write_text(f"{k}")
                    barrier.wait()
                    out.publish({f"{k}": ""}, [])
                outcomes.append(True)
            except Changed:
                outcomes.append(False)

        threads = [threading.Thread(target=write, args=(2 * turn + k,)) for k in range(2)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    held = len(current(store).sessions) - 1
    verdicts.row(
        "of two writers one is refused", outcomes.count(True) == 10 == held, f"{outcomes.count(True)} of 20 wrote"
    )


def one_file(verdicts: Verdicts, s3: Server, megabytes: int) -> None:
    """`info` of a large recording: the demo's images over and over, as they lie in a long recording."""
    from stereo_sfm.demo import demo_recording
    from stereo_sfm.drivers.source import open_source
    from stereo_sfm.log.reader import LogReader
    from stereo_sfm.recording.record import record

    remote = Remote("s3", BUCKET, "long.mcap")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "long.mcap"
        from stereo_sfm.drivers.repeated import RepeatedSource

        with RepeatedSource(open_source(demo_recording())) as source:
            frames = record(source, path, "raw")
            for progress in frames:
                if progress.bytes_written > megabytes * 1e6:
                    break
            frames.close()
        objects.write(remote, path)
        with LogReader(path) as reader:
            index = reader.bytes - max(c.chunk_start_offset + c.chunk_length for c in reader.summary.chunk_indexes)
            # The start check decodes at most 150 images; each of them is in a chunk of its own, or shares one.
            decoded = sum(c.chunk_length for c in reader.summary.chunk_indexes[:150])
        size = path.stat().st_size
    before = s3.faults(0.0)[0]
    subprocess.run([sys.executable, "-m", "stereo_sfm.cli", "info", str(remote)], check=True, stdout=subprocess.DEVNULL)
    read = s3.faults(0.0)[0] - before
    other = read - min(decoded, read)
    verdicts.row(
        f"`info` of {size / 1e6:.0f} MB in a bucket reads < 5 MB besides the start check's chunks", other < 5e6,
        f"{read / 1e6:.2f} MB in all, index {index / 1e6:.2f} MB",
    )  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--stores", type=int, default=20)
    parser.add_argument("--nights", type=int, default=3)
    parser.add_argument("--kills", type=int, default=10, help="workers killed")
    parser.add_argument("--pause", type=float, default=5.0, help="mean seconds between two kills")
    parser.add_argument("--points", type=int, default=100, help="of a keyframe")
    parser.add_argument("--keyframes", type=int, default=12, help="of a session, a tiny store's; 34: a whole aisle")
    parser.add_argument("--megabytes", type=int, default=300, help="of the recording for info; 0: none")
    parser.add_argument("--write", action="store_true", help="replace the benchmark's figures")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    verdicts = Verdicts()
    with server() as s3, tempfile.TemporaryDirectory() as place:
        os.environ |= {**s3.environment(), "STEREO_SFM_CACHE": str(Path(place) / "cache")}
        os.environ["PYTHONPATH"] = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
        print("| what must hold | figure | |\n|---|---|---|")
        two_writers(verdicts, Path(place))
        if options.megabytes:
            one_file(verdicts, s3, options.megabytes)
        night(verdicts, options, s3, Path(place))
    if options.write:
        print(_figures.write("fleet", "Nights of a fleet with faults", verdicts.figures), file=sys.stderr)
    sys.exit(1 if verdicts.failed else 0)


if __name__ == "__main__":
    main()
