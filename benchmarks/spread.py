"""Random spread of the errors: nine runs with slightly different keyframe and corner thresholds.

Which corner is selected and which frame becomes a keyframe is partly chance, and so is a single run's error. Two
versions of the program, or odometry and map, differ where their means differ by more than this spread.

    python benchmarks/spread.py [SEQUENCE ...]
"""

from __future__ import annotations

import argparse
import itertools

from _sequences import one_thread, sequences

one_thread()

import numpy as np
from _figures import Figure, write
from _runs import ODOMETRY_ONLY, recorded_of

from stereo_sfm import config as configuration
from stereo_sfm.eval.evaluate import evaluate, length
from stereo_sfm.types import F64

SEQUENCES = ("kitti", "euroc_mh01", "rgbd_dataset_freiburg1_xyz")
KEYFRAME_SHARES = (0.97, 1.0, 1.03)  # of the default
CORNER_QUALITIES = (0.9, 1.0, 1.1)


def errors(spec: str, settings: tuple[str, ...]) -> F64:
    """(9, 2) ATE in metres after SE(3) and after Sim(3) alignment."""
    out: list[tuple[float, float]] = []
    default = configuration.Config().tracker
    for share, quality in itertools.product(KEYFRAME_SHARES, CORNER_QUALITIES):
        varied = (
            f"tracker.keyframe_share={share * default.keyframe_share:.4f}",
            f"tracker.corner_quality={quality * default.corner_quality:.5f}",
        )
        record, reference = recorded_of(spec, configuration.load(None, [*varied, *settings]))
        assert reference is not None
        found = evaluate(record.odometry() if settings else record.mapped(), reference)
        out.append((found.ape_m.rmse, found.ate_sim3_m))
    return np.array(out)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "sequence", nargs="*", default=list(SEQUENCES), help="folder names of the data root, or sources"
    )
    parser.add_argument("--write", action="store_true", help="keep the figures for the page of results")
    args = parser.parse_args()
    figures: list[Figure] = []
    print("| sequence | trajectory | ATE SE(3) | ± | ATE Sim(3) | ± |")
    print("|---|---|---|---|---|---|")
    for name, spec in sequences(args.sequence):
        for kind, settings in (("odometry alone", ODOMETRY_ONLY), ("map", ())):
            found = errors(spec, settings)
            (se3, sim3), (se3_sd, sim3_sd) = found.mean(0), found.std(0)
            short = kind.split()[0]
            figures.append(Figure(name, f"{short}, ATE SE(3)", 1e3 * se3, "mm", 1e3 * se3_sd, len(found)))
            figures.append(Figure(name, f"{short}, ATE Sim(3)", 1e3 * sim3, "mm", 1e3 * sim3_sd, len(found)))
            print(
                f"| {name} | {kind} | {length(se3)} | {length(se3_sd)} | {length(sim3)} | {length(sim3_sd)} |",
                flush=True,
            )
    if args.write:
        print(write("spread", "Accuracy on public sequences", figures))


if __name__ == "__main__":
    main()
