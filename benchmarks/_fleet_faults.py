"""The nights of `benchmarks fleet`: everything goes wrong that can, then each sentence is checked."""

from __future__ import annotations

import dataclasses
import itertools
import random
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import psutil
from _verdicts import Verdicts

from stereo_sfm.config import Config
from stereo_sfm.fleet.catalogue import ask, delta_bytes, opened
from stereo_sfm.fleet.copies import fetch_version
from stereo_sfm.fleet.editing import checked_out, session_id
from stereo_sfm.fleet.plan import load_plan
from stereo_sfm.fleet.versions import Version, current, history, publish, read_head, roll_back
from stereo_sfm.maps.put_session import put_session
from stereo_sfm.maps.saved_map import load_map, save_map
from stereo_sfm.storage import objects
from stereo_sfm.storage.folders import send_folder
from stereo_sfm.storage.objects import Changed
from stereo_sfm.storage.remote import Remote
from tests.fleet.nights import carry_out
from tests.fleet.s3_server import BUCKET, Server
from tests.loop.store_sequence import make_sequence
from tests.maps.maps import map_of_sequence, same

NODES, STARTS = 3, 10
FAILING, HELD_S = 0.1, 20.0
PLAN = '[fleet]\nroot = "{root}"\n[job]\nmemory_gb = 0.0\nminutes = 30.0\nretries = 20\n'
POINTS, KEYFRAMES = 60, 12  # of a keyframe, of a session: a tiny store's map
TURNS = 10  # of two writers


class Driver:
    """`stereo-sfm fleet run` in a process that can be killed, and what it printed."""

    def __init__(self, plan: Path, address: str) -> None:
        command = [sys.executable, "-m", "stereo_sfm.cli", "fleet", "run", str(plan), "--address", address]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        self._lines: list[str] = []

    def until(self, jobs: int) -> None:
        """Wait until so many jobs are done, or it has ended."""
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self._lines.append(line.strip())
            jobs -= line[:1].isdigit()
            if not jobs:
                return

    def wait(self) -> tuple[int, str]:
        """Its exit code and the last line."""
        self._lines += self.process.communicate()[0].strip().splitlines()
        return self.process.returncode, self._lines[-1] if self._lines else ""


class Killer:
    """Kills workers of this cluster at random moments, while they carry out a job."""

    def __init__(self, count: int, pause_s: float, seed: int) -> None:
        self._left, self._pause_s, self._random = count, pause_s, random.Random(seed)
        self.killed, self._over, self._ours = 0, threading.Event(), psutil.Process()
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def _work(self) -> None:
        while self._left and not self._over.wait(self._random.uniform(0, 2 * self._pause_s)):
            while not (workers := [p for p in self._ours.children(recursive=True) if _busy(p)]):
                if self._over.wait(0.1):
                    return
            try:
                self._random.choice(workers).kill()
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


def make_sessions(folder: Path, nights: int) -> list[Path]:
    """The maps that a robot makes in the same aisle, one a night."""
    out: list[Path] = []
    for night in range(nights):
        sequence = make_sequence([0], seed=5, noise_px=0.2 + 0.01 * night, max_points=POINTS)
        out.append(folder / f"session{night}")
        save_map(map_of_sequence(sequence.first(KEYFRAMES - night)), out[-1], compress=False)
    return out


def started_cluster(nodes: int) -> Any:
    """Several nodes on this computer. A busy one needs some tries, since Ray waits 15 s for each node."""
    from ray.cluster_utils import Cluster

    for attempt in range(STARTS):
        cluster: Any = Cluster()
        try:
            for node in range(nodes):
                cluster.add_node(num_cpus=1, **({} if node else {"include_dashboard": False}))
            return cluster
        except Exception:  # Ray raises nothing narrower
            cluster.shutdown()
            if attempt == STARTS - 1:
                raise
    raise AssertionError  # the count does not end


def night_of(k: int) -> str:
    return f"2026-11-{20 + k:02d}"


