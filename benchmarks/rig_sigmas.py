"""Are the stated deviations of self-calibration true? Both halves of real sequences must agree within them.

    STEREO_SFM_REAL=FOLDER STEREO_SFM_DATA=FOLDER python benchmarks/rig_sigmas.py [--only NAME]

Every real sequence of two cameras is run once. The terms of the rig are estimated from the windows of the first half of
the run and from those of the second half, and from even and odd windows. Printed are the differences over the
deviations that the two estimates state together, of the terms that a half knows better than the prior. Of these, 95 %
should be below 2, and half should be above 0.4: else the deviations are too small, or too large. What all windows share
(errors of matching) is part of the stated deviations, and does not show in a difference of halves.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from _sequences import one_thread

one_thread()

import numpy as np
from _real_sequences import FOLDER, SEQUENCES, real_root
from _runs import recorded_of

from stereo_sfm.calibration.rig_window import PRIOR, RigWindow
from stereo_sfm.calibration.self_calibration import SelfCalibration
from stereo_sfm.config import Config
from stereo_sfm.types import F64

KNOWN = 0.5  # of the prior deviation: what a half must know of a term
LEAST = 4  # windows
TERMS = ("turn x", "turn y", "turn z", "base y", "base z", "focal", "dec x", "dec y")


def finished(spec: str) -> SelfCalibration:
    """The self-calibration of a run on a source, when it has ended."""
    ended: list[SelfCalibration] = []
    finish = SelfCalibration.finish

    def noted(self: SelfCalibration) -> Any:
        out = finish(self)
        ended.append(self)
        return out

    SelfCalibration.finish = noted
    try:
        recorded_of(spec, Config())
    finally:
        SelfCalibration.finish = finish
    return ended[-1]


def differences(calibration: SelfCalibration, one: list[RigWindow], other: list[RigWindow]) -> F64:
    """(8,) of the terms from two sets of windows, in stated deviations; NaN of a term that one does not know."""
    a, b = (calibration.estimate(part) for part in (one, other))
    known = np.maximum(a.sigma, b.sigma) < KNOWN * PRIOR
    return np.where(known, (a.value - b.value) / np.hypot(a.sigma, b.sigma), np.nan)


def line(name: str, kind: str, values: F64) -> str:
    """Of a table."""
    size = np.abs(values[np.isfinite(values)])
    cells = " ".join(f"{v:7.2f}" for v in values) if values.ndim == 1 else " " * 63
    return f"{name:20} {kind:6} {cells}  {100 * (size < 2).mean():5.1f} % < 2, median {np.median(size):.2f}"


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--real", type=Path, help=f"folder of the laid-out sequences (default: {FOLDER})")
    parser.add_argument("--only", action="append", default=[], metavar="NAME", help="sequences that begin so; repeat")
    args = parser.parse_args()
    print(f"{'sequence':20} {'halves':6} {' '.join(f'{t:>7}' for t in TERMS)}")
    found: dict[str, list[F64]] = {"time": [], "parity": []}
    for sequence in SEQUENCES:
        place = sequence.path(real_root(args.real))
        chosen = not args.only or any(sequence.name.startswith(o) for o in args.only)
        if place is None or not chosen or sequence.kind == "depth" or sequence.rest:
            continue
        calibration = finished(str(place.resolve()))
        windows = list(calibration.windows)
        if len(windows) < 2 * LEAST:
            print(f"{sequence.name:20} {len(windows)} windows are too few")
            continue
        middle = len(windows) // 2
        halves = {"time": (windows[:middle], windows[middle:]), "parity": (windows[::2], windows[1::2])}
        for kind, (one, other) in halves.items():
            found[kind].append(differences(calibration, one, other))
            print(line(sequence.name, kind, found[kind][-1]), flush=True)
    for kind, values in found.items():
        if values:
            print(line("all", kind, np.stack(values)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
