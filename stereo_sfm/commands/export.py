"""`stereo-sfm export`: a run or a map in the formats of other programs."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from stereo_sfm.commands._options import typed
from stereo_sfm.export.formats import MAP_FORMATS, TRAJECTORY_FORMATS, export_map, export_trajectory
from stereo_sfm.storage.remote import InputPath

if TYPE_CHECKING:
    from stereo_sfm.maps.saved_map import SavedMap
    from stereo_sfm.types import Trajectory


DENSE = "colmap-dense"  # as COLMAP's fusion reads it


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this command."""
    parser.add_argument("source", type=InputPath, metavar="RUN|MAP", help="folder of a run or of a map")
    parser.add_argument("--format", required=True, choices=(*MAP_FORMATS, DENSE, *TRAJECTORY_FORMATS))
    parser.add_argument("-o", "--output", type=Path, metavar="PATH", help="file or folder to write")
    parser.add_argument("--overwrite", action="store_true", help="replace what lies there")
    parser.add_argument(
        "--which", choices=("odom", "map", "keyframes"), default="map", help="trajectory of a run (default: map)"
    )
    parser.add_argument(
        "--images",
        metavar="SOURCE",
        help="with colmap: write the keyframes' images of this source too (rectified where the map is); with "
        f"{DENSE}: read them there instead of in the run's log or its source",
    )
    parser.add_argument("--rig", type=Path, metavar="FILE", help="calibration of --images instead of its own")
    parser.add_argument(
        "--session", type=int, metavar="N", help="only this session of a merged map; with --images: the one they show"
    )
    parser.add_argument("--walk", dest="session", type=int, default=argparse.SUPPRESS, help=argparse.SUPPRESS)
    parser.add_argument("--resolution", type=float, default=0.05, metavar="M", help="of the floor plan, metres a pixel")


@dataclass(frozen=True)
class ExportOptions:
    """Options of this command, as the parser names them."""

    source: Path
    format: str
    output: Path | None
    overwrite: bool
    which: str
    images: str | None
    rig: Path | None
    session: int | None
    resolution: float


def run(args: argparse.Namespace) -> int:
    """Write one format."""
    options = typed(ExportOptions, args)
    from stereo_sfm.errors import StereoSfmError

    if not options.source.is_dir():
        raise StereoSfmError(f"{options.source} is not the folder of a run or a map")
    if not 0 < options.resolution < float("inf"):
        raise StereoSfmError("--resolution must be above 0 metres")
    if options.images and options.format not in ("colmap", DENSE):
        raise StereoSfmError(f"--images goes with --format colmap and {DENSE}")
    if options.rig is not None and not options.images:
        raise StereoSfmError("--rig goes with --images")
    if options.session is not None and not options.images and options.format not in TRAJECTORY_FORMATS:
        raise StereoSfmError("--session goes with --images and with trajectories")
    if options.session is not None and options.format == DENSE:
        raise StereoSfmError(f"--session does not go with {DENSE}: give the --images of one session")
    write = _write_trajectories if options.format in TRAJECTORY_FORMATS else _write_map
    write = _write_dense if options.format == DENSE else write
    paths = write(options, _output(options))
    print(f"written to {', '.join(map(str, paths))}")
    return 0


def _output(options: ExportOptions) -> Path:
    """The file or folder to write: a file goes into the folder that is named instead of it."""
    whole = options.format in ("colmap", DENSE)
    if options.output is not None and (whole or not options.output.is_dir()):
        return options.output
    return (options.output or _beside(options.source)) / _default_name(options)


def _beside(source: Path) -> Path:
    """Where files of a source go that name no place: into it; into the current folder if it is the copy of another."""
    from stereo_sfm.storage.folders import cache_root

    return Path() if source.resolve().is_relative_to(cache_root().resolve()) else source


def _default_name(options: ExportOptions) -> str:
    if options.format == DENSE:
        return "dense_model"
    if options.format in MAP_FORMATS:
        return MAP_FORMATS[options.format]
    ending = "csv" if options.format == "euroc" else options.format
    return f"export_{options.which}.{ending}"


def _write_map(options: ExportOptions, output: Path) -> list[Path]:
    from stereo_sfm.export.floor_plan import plan_files

    paths = [*plan_files(output)] if options.format == "floor-plan" else [output]
    _check_free(options, paths)
    saved = _load(options.source)
    if options.images:
        _write_with_images(saved, output, options, options.images)
    else:
        export_map(saved, output, options.format, options.resolution)
    return paths


