"""What Fast DDS leaves in shared memory when its process ends without the interpreter's exit, or is killed."""

from __future__ import annotations

import contextlib
import fcntl
import re
from pathlib import Path

SHARED = Path("/dev/shm")
_LOCK = re.compile(r"((?:fastrtps|fastdds)_\w+)_el")  # of a segment or a port: locked by each process that uses it


def sweep() -> None:
    """Remove what no process uses any more."""
    for path in sorted(SHARED.glob("fast*_el")):
        found = _LOCK.fullmatch(path.name)
        if found is None:
            continue
        with contextlib.suppress(OSError), path.open("r+b") as file:  # of another user, or in use
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            for name in (found[1], f"sem.{found[1]}_mutex", path.name):
                (SHARED / name).unlink(missing_ok=True)
