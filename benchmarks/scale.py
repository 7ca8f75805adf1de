"""Errors of the scale, and of the position relative to the path, in ten simulated stores of different kinds.

    python benchmarks/scale.py [--odometry] [--max-frames N] [SEQUENCE ...]

Ten stores differ in density, seed, route, speed and camera; beside them the rendered store walk of the data root. The
scale error is that of the Sim(3) alignment, below 0 where the estimated path is too short; ATE is the RMSE after SE(3)
alignment in percent of the path. "odometry alone" runs without mapping and loop closing; "odometry" are the live poses
with both, "map" the final ones. The last rows are the mean of the scale errors' amounts and the largest one.
"""

from __future__ import annotations

import argparse

from _sequences import data_root, one_thread

one_thread()

import numpy as np
from _figures import Figure, write
from _runs import ODOMETRY_ONLY, recorded_together

from stereo_sfm import config as configuration
from stereo_sfm.drivers.select import SelectedFrames
from stereo_sfm.drivers.source import open_source
from stereo_sfm.eval.evaluate import evaluate

STORES = (
    "sim:sparse?seed=0&rate=10",
    "sim:sparse?seed=3&rate=10&walk=1",
    "sim:sparse?seed=7&rate=15&walk=2&speed=1.5",
    "sim:aisle?seed=1&rate=10",
    "sim:loop?seed=2&rate=10",
    "sim:blank?seed=4&rate=10",
    "sim:people?seed=5&rate=10",
    "sim:sparse?seed=0&rate=10&camera=pinhole",
    "sim:sparse?seed=5&rate=10&walk=3&camera=pinhole",
    "sim:loop?seed=6&rate=10&camera=pinhole",
)
FRAMES = 150
Row = tuple[str, float, float, float]  # trajectory, scale error in percent, ATE in percent, path in metres


def rows_of(spec: str, odometry_only: bool, max_frames: int) -> list[Row]:
    """Run on one sequence; a row for each of its trajectories."""
    configs = [configuration.load(None, settings) for settings in (list(ODOMETRY_ONLY), [])]
    with SelectedFrames(open_source(spec), max_frames=max_frames) as source:
        records = recorded_together(source, configs[:1] if odometry_only else configs)
        reference = source.ground_truth
    assert reference is not None
    found = [("odometry alone", records[0].odometry())]
    for record in records[1:]:
        found += [("odometry", record.odometry()), ("map", record.mapped())]
    rows: list[Row] = []
    for name, trajectory in found:
        assert trajectory is not None
        result = evaluate(trajectory, reference)
        rows.append((name, 100 * (1 / result.sim3_scale - 1), result.ate_percent, result.length_m))
    return rows


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sequence", nargs="*", help="sources; default: the ten stores and the store walk")
    parser.add_argument("--odometry", action="store_true", help="only without mapping and loop closing")
    parser.add_argument("--max-frames", type=int, default=FRAMES)
    parser.add_argument("--write", action="store_true", help="keep the figures for the page of results")
    args = parser.parse_args()
    figures: list[Figure] = []
    root = data_root()
    walk = [str(root / "store_walk")] if root is not None and (root / "store_walk").is_dir() else []
    found: dict[str, list[float]] = {}
    print("| store | trajectory | path | scale error | ATE SE(3) |\n|---|---|---|---|---|")
    for spec in args.sequence or [*STORES, *walk]:
        for name, scale, ate, path in rows_of(spec, args.odometry, args.max_frames):
            found.setdefault(name, []).append(abs(scale))
            short = spec if spec not in walk else "store_walk"
            figures.append(Figure(f"`{short}`", f"{name}, scale error", scale, "%"))
            figures.append(Figure(f"`{short}`", f"{name}, ATE of the path", ate, "%"))
            print(f"| {spec} | {name} | {path:.1f} m | {scale:+.3f} % | {ate:.3f} % |", flush=True)
    if args.write:
        print(write("scale", "Scale in ten simulated stores", figures))
    for name, scales in found.items():
        print(f"| mean, largest | {name} | | {np.mean(scales):.3f} %, {np.max(scales):.3f} % | |")


if __name__ == "__main__":
    main()
