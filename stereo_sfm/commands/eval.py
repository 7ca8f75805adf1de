"""`stereo-sfm eval`: compare a trajectory with ground truth."""

from __future__ import annotations

import argparse
import json
import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from stereo_sfm.commands._options import typed
from stereo_sfm.errors import StereoSfmError, printable
from stereo_sfm.input_file import read_json
from stereo_sfm.storage.remote import InputPath

if TYPE_CHECKING:
    from stereo_sfm.eval.evaluate import Evaluation
    from stereo_sfm.log.provenance import Opening
    from stereo_sfm.types import Trajectory

CHECK_FAILED = 3


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this command."""
    parser.add_argument("estimate", type=InputPath, help="a run's folder, or a trajectory file (TUM, KITTI, EuRoC)")
    parser.add_argument(
        "--ref",
        help="ground truth: a trajectory file, or a source that has it (default: the ground truth in the run's log)",
    )
    parser.add_argument(
        "--which", choices=("odom", "map", "keyframes"), help="trajectory of a run (default: map, else odom)"
    )
    parser.add_argument("--align", choices=("se3", "sim3", "origin", "none"), default="se3")
    parser.add_argument("--delta", default="1f", help="distance of relative errors in frames (1f) or metres (1m)")
    parser.add_argument(
        "--t-max-diff",
        type=float,
        metavar="S",
        help="compare the nearest poses within S seconds instead of interpolating",
    )
    parser.add_argument("--max-ape", type=float, metavar="METRES", help="exit with 3 if the ATE is larger")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument("--table", type=Path, metavar="PATH", help="write every frame's error to PATH.csv and .parquet")
    parser.add_argument("--plot", type=Path, metavar="FOLDER", help="write plots (PNG and SVG) to FOLDER")


@dataclass(frozen=True)
class EvalOptions:
    """Options of this command, as the parser names them."""

    estimate: Path
    ref: str | None
    which: str | None
    align: str
    delta: str
    t_max_diff: float | None
    max_ape: float | None
    json: bool
    table: Path | None
    plot: Path | None


def run(args: argparse.Namespace) -> int:
    """Print the errors; exit code 3 when a check fails."""
    options = typed(EvalOptions, args)
    from stereo_sfm.eval.associate import MAX_DIFFERENCE_NS
    from stereo_sfm.eval.evaluate import evaluate, table

    _check_ranges(options)
    result = evaluate(
        *load(options.estimate, options.which, options.ref),
        options.align,
        options.delta,
        interpolate=options.t_max_diff is None,
        max_difference_ns=MAX_DIFFERENCE_NS if options.t_max_diff is None else round(options.t_max_diff * 1e9),
    )
    if result.frames > 1 and not result.rpe_m.count:
        raise StereoSfmError(
            f"--delta {options.delta} is longer than the compared part: {result.frames} poses, {result.length_m:.3g} m"
        )
    if options.plot is not None:
        _plot(options.plot, printable(options.estimate.stem), result)
    if options.table is not None:
        _table(options.table, result)
    if options.json:
        print(json.dumps(result.to_dict(), indent=2))
    else:
        rows = table(result)
        width = max(len(name) for name, _ in rows)
        print("\n".join(f"{name:<{width}}  {value}" for name, value in rows))
    if options.max_ape is not None and not result.ape_m.rmse <= options.max_ape:
        print(f"stereo-sfm eval: ATE {result.ape_m.rmse:.6g} m is above {options.max_ape:g} m", file=sys.stderr)
        return CHECK_FAILED
    return 0


def _table(path: Path, result: Evaluation) -> None:
    """The errors of the compared frames as tables."""
    from stereo_sfm.errors import writing_to
    from stereo_sfm.eval.metrics import absolute_errors
    from stereo_sfm.eval.tables import write_table

    metres, radians = absolute_errors(result.estimate.poses, result.reference.poses)
    off = result.estimate.positions - result.reference.positions
    degrees = radians * (180 / math.pi) if result.oriented else radians * math.nan
    columns = ("stamp_ns", "error_m", "error_deg", "error_x_m", "error_y_m", "error_z_m")
    rows = zip(result.estimate.stamp_ns.tolist(), metres.tolist(), degrees.tolist(), *off.T.tolist(), strict=True)
    with writing_to(path.parent):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_table(path, columns, list(rows))


def _check_ranges(options: EvalOptions) -> None:
    for option, value in (("--t-max-diff", options.t_max_diff), ("--max-ape", options.max_ape)):
        if value is not None and not 0 <= value < float("inf"):
            raise StereoSfmError(f"{option} must be a number of at least 0, not {value:g}")
    if options.table is not None and options.table.name in ("", ".."):
        raise StereoSfmError(f"--table {options.table} is a folder: name a file in it, without its ending")


def load(path: Path, which: str | None, spec: str | None) -> tuple[Trajectory, Trajectory]:
    """Estimate and reference, both with stamps and with poses of the same frame."""
    from stereo_sfm.drivers.ground_truth import of_body

    file = estimate_file(path, which)
    reference, truth_file = (
        (own_truth(file.parent), None) if spec is None else load_reference(spec, _opening(file.parent))
    )
    estimate = _with_stamps(file, reference)
    if truth_file is not None:
        reference = _with_stamps(truth_file, estimate)
    frame, truth_frame = pose_frame(file), "cam0" if truth_file is None else pose_frame(truth_file)
    if (frame, truth_frame) == ("body", "cam0"):
        estimate = in_cam0(estimate, file)
    elif (frame, truth_frame) == ("cam0", "body") and truth_file is not None and reference.oriented:
        reference = in_cam0(of_body(truth_file, reference), truth_file, file.parent)
    return estimate, reference


def estimate_file(path: Path, which: str | None) -> Path:
    """The trajectory of a run's folder, or the file itself."""
    if not path.exists():
        raise StereoSfmError(f"no trajectory at {path}")
    if not path.is_dir():
        return path
    names = [f"trajectory_{which}.tum"] if which in ("odom", "map") else ["trajectory_map.tum", "trajectory_odom.tum"]
    names = ["keyframes.tum"] if which == "keyframes" else names
    found = next((path / name for name in names if (path / name).is_file()), None)
    if found is None:
        raise StereoSfmError(f"{path} is not the folder of a run: it has no {' or '.join(names)}")
    return found


