"""Processor time of the saves of a session that continues a saved map, asked for by four clients at once.

    python benchmarks/_saves.py

Counted are the thread that joins the session and writes the saved map, and the threads of the mapper beside its own
work, one of which writes the session's part. Requests that arrive during a save share the next one. The exit code is 1
if a save takes more than a second of processor time, or requests do not share saves.
"""

from __future__ import annotations

import logging
import os
import sys
import tempfile
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from stereo_sfm.service.messages import Event
    from stereo_sfm.service.service import Service
# As in kills.py: what this file imports, every process that it starts imports again.

CLIENTS, REQUESTS = 4, 16
MOST_SAVES = 12  # one for the first client that asks again, one for all others: eight, or a few more by chance
MOST_S = 1.0  # of processor time for a save
BEFORE_S = 20.0  # of the session before the first request
GIVE_UP_S = 300.0


def used_s(place: Path) -> float:
    """Processor seconds of a process, or of one of its threads, from its folder in /proc."""
    fields = (place / "stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def saving_s(service: Service) -> float:
    """Processor seconds so far of what saves."""
    saver, mapper = (Path(f"/proc/{service.pids[name]}") for name in ("map saver", "mapper"))
    own = Path("task")
    return used_s(saver / own / saver.name) + used_s(mapper) - used_s(mapper / own / mapper.name)


def wait_for_the_saver(service: Service) -> None:
    """It is started when the session has images."""
    until = time.monotonic() + GIVE_UP_S
    while not {"map saver", "mapper"} <= service.pids.keys():
        if time.monotonic() > until:
            raise SystemExit("the service continues no map")
        time.sleep(0.1)


def main() -> int:
    sys.path.insert(0, str(Path(__file__).parents[1]))
    from benchmarks.attack import DEMO, first_map
    from stereo_sfm.service.config import MapConfig, RecordingConfig, RobotConfig, SourceConfig
    from stereo_sfm.service.messages import Event
    from stereo_sfm.service.service import Service

    logging.getLogger("stereo_sfm").setLevel(logging.INFO)  # which tells every save
    written, came = list[str](), threading.Lock()

    def take(event: Event) -> None:
        with came:
            written.extend([event.text] if "is saved: " in event.text else [])

    with tempfile.TemporaryDirectory(prefix="saves") as place:
        store = Path(place) / "store"
        first_map(store)
        config = RobotConfig(
            SourceConfig(str(DEMO), repeat=True), map=MapConfig(str(store), save_every_min=60.0),
            recording=RecordingConfig(f"{place}/recordings", "off"),
        )  # fmt: skip
        with Service(config) as service:
            service.on(Event, take)
            wait_for_the_saver(service)
            time.sleep(BEFORE_S)
            idle_s, begin = saving_s(service), time.monotonic()
            time.sleep(BEFORE_S / 2)
            idle_s = (saving_s(service) - idle_s) / (time.monotonic() - begin)
            before_s, begin = saving_s(service), time.monotonic()
            with ThreadPoolExecutor(CLIENTS) as pool:
                replies = list(pool.map(lambda _: service.save_map(), range(REQUESTS)))
            seconds = saving_s(service) - before_s - idle_s * (time.monotonic() - begin)
            time.sleep(1.0)  # until the last event is here
            count = len(written)
    refused = sorted({reply.text for reply in replies if not reply.ok})
    each_s = seconds / max(count, 1)
    keyframes = written[-1].rpartition(": ")[2] if written else "nothing"
    print(f"{REQUESTS} requests of {CLIENTS} clients in {count} saves of {keyframes}, {each_s:.2f} s of processor time "
          f"each, allowed is {MOST_S:g}")  # fmt: skip
    for text in refused:
        print(text)
    return int(bool(refused) or not 0 < count <= MOST_SAVES or each_s > MOST_S)


if __name__ == "__main__":
    sys.exit(main())
