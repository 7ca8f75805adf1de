"""What `stereo-sfm info` finds in each recording of the list, computed one after another in the background."""

from __future__ import annotations

import json
import queue
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.service.outputs.background import run_command

LONGEST_S = 300.0
GOOD = "no problems found"  # as `info` prints it


def problems(folder: Path) -> list[str]:
    """The problems that `stereo-sfm info` prints for a recording."""
    try:
        return json.loads(run_command(["info", "--json", str(folder)], LONGEST_S))["problems"]
    except StereoSfmError as error:
        return [str(error)]


class Verdicts:
    """Verdicts by recording, kept until a recording changes its size."""

    def __init__(
        self, folder_of: Callable[[str], Path | None], find_problems: Callable[[Path], list[str]] = problems
    ) -> None:
        """Args: folder_of, the folder of a recording by its id, None if it no longer exists. find_problems: of one."""
        self._folder_of, self._find_problems = folder_of, find_problems
        self._verdicts: dict[str, tuple[int, str]] = {}  # id -> bytes, verdict
        self._queue: queue.SimpleQueue[tuple[str, int]] = queue.SimpleQueue()
        self._pending: set[str] = set()
        self._thread: threading.Thread | None = None

    def add(self, rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
        """The rows of a list of recordings with the `verdict` of each; those not known yet are computed."""
        ids = {row["id"] for row in rows}
        self._verdicts = {id: verdict for id, verdict in self._verdicts.items() if id in ids}
        return [{**row, "verdict": self._verdict(row)} for row in rows]

    def _verdict(self, row: dict[str, Any]) -> str:
        if row.get("recording"):
            return "being recorded"
        if row.get("segments") and not row.get("with_images"):
            return "poses only"
        size, verdict = self._verdicts.get(row["id"], (-1, ""))
        if size == row["bytes"]:
            return verdict
        if row["id"] not in self._pending:
            self._pending.add(row["id"])
            self._queue.put((row["id"], row["bytes"]))
            self._start()
        return "being checked"

    def _start(self) -> None:
        if self._thread is None:
            self._thread = threading.Thread(target=self._work, name="verdicts", daemon=True)
            self._thread.start()

    def _work(self) -> None:
        while True:
            id, size = self._queue.get()
            folder = self._folder_of(id)
            if folder is not None:
                self._verdicts[id] = size, "; ".join(self._find_problems(folder)) or GOOD
            self._pending.discard(id)