def own_truth(folder: Path) -> Trajectory:
    """The ground truth in the log of a run.

    Raises:
        StereoSfmError: there is none.
    """
    from stereo_sfm.log.attached import attached_truth
    from stereo_sfm.log.reader import LogReader

    log = folder / "run.mcap"
    if log.is_file():
        with LogReader(log) as reader:
            truth = attached_truth(reader)
        if truth is not None:
            return truth
    raise StereoSfmError(f"{folder} contains no ground truth: give it with --ref (a trajectory file, or a source)")


def load_reference(spec: str, opening: Opening) -> tuple[Trajectory, Path | None]:
    """The ground truth in a file, and that file; or of a source, opened as the run opened its own."""
    from stereo_sfm.drivers.choice import SourceChoice
    from stereo_sfm.drivers.ground_truth import read_trajectory
    from stereo_sfm.drivers.source import local_place
    from stereo_sfm.storage.remote import is_uri

    path = Path(local_place(spec) if is_uri(spec) and "?" not in spec else spec).expanduser()
    if path.is_file() and path.suffix != ".mcap":
        return read_trajectory(path), path
    with SourceChoice(spec, opening.rig, rectify=opening.rectify)() as opened:
        if opened.ground_truth is None:
            raise StereoSfmError(f"{opened.name} has no ground truth: name a trajectory file or another source")
        return opened.ground_truth, None


def _opening(folder: Path) -> Opening:
    """How a run opened its source; the default if its folder has no log."""
    from stereo_sfm.log.provenance import Opening
    from stereo_sfm.log.reader import LogReader
    from stereo_sfm.log.recorded import read_opening

    if not (folder / "run.mcap").is_file():
        return Opening()
    with LogReader(folder / "run.mcap") as reader:
        return read_opening(reader)


def _with_stamps(path: Path, other: Trajectory) -> Trajectory:
    """The trajectory in a file; without stamps it takes those of the other, line by line."""
    from stereo_sfm.drivers.ground_truth import has_stamps, read_kitti, read_trajectory

    if has_stamps(path):
        return read_trajectory(path)
    lines = len(read_trajectory(path))
    if lines != len(other):
        raise StereoSfmError(
            f"{path} has no stamps, and its {lines} lines do not match {len(other)} poses: use the TUM format"
        )
    return read_kitti(path, other.stamp_ns)


def pose_frame(path: Path) -> str:
    """The frame of the poses in a file, "cam0" or "body", by its header or by its run; "" if unknown."""
    from stereo_sfm.drivers.euroc.source import TRUTH_FOLDERS
    from stereo_sfm.export.trajectories import named_pose

    named = named_pose(path, "").removeprefix("world_T_")
    if named or (path.name == "data.csv" and path.parent.name in TRUTH_FOLDERS):
        return named or "body"
    stats = path.parent / "stats.json"
    if path.suffix != ".kitti" or not stats.is_file():
        return ""
    try:
        return read_json(stats).get("frame", "")
    except (ValueError, AttributeError):  # damaged
        return ""


def in_cam0(bodies: Trajectory, path: Path, run: Path | None = None) -> Trajectory:
    """world_T_body -> world_T_cam0, each with its first pose as the world, by the calibration beside the file.

    Args: run, a folder with the calibration, where there is none beside it.
    """
    from stereo_sfm.calib import load_rig
    from stereo_sfm.geometry import se3
    from stereo_sfm.types import Trajectory

    folders = [folder for folder in (path.parent, run) if folder is not None and (folder / "rig.yaml").is_file()]
    if not folders:
        raise StereoSfmError(
            f"{path} holds poses of the body, and there is no rig.yaml beside it to convert them to cam0"
        )
    body_T_cam = load_rig(folders[0] / "rig.yaml").body_T_left
    return Trajectory(bodies.stamp_ns.copy(), se3.inverse(body_T_cam) @ bodies.poses @ body_T_cam, bodies.oriented)


def _plot(folder: Path, name: str, result: Evaluation) -> None:
    from stereo_sfm.eval.plots import plot_errors, plot_trajectory

    folder.mkdir(parents=True, exist_ok=True)
    plot_trajectory(folder / "trajectory.png", {name: result.estimate}, result.reference)
    plot_errors(folder / "errors.png", {name: result})
