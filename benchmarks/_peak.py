"""A command of stereo-sfm, then a line with the largest memory in MB that one of its processes had.

    python benchmarks/_peak.py COMMAND...

`getrusage` of who starts a command gives its own peak, if that was more.
"""

from __future__ import annotations

import resource
import sys
from pathlib import Path


def main(command: list[str]) -> int:
    """Its exit code."""
    from stereo_sfm.cli import main as stereo_sfm

    code = stereo_sfm(command)
    status = Path("/proc/self/status").read_text().splitlines()
    own = next(int(line.split()[1]) for line in status if line.startswith("VmHWM"))
    print(max(own, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss) / 1024)
    return code


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
