"""Attacks and busy loops beside a soak, in turn: whether poses are later with attacks than without."""

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

TURN_S = 60.0
SURE_S = 5.0  # of each turn, and of each session, that do not count: processes start
LATE_S = 0.1  # from image to pose: three images
BUSY = 8
DONE = "attacks.txt"
REQUESTS = 200  # hostile ones before the next kind of attack
SIGMAS = 3.0  # by which the share of late poses may differ by chance
TURNS = tuple((busy, attacked) for busy in (False, True) for attacked in (False, True))
ATTACKS = (
    hostile_requests, guesses, idle_connections, silent_connections, without_a_token, clients_that_never_read,
    foreign_page,
)  # fmt: skip


def attack(target: Target, busy: bool) -> None:
    """Body of the process that attacks: it gets what others leave of the processor, as if it were another computer.

    What it has done is a line each in `DONE`.
    """
    os.nice(19)
    with (target.folder / DONE).open("a", buffering=1) as done:
        for one in itertools.cycle(ATTACKS):
            with suppress(Exception):
                closed = one(target)[1]
                done.write(f"{one.__name__} {busy:d} {closed:d}\n")


class Turns:
    """Which turn it is, and how late the poses of each were."""

    def __init__(self, folder: Path, page: int, foxglove: int, poses: int) -> None:
        self._target = Target(folder, page, foxglove, poses, REQUESTS, None)  # type: ignore[arg-type]
        (folder / DONE).unlink(missing_ok=True)
        self.delays: dict[tuple[bool, bool], list[float]] = {turn: [] for turn in TURNS}
        self._turn: tuple[bool, bool] | None = None
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
        """What remains has attacks every other minute and no busy loops: it is to come to an end."""
        self._rest.set()

    def session(self) -> None:
        """A session begins."""
        self._counts_from_s = max(self._counts_from_s, time.monotonic() + SURE_S)

    def pose(self, captured_s: float) -> None:
        """A pose has arrived."""
        now, turn = time.monotonic(), self._turn
        if turn is not None and now >= self._counts_from_s:
            self.delays[turn].append(now - captured_s)

    def _work(self) -> None:
        spawn = multiprocessing.get_context("spawn")
        for busy, attacked in itertools.cycle(TURNS):
            if busy and self._rest.is_set():
                continue
            loops = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(BUSY * busy)]
            attacker = spawn.Process(target=attack, args=(self._target, busy), daemon=True) if attacked else None
            if attacker is not None:
                attacker.start()
            self._turn, self._counts_from_s = (busy, attacked), time.monotonic() + SURE_S
            over = self._over.wait(TURN_S)
            self._turn = None
            for process in (*loops, *([attacker] if attacker is not None else [])):
                process.kill()
            if over:
                return

    def _judge_attacks(self) -> list[str]:
        """Print what was done to the service; that it was not attacked."""
        file = self._target.folder / DONE
        done = [line.split() for line in file.read_text().splitlines()] if file.exists() else []
        for busy in (False, True):
            kinds = Counter(name for name, beside, _ in done if beside == f"{busy:d}")
            said = ", ".join(f"{count} {name}" for name, count in sorted(kinds.items()))
            print(f"  {BUSY * busy} busy loops, attacks: {said or 'none'}")
        still_open = sum(closed == "0" for *_, closed in done)
        print(f"  {len(done)} attacks, {still_open} with another outcome than on a quiet computer")
        return [] if done or not self.delays[False, True] else ["no attack was carried out"]

    def judge(self) -> list[str]:
        """Print what was measured; where more poses were late with attacks."""
        wrong = self._judge_attacks()
        for (busy, attacked), delays in self.delays.items():
            ms = 1e3 * np.array(delays or [math.nan])
            late = sum(d > LATE_S for d in delays)
            print(f"  {BUSY * busy} busy loops, {'attacks' if attacked else 'none   '}: {len(delays)} poses, median "
                  f"{np.median(ms):.0f} ms, 95 % {np.percentile(ms, 95):.0f} ms, 99 % {np.percentile(ms, 99):.0f} ms, "
                  f"late {late} ({100 * late / max(len(delays), 1):.2f} %)")  # fmt: skip
        for busy in (False, True):
            (n, k), (m, j) = (
                (len(d), sum(x > LATE_S for x in d)) for d in (self.delays[busy, False], self.delays[busy, True])
            )
            if not n or not m:
                continue
            share = (k + j) / (n + m)
            sigma = math.sqrt(max(share * (1 - share), 1 / (n + m)) * (1 / n + 1 / m))
            if j / m - k / n > SIGMAS * sigma:
                wrong.append(
                    f"{BUSY * busy} busy loops: {100 * j / m:.2f} % late with attacks, {100 * k / n:.2f} without"
                )
        return wrong
