"""`stereo-sfm export`: a run or a map in the formats of other programs."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from stereo_sfm.export.saved_map import SavedMap
    from stereo_sfm.types import Trajectory

MAP_FORMATS = {"colmap": "model", "ply": "points.ply", "g2o": "pose_graph.g2o", "floor-plan": "floor_plan.png"}
TRAJECTORY_FORMATS = ("tum", "kitti", "euroc")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this command."""
    parser.add_argument("source", type=Path, metavar="RUN|MAP", help="folder of a run or of a map")
    parser.add_argument("--format", required=True, choices=(*MAP_FORMATS, *TRAJECTORY_FORMATS))
    parser.add_argument("-o", "--output", type=Path, metavar="PATH", help="file or folder to write")
    parser.add_argument("--overwrite", action="store_true", help="replace what lies there")
    parser.add_argument(
        "--which", choices=("odom", "map", "keyframes"), default="map", help="trajectory of a run (default: map)"
    )
    parser.add_argument(
        "--images",
        metavar="SOURCE",
        help="with colmap: write the keyframes' pictures of this source too (rectified where the map is)",
    )
    parser.add_argument("--rig", type=Path, metavar="FILE", help="calibration of --images instead of its own")
    parser.add_argument("--walk", type=int, metavar="N", help="of a merged map: which walk --images shows (0, 1, ...)")
    parser.add_argument("--resolution", type=float, default=0.05, metavar="M", help="of the floor plan, metres a pixel")


def run(args: argparse.Namespace) -> int:
    """Write one format."""
    from stereo_sfm.errors import StereoSfmError

    if not args.source.is_dir():
        raise StereoSfmError(f"{args.source} is not the folder of a run or a map")
    if args.resolution <= 0:
        raise StereoSfmError("--resolution must be above 0 metres")
    if args.images and args.format != "colmap":
        raise StereoSfmError("--images goes with --format colmap")
    if args.walk is not None and not args.images:
        raise StereoSfmError("--walk goes with --images")
    output = args.output or args.source / _default_name(args)
    if output.exists() and not args.overwrite:
        raise StereoSfmError(f"{output} exists: choose another -o, or say --overwrite")
    output.parent.mkdir(parents=True, exist_ok=True)
    if args.format in TRAJECTORY_FORMATS:
        _write_trajectory(args, output)
    else:
        _write_map(args, output)
    print(f"written to {output}")
    return 0


def _default_name(args: argparse.Namespace) -> str:
    if args.format in MAP_FORMATS:
        return MAP_FORMATS[args.format]
    ending = "csv" if args.format == "euroc" else args.format
    return f"export_{args.which}.{ending}"


def _write_map(args: argparse.Namespace, output: Path) -> None:
    from stereo_sfm.export.floor_plan import export_floor_plan
    from stereo_sfm.export.g2o import export_g2o
    from stereo_sfm.export.ply import export_ply

    saved = _load(args.source)
    writers: dict[str, Callable[[SavedMap, Path], object]] = {
        "colmap": lambda s, path: _write_colmap(s, path, args),
        "ply": export_ply,
        "g2o": export_g2o,
        "floor-plan": lambda s, path: export_floor_plan(s, path, args.resolution),
    }
    writers[args.format](saved, output)


def _load(folder: Path) -> SavedMap:
    """The map of a map folder, or the one inside a run's folder."""
    from stereo_sfm.errors import StereoSfmError
    from stereo_sfm.export.saved_map import load_map

    for place in (folder, folder / "map"):
        if (place / "map.json").is_file():
            return load_map(place)
    raise StereoSfmError(f"{folder} holds no map (make one with 'run ... --map-out DIR')")


def _write_colmap(saved: SavedMap, output: Path, args: argparse.Namespace) -> None:
    """The model, and the keyframes' pictures beside it where they are asked for."""
    from stereo_sfm.export.colmap import export_colmap

    if not args.images:
        export_colmap(saved, output)
        return
    from calib import load_rig
    from stereo_sfm.export.pictures import check_walk, open_pictures, walk_of_recording, write_pictures

    check_walk(saved, args.walk)
    source = open_pictures(args.images, saved.rig, load_rig(args.rig) if args.rig is not None else None)
    with source:
        walk = args.walk if args.walk is not None else walk_of_recording(saved, source, args.images)
        export_colmap(saved, output)
        write_pictures(saved, source, walk, output, args.images)


def _write_trajectory(args: argparse.Namespace, output: Path) -> None:
    from stereo_sfm.export import trajectories

    trajectory = _trajectory(args.source, args.which)
    if args.format == "tum":
        trajectories.write_tum(output, trajectory)
    elif args.format == "euroc":
        trajectories.write_euroc(output, trajectory)
    else:
        trajectories.write_kitti(output, trajectory.poses)


def _trajectory(folder: Path, which: str) -> Trajectory:
    """A run's trajectory, or a map's keyframes."""
    from drivers.ground_truth import read_trajectory
    from stereo_sfm.errors import StereoSfmError
    from stereo_sfm.types import Trajectory

    path = folder / {"odom": "trajectory_odom.tum", "map": "trajectory_map.tum", "keyframes": "keyframes.tum"}[which]
    if path.is_file():
        return read_trajectory(path)
    if (folder / "map.json").is_file():
        s = _load(folder).snapshot
        order = s.stamp_ns.argsort(kind="stable")
        return Trajectory(s.stamp_ns[order], s.map_T_kf[order])
    raise StereoSfmError(f"{folder} holds no {path.name}")
