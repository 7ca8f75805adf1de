"""What a fleet costs beside its work: bytes that `info` and a robot fetch, and the time of `fleet run` itself."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from unittest.mock import patch

import psutil
from _fleet_faults import PLAN, started_cluster
from _verdicts import Verdicts

from stereo_sfm.config import Config
from stereo_sfm.demo import demo_recording
from stereo_sfm.drivers.memory import MemorySource
from stereo_sfm.drivers.source import open_source
from stereo_sfm.export.store_plan import write_store_plan
from stereo_sfm.fleet.copies import fetch_version
from stereo_sfm.fleet.editing import checked_out
from stereo_sfm.fleet.versions import current
from stereo_sfm.log.reader import LogReader
from stereo_sfm.maps.put_session import put_session
from stereo_sfm.maps.saved_map import SavedMap
from stereo_sfm.recording.describe import describe_file
from stereo_sfm.recording.record import record
from stereo_sfm.storage import objects
from stereo_sfm.storage.remote import Remote
from tests.fleet.s3_server import BUCKET, Server
from tests.loop.store_sequence import make_sequence
from tests.maps.maps import map_of_sequence

MOST_INFO, MOST_DELTA, MOST_OVERHEAD = 5e6, 2e6, 0.1  # bytes, bytes a night, share
AISLES, POINTS = 10, 100  # of 10 m; of a keyframe
WALKS, PAIRS = 4, 2  # of one comparison


def info(verdicts: Verdicts, folder: Path, megabytes: int) -> None:
    """`info` of a long recording: the demo's images over and over. Its server reads from the disk."""
    path = folder / "long.mcap"
    with open_source(demo_recording()) as source:
        rig, images = source.rig, list(source)
    pair = sum(side.nbytes for side in (images[0].left, images[0].right) if side is not None)
    for _ in record(MemorySource(rig, images, count=int(megabytes * 1e6 / pair)), path, "raw"):
        pass
    size, asked, decoded = path.stat().st_size, list[tuple[int, int]](), dict[int, int]()
    one, many, chunk = objects.read_range, objects.read_ranges, LogReader._chunk  # pyright: ignore[reportPrivateUsage]

    def read_range(remote: Remote, start: int, length: int) -> bytes:
        asked.append((start, length))
        return one(remote, start, length)

    def read_ranges(remote: Remote, ranges: list[tuple[int, int]]) -> list[bytes]:
        asked.extend(ranges)
        return many(remote, ranges)

    def read_chunk(reader: LogReader, index: Any) -> Any:
        decoded[index.chunk_start_offset] = index.chunk_length
        return chunk(reader, index)

    with _served(path) as url, patch.dict(os.environ, AWS_ENDPOINT_URL=url), patch.multiple(
        objects, read_range=read_range, read_ranges=read_ranges
    ), patch.object(LogReader, "_chunk", read_chunk):  # fmt: skip
        begin = time.perf_counter()
        found = describe_file(Remote("s3", "long", "long.mcap"))
        took = time.perf_counter() - begin
    path.unlink()
    read = sum(length for _, length in asked)
    needed = sum(_covered(asked, start, length) for start, length in decoded.items())
    print(f"# {found.messages} messages, {len(asked)} requests, {took:.0f} s", file=sys.stderr)
    verdicts.row(
        f"`info` of {size / 1e9:.1f} GB reads < {MOST_INFO / 1e6:.0f} MB besides the start check",
        bool(decoded) and read - needed < MOST_INFO and found.bytes == size,
        f"{(read - needed) / 1e6:.2f} MB, and {len(decoded)} chunks of {needed / 1e6:.2f} MB",
    )  # fmt: skip


def _covered(asked: list[tuple[int, int]], start: int, length: int) -> int:
    """Bytes of a part that were asked for, each counted once."""
    end, count = start, 0
    for low, high in sorted((max(a, start), min(a + n, start + length)) for a, n in asked):
        count += max(high - max(low, end), 0)
        end = max(end, high)
    return count


@contextmanager
def _served(path: Path) -> Generator[str]:
    """The address of a server whose only object, whatever it is called, is a file."""
    size = path.stat().st_size

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_GET(self) -> None:
            wanted = self.headers.get("Range", "").removeprefix("bytes=").partition("-")
            first, last = int(wanted[0] or 0), min(int(wanted[2] or size - 1), size - 1)
            self.send_response(206 if wanted[1] else 200)
            self.send_header("Content-Range", f"bytes {first}-{last}/{size}")
            self.send_header("Content-Length", str(last - first + 1))
            self.send_header("ETag", '"1"')
            self.send_header("Last-Modified", self.date_time_string())
            self.end_headers()
            if self.command == "GET":
                with path.open("rb") as stream:
                    stream.seek(first)
                    self.wfile.write(stream.read(last - first + 1))

        do_HEAD = do_GET

        def log_message(self, format: str, *args: Any) -> None:
            return

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as found:
        thread = threading.Thread(target=found.serve_forever, daemon=True)
        thread.start()
        try:
            yield f"http://127.0.0.1:{found.server_port}"
        finally:
            found.shutdown()


