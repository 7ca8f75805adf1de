"""`stereo-sfm export`: a run or a map in the formats of other programs."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from stereo_sfm.maps.saved_map import SavedMap
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
    parser.add_argument(
        "--walk", type=int, metavar="N", help="of a merged map: this trajectory alone; with --images: what it shows"
    )
    parser.add_argument("--resolution", type=float, default=0.05, metavar="M", help="of the floor plan, metres a pixel")


def run(args: argparse.Namespace) -> int:
    """Write one format."""
    from stereo_sfm.errors import StereoSfmError

    if not args.source.is_dir():
        raise StereoSfmError(f"{args.source} is not the folder of a run or a map")
    if not 0 < args.resolution < float("inf"):
        raise StereoSfmError("--resolution must be above 0 metres")
    if args.images and args.format != "colmap":
        raise StereoSfmError("--images goes with --format colmap")
    if args.rig is not None and not args.images:
        raise StereoSfmError("--rig goes with --images")
    if args.walk is not None and not args.images and args.format not in TRAJECTORY_FORMATS:
        raise StereoSfmError("--walk goes with --images and with trajectories")
    write = _write_trajectories if args.format in TRAJECTORY_FORMATS else _write_map
    paths = write(args, args.output or args.source / _default_name(args))
    print(f"written to {', '.join(map(str, paths))}")
    return 0


def _default_name(args: argparse.Namespace) -> str:
    if args.format in MAP_FORMATS:
        return MAP_FORMATS[args.format]
    ending = "csv" if args.format == "euroc" else args.format
    return f"export_{args.which}.{ending}"


def _write_map(args: argparse.Namespace, output: Path) -> list[Path]:
    from stereo_sfm.export.floor_plan import export_floor_plan, plan_files
    from stereo_sfm.export.g2o import export_g2o
    from stereo_sfm.export.ply import export_ply

    paths = [*plan_files(output)] if args.format == "floor-plan" else [output]
    _check_free(args, paths)
    saved = _load(args.source)
    output.parent.mkdir(parents=True, exist_ok=True)
    writers: dict[str, Callable[[SavedMap, Path], object]] = {
        "colmap": lambda s, path: _write_colmap(s, path, args),
        "ply": export_ply,
        "g2o": export_g2o,
        "floor-plan": lambda s, path: export_floor_plan(s, path, args.resolution),
    }
    writers[args.format](saved, output)
    return paths


def _load(folder: Path) -> SavedMap:
    """The map of a map folder, or the one inside a run's folder."""
    from stereo_sfm.errors import StereoSfmError
    from stereo_sfm.maps.saved_map import load_map

    for place in (folder, folder / "map"):
        if (place / "map.json").is_file():
            return load_map(place)
    raise StereoSfmError(f"{folder} holds no map: nothing was mapped, or by an earlier version (run it again)")


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


def _write_trajectories(args: argparse.Namespace, output: Path) -> list[Path]:
    """One file, or one for each walk of a merged map."""
    from stereo_sfm.export import trajectories

    found, what = _trajectories(args)
    paths = [output if len(found) == 1 else _of_walk(output, walk) for walk in found]
    _check_free(args, paths)
    output.parent.mkdir(parents=True, exist_ok=True)
    for path, trajectory in zip(paths, found.values(), strict=True):
        if args.format == "tum":
            trajectories.write_tum(path, trajectory, what)
        elif args.format == "euroc":
            trajectories.write_euroc(path, trajectory, what)
        else:
            trajectories.write_kitti(path, trajectory.poses)
    return paths


def _of_walk(path: Path, walk: int) -> Path:
    """map.tum -> map_walk1.tum."""
    ending = path.suffix if path.suffix in (".tum", ".kitti", ".csv", ".txt") else ""
    return path.with_name(f"{path.name.removesuffix(ending)}_walk{walk}{ending}")


def _trajectories(args: argparse.Namespace) -> tuple[dict[int, Trajectory], str]:
    """A run's trajectory, or a map's keyframes, walk by walk; and which poses they are."""
    from drivers.ground_truth import read_trajectory
    from stereo_sfm.errors import StereoSfmError
    from stereo_sfm.export.pictures import check_walk
    from stereo_sfm.export.trajectories import named_pose
    from stereo_sfm.maps.saved_map import walk_trajectory

    name = {"odom": "trajectory_odom.tum", "map": "trajectory_map.tum", "keyframes": "keyframes.tum"}[args.which]
    if (args.source / name).is_file():
        if args.walk is not None:
            raise StereoSfmError("--walk goes with maps: a run is one walk")
        return {0: read_trajectory(args.source / name)}, named_pose(args.source / name)
    if not (args.source / "map.json").is_file():
        raise StereoSfmError(f"{args.source} holds no {name}")
    if args.which == "odom":
        raise StereoSfmError(f"{args.source} is a map: it holds keyframes, not the odometry of a run")
    saved = _load(args.source)
    check_walk(saved, args.walk)
    return {k: walk_trajectory(saved, k) for k in saved.walks if args.walk in (None, k)}, "world_T_cam0"


def _check_free(args: argparse.Namespace, paths: Sequence[Path]) -> None:
    from stereo_sfm.errors import StereoSfmError

    there = [path for path in paths if path.exists()]
    if there and not args.overwrite:
        raise StereoSfmError(f"{there[0]} exists: choose another -o, or say --overwrite")
