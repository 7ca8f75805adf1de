"""The same result with any scheduling: inline once, then as processes ten times with random delays in every stage.

    python -m benchmarks same_bits -- [SOURCE] [--runs 10]

Compares the logs (trajectories, keyframes, map, loops, every frame's observations) to the bit.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from stereo_sfm.config import Config
from stereo_sfm.drivers.choice import SourceChoice
from stereo_sfm.drivers.source import open_source
from stereo_sfm.log.diff import diff
from stereo_sfm.log.reader import LogReader
from stereo_sfm.log.run_log import RunLog
from stereo_sfm.log.writer import LogWriter
from stereo_sfm.pipeline.inline import run_inline
from stereo_sfm.pipeline.logger import LogOptions
from stereo_sfm.pipeline.processes import ProcessRun
from stereo_sfm.types import LoopResult


class Loops:
    """Counts accepted loops."""

    def __init__(self) -> None:
        self.count = 0

    def put(self, message: object) -> None:
        self.count += isinstance(message, LoopResult) and message.candidate_kf_id >= 0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("source", nargs="?", default="sim:loop?size=424x400&rate=10")
    parser.add_argument("--runs", type=int, default=10)
    args = parser.parse_args()
    config, same = Config(), 0
    with tempfile.TemporaryDirectory() as name:
        recording, inline = Path(name) / "recording.mcap", Path(name) / "inline.mcap"
        if not Path(args.source).exists():
            from stereo_sfm.recording.record import record

            with open_source(args.source) as source:
                for _ in record(source, recording, "raw"):
                    pass
        else:
            recording = Path(args.source)
        loops = Loops()
        with open_source(recording) as source:
            log = RunLog(
                LogWriter(inline), source.rig, config, source="x", mode="inline", image_format="none",
                ground_truth=source.ground_truth,
            )  # fmt: skip
            frames = sum(1 for _ in run_inline(source, config, [log, loops]))
            log.close()
        print(f"inline: {frames} frames, {loops.count} loops closed", flush=True)
        for seed in range(args.runs):
            path = Path(name) / f"{seed}.mcap"
            opener = SourceChoice(str(recording))
            with ProcessRun(opener, config, log=LogOptions(path, "none"), delays=seed) as run:
                for _ in run:
                    pass
            with LogReader(inline) as a, LogReader(path) as b:
                differences = diff(a, b)
            same += not differences
            print(f"processes, delays {seed}: {differences[0] if differences else 'identical'}", flush=True)
    print(f"identical {same} of {args.runs}")
    return 0 if same == args.runs else 3


if __name__ == "__main__":
    raise SystemExit(main())
