"""Attacks or busy loops beside a soak, in turn: whether poses are later with attacks than without."""

from __future__ import annotations

import itertools
import math
import multiprocessing
import os
import subprocess
import sys
import threading
import time
from collections import Counter
from contextlib import suppress
from pathlib import Path

import numpy as np

from benchmarks.attack import (
    Target,
    clients_that_never_read,
    foreign_page,
    guesses,
    hostile_requests,
    idle_connections,
    silent_connections,
    without_a_token,
)

TURN_S = 40.0  # the longest attack takes 30 s
SURE_S = 10.0  # after which a change no longer counts: processes start, and what waited is caught up with
LATE_S = 0.1  # from image to pose: three images
BUSY, BUSY_LOOP = 8, (sys.executable, "-c", "while True: pass")
DONE = "attacks.txt"
REQUESTS = 200  # hostile ones before the next kind of attack
CHANCE = 1.35e-3  # of a difference between turns that nothing causes: three sigmas, on one side
ALONE, ATTACKS, LOOPS = "alone", "attacks", f"{BUSY} busy loops"
TURNS = (ALONE, ATTACKS, LOOPS, ATTACKS, ALONE, LOOPS)  # what comes after the loops finds the images that these delayed
KINDS = (
    hostile_requests, guesses, idle_connections, silent_connections, without_a_token, clients_that_never_read,
    foreign_page,
)  # fmt: skip


def attack(target: Target, first: int) -> None:
    """Body of the process that attacks: it gets what others leave of the processor, as if it were another computer.

    What it has done is a line each in `DONE`.

    Args:
        first: the kind of attack that it begins with.
    """
    os.nice(19)
    with (target.folder / DONE).open("a", buffering=1) as done:
        for one in itertools.islice(itertools.cycle(KINDS), first, None):
            with suppress(Exception):
                closed = one(target)[1]
                done.write(f"{one.__name__} {closed:d}\n")


class Turns:
    """Which turn it is, and how late the poses of each were."""

    def __init__(self, folder: Path, page: int, foxglove: int, poses: int) -> None:
        self._target = Target(folder, page, foxglove, poses, REQUESTS, None)  # type: ignore[arg-type]
        (folder / DONE).unlink(missing_ok=True)
        self.delays: list[tuple[str, list[float]]] = []  # of each turn, in s
        self._counts_from_s = math.inf
        self._over, self._rest = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._work, daemon=True)

    def start(self) -> None:
        """Begin with the first turn."""
        self._thread.start()

    def end(self) -> None:
        """End what runs beside the soak."""
        self._over.set()
        if self._thread.is_alive():
            self._thread.join()

    def rest(self) -> None:
        """What remains has attacks and no busy loops: it is to come to an end."""
        self._rest.set()

    def pose(self, captured_s: float, now: float) -> bool:
        """A pose has arrived; whether it is one of those that must come at the camera's rate."""
        if now < self._counts_from_s:
            return False
        turn, delays = self.delays[-1]
        delays.append(now - captured_s)
        return turn != LOOPS

    def _work(self) -> None:
        spawn = multiprocessing.get_context("spawn")
        for k, turn in enumerate(itertools.cycle(TURNS)):
            if turn == LOOPS and self._rest.is_set():
                continue
            loops = [subprocess.Popen(BUSY_LOOP) for _ in range(BUSY)] if turn == LOOPS else []
            attackers = [spawn.Process(target=attack, args=(self._target, k), daemon=True)] if turn == ATTACKS else []
            for attacker in attackers:
                attacker.start()
            self.delays.append((turn, []))
            self._counts_from_s = time.monotonic() + SURE_S
            over = self._over.wait(TURN_S)
            self._counts_from_s = math.inf
            for process in (*loops, *attackers):
                process.kill()
            if over:
                return

    def _judge_attacks(self) -> list[str]:
        """Print what was done to the service; that it was not attacked."""
        file = self._target.folder / DONE
        done = [line.split() for line in file.read_text().splitlines()] if file.exists() else []
        kinds = Counter(name for name, _ in done)
        print(f"  attacks: {', '.join(f'{count} {name}' for name, count in sorted(kinds.items())) or 'none'}")
        print(f"  {sum(closed == '0' for _, closed in done)} with another outcome than on a quiet computer")
        missed = not done and any(turn == ATTACKS and delays for turn, delays in self.delays)
        return ["no attack was carried out"] if missed else []

    def judge(self) -> list[str]:
        """Print what was measured; that more poses were late with attacks, by the spread of the turns."""
        wrong, shares = self._judge_attacks(), dict[str, list[float]]()
        for kind in (ALONE, ATTACKS, LOOPS):
            turns = [np.array(delays) for turn, delays in self.delays if turn == kind and delays]
            if not turns:
                continue
            ms = 1e3 * np.concatenate(turns)
            shares[kind] = [float(np.mean(delays > LATE_S)) for delays in turns]
            of_each = ", ".join(f"{100 * share:.1f}" for share in shares[kind])
            print(f"  {kind}: {len(ms)} poses in {len(turns)} turns, median {np.median(ms):.0f} ms, "
                  f"95 % {np.percentile(ms, 95):.0f} ms, 99 % {np.percentile(ms, 99):.0f} ms, "
                  f"late {100 * np.mean(ms > 1e3 * LATE_S):.2f} % ({of_each})")  # fmt: skip
        alone, attacked = shares.get(ALONE, []), shares.get(ATTACKS, [])
        if min(len(alone), len(attacked)) < 2:
            wrong.append(f"too few turns with poses: {len(alone)} alone, {len(attacked)} with attacks")
        else:
            from scipy import stats  # which takes a second, in each process of the service

            tested = stats.ttest_ind(attacked, alone, alternative="greater")
            chance = float(np.nan_to_num(np.asarray(tested)[1], nan=1.0))  # of turns that are all the same
            print(f"  chance of as many late poses with attacks: {chance:.3g}")
            if chance < CHANCE:
                wrong.append(f"{100 * np.mean(attacked):.2f} % late with attacks, {100 * np.mean(alone):.2f} without")
        return wrong
