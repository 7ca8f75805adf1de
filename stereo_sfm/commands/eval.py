"""`stereo-sfm eval`: compare a trajectory with ground truth."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from stereo_sfm.errors import StereoSfmError

if TYPE_CHECKING:
    from stereo_sfm.eval.evaluate import Evaluation
    from stereo_sfm.types import Trajectory

CHECK_FAILED = 3


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this command."""
    parser.add_argument("estimate", type=Path, help="a run's folder, or a trajectory file (TUM, KITTI, EuRoC)")
    parser.add_argument("--ref", required=True, help="ground truth: a trajectory file, or a source that knows it")
    parser.add_argument("--which", choices=("odom", "map", "keyframes"), help="of a run (default: map, else odom)")
    parser.add_argument("--align", choices=("se3", "sim3", "origin", "none"), default="se3")
    parser.add_argument("--delta", default="1f", help="relative errors over frames (1f) or metres (1m)")
    parser.add_argument(
        "--t-max-diff", type=float, metavar="S", help="compare nearest stamps within S seconds instead of interpolating"
    )
    parser.add_argument("--max-ape", type=float, metavar="METRES", help="exit with 3 if the ATE is above")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument("--plot", type=Path, metavar="FOLDER", help="draw trajectory.png and errors.png there")


def run(args: argparse.Namespace) -> int:
    """Print the errors; exit code 3 when a check fails."""
    from stereo_sfm.eval.associate import MAX_DIFFERENCE_NS
    from stereo_sfm.eval.evaluate import evaluate, table

    reference = load_reference(args.ref)
    result = evaluate(
        load_estimate(args.estimate, args.which, reference),
        reference,
        args.align,
        args.delta,
        interpolate=args.t_max_diff is None,
        max_difference_ns=MAX_DIFFERENCE_NS if args.t_max_diff is None else round(args.t_max_diff * 1e9),
    )
    if args.plot is not None:
        _plot(args.plot, args.estimate.stem, result)
    if args.json:
        print(json.dumps(result.to_dict(), indent=2))
    else:
        rows = table(result)
        width = max(len(name) for name, _ in rows)
        print("\n".join(f"{name:<{width}}  {value}" for name, value in rows))
    if args.max_ape is not None and not result.ape_m.rmse <= args.max_ape:
        print(f"stereo-sfm eval: ATE {result.ape_m.rmse:.6g} m is above {args.max_ape:g} m", file=sys.stderr)
        return CHECK_FAILED
    return 0


def load_estimate(path: Path, which: str | None, reference: Trajectory) -> Trajectory:
    """The trajectory of a run's folder or of a file; one without stamps takes those of the reference, line by line."""
    from drivers.ground_truth import has_stamps, read_kitti, read_trajectory

    if not path.is_dir() and not has_stamps(path):
        lines = len(read_trajectory(path))
        if lines != len(reference):
            raise StereoSfmError(
                f"{path} has no stamps and {lines} lines, the reference {len(reference)} poses: compare the TUM form"
            )
        return read_kitti(path, reference.stamp_ns)
    if not path.is_dir():
        return read_trajectory(path)
    names = [f"trajectory_{which}.tum"] if which in ("odom", "map") else ["trajectory_map.tum", "trajectory_odom.tum"]
    names = ["keyframes.tum"] if which == "keyframes" else names
    found = next((path / name for name in names if (path / name).is_file()), None)
    if found is None:
        raise StereoSfmError(f"{path} is no run's folder: it has no {' or '.join(names)}")
    return read_trajectory(found)


def load_reference(spec: str) -> Trajectory:
    """The ground truth of a file or of a source."""
    from drivers.ground_truth import read_trajectory
    from drivers.source import open_source

    path = Path(spec).expanduser()
    if path.is_file() and path.suffix != ".mcap":
        return read_trajectory(path)
    with open_source(spec) as source:
        if source.ground_truth is None:
            raise StereoSfmError(f"{source.name} has no ground truth")
        return source.ground_truth


def _plot(folder: Path, name: str, result: Evaluation) -> None:
    from stereo_sfm.eval.plots import plot_errors, plot_trajectory

    folder.mkdir(parents=True, exist_ok=True)
    plot_trajectory(folder / "trajectory.png", {name: result.estimate}, result.reference)
    plot_errors(folder / "errors.png", {name: result})