def delta(verdicts: Verdicts, folder: Path) -> None:
    """A store of ten aisles, of which one is visited in a night: what another robot fetches."""
    store = Remote("s3", BUCKET, "delta/map")

    def put(name: str, session: SavedMap) -> None:
        with checked_out(store, begin=True) as out:
            put_session(out.folder, session, name, Config(), compress=False)
            write_store_plan(out.folder)
            out.publish({name: name}, [])
        fetched.append((fetch_version(store, current(store), folder / "robot").received, len(session)))

    fetched: list[tuple[int, int]] = []
    put("whole", _session(range(AISLES), 0.3))
    for night in range(1, 3):
        put(f"night{night}", _session([3 * night], 0.3 + 0.01 * night))
    (whole, size), *nights = fetched
    most, keyframes = max(nights)
    verdicts.row(
        f"a night in one aisle of {AISLES}: < {MOST_DELTA / 1e6:.0f} MB to fetch", most < MOST_DELTA,
        f"{most / 1e6:.2f} MB of {keyframes} keyframes; the store {whole / 1e6:.2f} MB of {size}",
    )  # fmt: skip


def _session(aisles: Any, noise_px: float) -> SavedMap:
    return map_of_sequence(make_sequence(list(aisles), seed=5, noise_px=noise_px, max_points=POINTS))


class Meter:
    """Processor time of the processes that this one has started, but for some; sampled, as many end on the way."""

    def __init__(self, *without: int) -> None:
        self._without, self._ours, self._over = without, psutil.Process(), threading.Event()
        self._before, self._spent = dict[Any, float](), dict[Any, float]()
        self._sample(self._before)
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def _work(self) -> None:
        while not self._over.wait(0.2):
            self._sample(self._spent)

    def _sample(self, into: dict[Any, float]) -> None:
        for process in self._ours.children(recursive=True):
            try:
                times = process.cpu_times()
                if process.pid not in self._without:
                    into[process.pid, process.create_time()] = times.user + times.system
            except psutil.Error:
                continue

    def close(self) -> float:
        """Seconds since it began."""
        self._over.set()
        self._thread.join()
        self._sample(self._spent)
        return sum(spent - self._before.get(key, 0.0) for key, spent in self._spent.items())


def overhead(verdicts: Verdicts, s3: Server, folder: Path) -> None:
    """A night of recordings on a running cluster of one core, and by `map update` and `map plan`, in turns."""
    cluster = started_cluster(1)
    spent: list[tuple[float, float, float, float]] = []
    try:
        for pair in range(PAIRS):
            roots = [Remote("s3", BUCKET, f"{way}{pair}") for way in ("plain", "fleet")]
            walks = [[root / f"{k}" / "walks" / "r1" / "2026-11-20_2200.mcap" for k in range(WALKS)] for root in roots]
            for walk in [*walks[0], *walks[1]]:
                objects.write(walk, demo_recording())

            def by_commands(walks: list[Remote] = walks[0]) -> None:
                for walk in walks:
                    store = str(walk.parent.parent.parent / "map")
                    _command("map", "update", store, str(walk))
                    _command("map", "plan", store)

            def by_fleet(root: Remote = roots[1]) -> None:
                (folder / "plan.toml").write_text(PLAN.format(root=root))
                _command("fleet", "run", str(folder / "plan.toml"), "--address", cluster.address)

            spent.append((*_spent(by_commands, s3), *_spent(by_fleet, s3)))
            print("# processor and clock, commands and fleet:", *(f"{s:.1f} s" for s in spent[-1]), file=sys.stderr)
    finally:
        cluster.shutdown()
    plain, plain_clock, fleet, fleet_clock = (sum(column) for column in zip(*spent, strict=True))
    verdicts.row(
        f"overhead over `map update` and `map plan` <= {100 * MOST_OVERHEAD:.0f} %",
        fleet <= (1 + MOST_OVERHEAD) * plain,
        f"{100 * (fleet / plain - 1):+.0f} %: {fleet:.0f} and {plain:.0f} s of processor,"
        f" by the clock {fleet_clock:.0f} and {plain_clock:.0f} s",
    )  # fmt: skip


def _spent(work: Callable[[], None], s3: Server) -> tuple[float, float]:
    """Seconds of processor time and of the clock."""
    meter, begin = Meter(s3.process.pid), time.perf_counter()
    work()
    return meter.close(), time.perf_counter() - begin


def _command(*arguments: str) -> None:
    with tempfile.TemporaryFile() as output:
        subprocess.run([sys.executable, "-m", "stereo_sfm.cli", *arguments], check=True, stdout=output, stderr=output)
