"""The papers' ablation on all available sequences: `python -m benchmarks ablation -- -o DIR [--frames N] ...`."""

from __future__ import annotations

import sys
from pathlib import Path

from _sequences import one_thread, sequences

SOURCES = ("kitti", "euroc_mh01", "rgbd_dataset_freiburg1_xyz", "sim:loop?camera=pinhole", "sim:loop?camera=fisheye")


def main(args: list[str]) -> int:
    """All arguments go to `stereo-sfm ablation`; without -o the report is written to runs/ablation."""
    one_thread()
    from stereo_sfm.cli import main as command

    output = [] if "-o" in args or "--output" in args else ["-o", str(Path("runs") / "ablation")]
    return command(["ablation", *[source for _, source in sequences(list(SOURCES))], *output, *args])


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