class Chain:
    """Stores 000, 001, ... whose robots send a map a night: the first one's is offline until the last night and sends
    all then, the second one's sends all twice, an upload of the third one is cut off in the last night."""

    def __init__(self, stores: int, sessions: list[Path]) -> None:
        self.root, self.names, self.sessions = (
            Remote("s3", BUCKET, "chain"),
            [f"{k:03d}" for k in range(stores)],
            sessions,
        )
        self._cut = self.root / self.names[2] / "walks" / "r1" / f"{night_of(len(sessions) - 1)}_2200" / "points.npz"
        self._whole = b""

    def send(self, night: int) -> None:
        last = night == len(self.sessions) - 1
        for store in self.names:
            walks = self.root / store / "walks" / "r1"
            offline = store == self.names[0]
            for k in range(night + 1) if offline and last else [] if offline else [night]:
                send_folder(self.sessions[k], walks / f"{night_of(k)}_2200")
            if store == self.names[1]:
                send_folder(self.sessions[night], walks / f"{night_of(night)}_2200")
                send_folder(self.sessions[night], walks / f"{night_of(night)}_2200_again")
        if last:
            self._whole = objects.read(self._cut)
            objects.write(self._cut, self._whole[: len(self._whole) // 2])

    def send_again(self) -> None:
        objects.write(self._cut, self._whole)


def nights(
    verdicts: Verdicts, s3: Server, folder: Path, stores: int, count: int, kills: int, pause_s: float, seed: int
) -> None:
    """All nights of all stores under faults, then the sentences."""
    *sessions, later = make_sessions(folder, count + 1)
    for session in sessions:
        put_session(folder / "hand", load_map(session), session.name, Config(), compress=False)
    chain, plan, chance = Chain(stores, sessions), folder / "plan.toml", random.Random(seed)
    plan.write_text(PLAN.format(root=chain.root))
    cluster = started_cluster(NODES)
    killer, begin, drivers, cut = Killer(kills, pause_s, seed), time.perf_counter(), 0, (0, "")
    s3.faults(FAILING)

    def ended(driver: Driver, what: str) -> tuple[int, str]:
        code, text = driver.wait()
        print(f"# {time.perf_counter() - begin:.0f} s, {what}: exit {code}, {text}", file=sys.stderr, flush=True)
        return code, text

    try:
        for night in range(count):
            chain.send(night)
            driver = Driver(plan, cluster.address)
            driver.until(chance.randint(1, stores))
            driver.process.kill()
            ended(driver, f"night {night}, killed driver")
            driver = Driver(plan, cluster.address)
            if not night:
                driver.until(1)
                s3.hold()
                time.sleep(HELD_S)
                s3.go_on()
            cut = ended(driver, f"night {night}")
            drivers += 2
        chain.send_again()
        code, _ = ended(Driver(plan, cluster.address), "after the second upload")
        fault_s = time.perf_counter() - begin
        killer.close()
        s3.faults(0.0)
        again = ended(Driver(plan, cluster.address), "once more")
    finally:
        killer.close()
        cluster.shutdown()
    verdicts.row(
        f"{stores} stores x {count} nights: {killer.killed} workers and {count} drivers killed, storage held for"
        f" {HELD_S:.0f} s, {100 * FAILING:.0f} % failing answers", code == 0 and killer.killed == kills,
        f"{fault_s:.0f} s, {drivers + 1} drivers",
    )  # fmt: skip
    verdicts.row("a cut-off upload stops no other walk", cut[0] == 3 and cut[1].endswith(", 2 failed"), _jobs(cut[1]))
    verdicts.row("one more run does nothing", again[0] == 0 and " 0 of " in again[1], _jobs(again[1]))
    check(verdicts, chain, folder)
    roll_back_and_go_on(verdicts, chain, folder, later)


def _jobs(text: str) -> str:
    """How many were done, of what `fleet run` printed."""
    return text.rpartition(": ")[2]


def check(verdicts: Verdicts, chain: Chain, folder: Path) -> None:
    """What is in the bucket, against the sessions put together by hand in a folder."""
    count, names = len(chain.sessions), chain.names
    stores = {name: current(chain.root / name / "map") for name in names}
    wanted = {session_id(load_map(session)) for session in chain.sessions}
    complete = sum(set(version.sessions) == wanted for version in stores.values())
    verdicts.row("nothing lost, nothing double", complete == len(names), f"{complete} of {len(names)} stores")
    hand = load_map(folder / "hand")
    equal = sum(_as_by_hand(chain, name, version, folder, hand) for name, version in stores.items())
    verdicts.row("same bits as `map update` by hand", equal == len(names), f"{equal} of {len(names)} stores")
    with opened(chain.root, names) as connection:
        rows = ask(connection, "SELECT count(*), count(DISTINCT (store, session)) FROM walks WHERE ok")[1]
    walks, different = (int(number) for number in rows.split(","))
    verdicts.row(
        "a catalogue row for each walk", (walks, different) == (count * (len(names) + 1), count * len(names)),
        f"{walks}, {walks - different} sent twice",
    )  # fmt: skip
    versions = history(chain.root / names[-1] / "map")
    most = max(delta_bytes(new, old) for new, old in itertools.pairwise(versions))
    whole = sum(f.stored for f in versions[0].files.values())
    print(f"# a night's difference of a tiny store: {most / 1e6:.3f} of {whole / 1e6:.3f} MB", file=sys.stderr)


def roll_back_and_go_on(verdicts: Verdicts, chain: Chain, folder: Path, later: Path) -> None:
    """The last store's last version is rolled back, then comes one more night with the session `later`."""
    name, count = chain.names[-1], len(chain.sessions)
    place, versions = chain.root / name / "map", history(chain.root / name / "map")
    rolled = roll_back(place)
    verdicts.row("a version rolled back", rolled.name == versions[1].name, f"version {rolled.number} again")
    send_folder(later, chain.root / name / "walks" / "r1" / f"{night_of(count)}_2200")
    plan = load_plan(folder / "plan.toml")
    carry_out(dataclasses.replace(plan, fleet=dataclasses.replace(plan.fleet, stores=name)))
    for session in (*chain.sessions[:-1], later):
        put_session(folder / "hand_later", load_map(session), session.name, Config(), compress=False)
    version, hand = current(place), load_map(folder / "hand_later")
    equal = version.parent == rolled.name and _as_by_hand(chain, name, version, folder, hand)
    with opened(chain.root, [name]) as connection:
        (rows,) = ask(connection, "SELECT string_agg(coalesce(version, 0), ' ' ORDER BY night) FROM walks")[1:]
    wanted = " ".join(str(v.number) for v in versions[:0:-1]) + f" 0 {version.number}"
    verdicts.row("what was rolled back stays out the next night", equal and rows == wanted, f"versions {rows}")


def _as_by_hand(chain: Chain, store: str, version: Version, folder: Path, hand: Any) -> bool:
    fetch_version(chain.root / store / "map", version, folder / "robots" / store)
    return same(load_map(folder / "robots" / store).snapshot, hand.snapshot)


def two_writers(verdicts: Verdicts, folder: Path) -> None:
    """Both write the same store at the same time, again and again."""
    store = Remote("s3", BUCKET, "writers")
    (folder / "x").mkdir()
    (folder / "x" / "map.json").write_text("0")
    publish(store, folder / "x", read_head(store), {"begin": ""}, [], "benchmark")
    outcomes: list[bool] = []

    def write(k: int, barrier: threading.Barrier) -> None:
        try:
            with checked_out(store) as out:
                (out.folder / "map.json").write_text(f"{k}")
                barrier.wait()
                out.publish({f"{k}": ""}, [])
            outcomes.append(True)
        except Changed:
            outcomes.append(False)

    for turn in range(TURNS):
        barrier = threading.Barrier(2)
        threads = [threading.Thread(target=write, args=(2 * turn + k, barrier)) for k in range(2)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    wrote, held = outcomes.count(True), len(current(store).sessions) - 1
    verdicts.row("of two writers one is refused", wrote == TURNS == held, f"{wrote} of {2 * TURNS} wrote")
