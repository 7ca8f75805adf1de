"""Effect of the rolling-shutter model, on cameras with a rolling shutter.

    python benchmarks/rolling_shutter.py [SOURCE ...]

Every source is run with the readout of its calibration, and with a global shutter instead. ATE is the RMSE after
SE(3) alignment, in brackets after Sim(3) alignment.
"""

from __future__ import annotations

import argparse
import dataclasses

from _sequences import one_thread, sequences

one_thread()

from _runs import recorded

from stereo_sfm.config import Config
from stereo_sfm.drivers.source import open_source
from stereo_sfm.eval.evaluate import evaluate, length

SOURCES = (
    "rgbd_dataset_freiburg1_xyz",
    "sim:loop?camera=pinhole&size=424x400&frames=600&vibration=3&seed=3&readout=0.025",
    "sim:loop?size=424x400&frames=600&vibration=3&seed=2&readout=0.02",
)


def row(name: str, spec: str, known: bool) -> str:
    """One line of the table."""
    with open_source(spec) as source:
        readout_s = source.rig.readout_s
        if not known:
            source.rig = dataclasses.replace(source.rig, readout_s=0.0)  # pyright: ignore[reportAttributeAccessIssue]
        record = recorded(source, Config())
        truth = source.ground_truth
    if truth is None:
        return f"| {name} | – |"
    cells = [evaluate(t, truth) for t in (record.odometry(), record.mapped())]
    errors = " | ".join(f"{length(e.ape_m.rmse)} ({length(e.ate_sim3_m)})" for e in cells)
    return f"| {name} | {readout_s * 1e3:.0f} ms, {'known' if known else 'unknown'} | {errors} |"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("source", nargs="*", default=list(SOURCES), help="folder names of the data root, or sources")
    args = parser.parse_args()
    print("| source | readout | odometry | map |")
    print("|---|---|---|---|")
    for name, spec in sequences(args.source):
        for known in (True, False):
            print(row(name, spec, known), flush=True)


if __name__ == "__main__":
    main()