def _write_dense(options: ExportOptions, output: Path) -> list[Path]:
    """COLMAP's workspace with depth and normals."""
    from stereo_sfm.commands._progress import progress
    from stereo_sfm.dense.colmap import export_colmap_dense
    from stereo_sfm.dense.inputs import find_input
    from stereo_sfm.errors import writing_to

    _check_free(options, [output])
    given = find_input(options.source, [options.images] if options.images else [], options.rig)
    with writing_to(output), progress("depth images", len(given.saved), False, "depth images") as bar:
        export_colmap_dense(given, output, lambda *_: bar.step(""))
    return [output]


def _load(folder: Path) -> SavedMap:
    """The map of a map folder, or the one inside a run's folder."""
    from stereo_sfm.errors import StereoSfmError
    from stereo_sfm.maps.saved_map import load_map

    for place in (folder, folder / "map"):
        if (place / "map.json").is_file():
            return load_map(place)
    used = _map_used(folder)
    if used:
        raise StereoSfmError(f"{folder} holds no map of its own: it used {used} (--map-in), export that one")
    raise StereoSfmError(
        f"{folder} holds no map: nothing was mapped, or the run used a saved one (export the map given to --map-in)"
    )


def _map_used(folder: Path) -> str:
    """The saved map that a run began with, as its log says; "" for none."""
    from stereo_sfm.log.reader import LogReader
    from stereo_sfm.log.recorded import read_opening

    if not (folder / "run.mcap").is_file():
        return ""
    with LogReader(folder / "run.mcap") as reader:
        return read_opening(reader).map_in


def _write_with_images(saved: SavedMap, output: Path, options: ExportOptions, images: str) -> None:
    """COLMAP's model, and the keyframes' images beside it."""
    from stereo_sfm.calib import load_rig
    from stereo_sfm.export.keyframe_images import (
        check_session,
        open_recording,
        session_of_recording,
        write_keyframe_images,
    )

    check_session(saved, options.session)
    sessions = saved.session_ids if options.session is None else [options.session]
    cameras = [saved.cameras[session] for session in sessions]
    own_rig = load_rig(options.rig) if options.rig is not None else None
    source = open_recording(images, cameras, own_rig, options.source)
    with source:
        session = options.session if options.session is not None else session_of_recording(saved, source, images)
        export_map(saved, output, "colmap")
        write_keyframe_images(saved, source, session, output, images)


def _write_trajectories(options: ExportOptions, output: Path) -> list[Path]:
    """One file, or one for each session of a merged map."""
    found, what = _trajectories(options)
    paths = [output if len(found) == 1 else _of_session(output, session) for session in found]
    _check_free(options, paths)
    for path, trajectory in zip(paths, found.values(), strict=True):
        export_trajectory(trajectory, path, options.format, what)
    return paths


def _of_session(path: Path, session: int) -> Path:
    """map.tum -> map_walk1.tum."""
    ending = path.suffix if path.suffix in (".tum", ".kitti", ".csv", ".txt") else ""
    return path.with_name(f"{path.name.removesuffix(ending)}_walk{session}{ending}")


def _trajectories(options: ExportOptions) -> tuple[dict[int, Trajectory], str]:
    """A run's trajectory, or a map's keyframes by session; and which poses they are."""
    from stereo_sfm.drivers.ground_truth import read_kitti, read_trajectory
    from stereo_sfm.errors import StereoSfmError
    from stereo_sfm.export.keyframe_images import check_session
    from stereo_sfm.export.trajectories import named_pose
    from stereo_sfm.maps.saved_map import session_trajectory

    name = {"odom": "trajectory_odom.tum", "map": "trajectory_map.tum", "keyframes": "keyframes.tum"}[options.which]
    if (options.source / name).is_file():
        if options.session is not None:
            raise StereoSfmError("--session goes with maps: a run is one session")
        what, lines = named_pose(options.source / name), (options.source / name).with_suffix(".kitti")
        if options.format == "kitti" and lines.is_file():  # which has one for lost frames, too
            return {0: read_kitti(lines)}, what
        return {0: read_trajectory(options.source / name)}, what
    if not (options.source / "map.json").is_file():
        raise StereoSfmError(f"{options.source} holds no {name}: name the folder of a run or of a map")
    if options.which == "odom":
        raise StereoSfmError(f"{options.source} is a map: it holds keyframes, not the odometry of a run")
    saved = _load(options.source)
    check_session(saved, options.session)
    return {k: session_trajectory(saved, k) for k in saved.session_ids if options.session in (None, k)}, "world_T_cam0"


def _check_free(options: ExportOptions, paths: Sequence[Path]) -> None:
    from stereo_sfm.errors import StereoSfmError

    there = [path for path in paths if path.exists()]
    if there and not options.overwrite:
        raise StereoSfmError(f"{there[0]} exists: choose another -o, or say --overwrite")
