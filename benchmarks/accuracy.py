"""Errors of the default system on every sequence, compared with those of other systems.

    python benchmarks/accuracy.py [--odometry] [--max-frames N] [SEQUENCE ...]

Real sequences are looked for in STEREO_SFM_DATA; `sim:` scenes are rendered, `--imperfect` with cameras whose
calibration, exposure, focus or stamps are wrong. ATE is the RMSE after alignment, "scale" how much too long the path
is, "rotation" the RMSE of the orientations. `--set manhattan.enabled=true` enables the rotation prior.
"""

from __future__ import annotations

import argparse

from _sequences import IMPERFECT, PEERS, one_thread, sequences

one_thread()

import numpy as np
from _runs import ODOMETRY_ONLY, recorded_of

from stereo_sfm import config as configuration
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.eval.evaluate import Evaluation, evaluate, length

HEADING = (
    "| sequence | frames | lost | path | trajectory | ATE SE(3) | % | ATE Sim(3) | scale "
    "| rotation | drift | deg/m | points |",
    "|---|---|---|---|---|---|---|---|---|---|---|---|---|",
)


def rows_of(name: str, spec: str, config: configuration.Config, max_frames: int | None) -> list[str]:
    """Run on one sequence; a table row for each trajectory of it."""
    record, reference = recorded_of(spec, config, max_frames)
    lost = len(record.frames) - int(record.tracked().sum())
    inliers = int(np.median(record.frames.inliers))
    rows: list[str] = []
    mapped = record.mapped() if config.mapper.enabled or config.loop.enabled else None
    for kind, trajectory in (("odometry", record.odometry()), ("map", mapped)):
        if trajectory is None:
            continue
        start = f"| {name} | {len(record.frames)} | {lost} "
        try:
            result = None if reference is None else evaluate(trajectory, reference)
        except StereoSfmError:
            result = None
        cells = "| – | – | – | – | – | – | – | – " if result is None else ""
        rows.append(start + (f"| – | {kind} {cells}" if result is None else _errors(kind, result)) + f"| {inliers} |")
    return rows + peer_rows(name, max_frames)


def _errors(kind: str, result: Evaluation) -> str:
    drift = result.drift
    over = (
        "–"
        if drift is None
        else f"{drift.translation_percent:.2f} % ({drift.lengths_m[0]:g}–{drift.lengths_m[-1]:g} m)"
    )
    turn = "–" if drift is None else f"{drift.rotation_deg_per_m:.4f}"
    return (
        f"| {length(result.length_m)} | {kind} | {length(result.ape_m.rmse)} | {result.ate_percent:.3f} "
        f"| {length(result.ate_sim3_m)} | {100 * (1 / result.sim3_scale - 1):+.3f} % "
        f"| {result.ape_deg.rmse:.3f} deg | {over} | {turn} "
    )


def peer_rows(name: str, max_frames: int | None) -> list[str]:
    """Errors of other systems on the complete sequence."""
    if max_frames is not None:
        return []
    return [
        f"| {name} | | | | {system} | {length(se3)} | | {length(sim3)} | | | | | |"
        for system, (se3, sim3) in PEERS.get(name, {}).items()
    ]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sequence", nargs="*", help="folder names of the data root, or sources")
    parser.add_argument("--odometry", action="store_true", help="without mapping and loop closing")
    parser.add_argument("--imperfect", action="store_true", help="simulated cameras that are as imperfect as real ones")
    parser.add_argument("--max-frames", type=int)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    args = parser.parse_args()
    config = configuration.load(None, [*(ODOMETRY_ONLY if args.odometry else ()), *args.set])
    print("\n".join(HEADING))
    named = [*args.sequence, *(IMPERFECT if args.imperfect else ())]
    for name, spec in sequences(named):
        print("\n".join(rows_of(name, spec, config, args.max_frames)), flush=True)


if __name__ == "__main__":
    main()
