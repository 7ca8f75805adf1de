"""`stereo-sfm run`: turn a source into a trajectory."""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from stereo_sfm.commands._options import (
    add_config_arguments,
    add_source,
    add_source_arguments,
    add_verbosity_arguments,
    add_wiring_arguments,
    load_config,
    source_choice,
    wiring_of,
)
from stereo_sfm.errors import StereoSfmError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this command."""
    add_source(parser, default="the bundled recording")
    parser.add_argument("-o", "--output", help="output folder, also in a bucket (default: runs/DATE_NAME)")
    parser.add_argument("--overwrite", action="store_true", help="replace an existing run in the output folder")
    add_source_arguments(parser)
    parser.add_argument(
        "--camera-store",
        type=Path,
        metavar="DIR",
        help="start with the calibration that earlier runs corrected for this camera (by serial number), and keep this "
        "run's corrections there",
    )
    add_config_arguments(parser)
    add_wiring_arguments(parser)
    parser.add_argument("--map-in", metavar="DIR", help="start from a saved map of this place, also in a bucket")
    parser.add_argument(
        "--localize-only", action="store_true", help="localize the camera in --map-in without changing the map"
    )
    parser.add_argument("--map-out", metavar="DIR", help="save the map (merged with --map-in, if given)")
    parser.add_argument(
        "--frame", choices=("cam0", "body"), default="cam0", help="frame whose poses the trajectories contain"
    )
    parser.add_argument(
        "--max-lost",
        type=float,
        default=20.0,
        metavar="PERCENT",
        help="exit with 4 if more than PERCENT of the frames have no pose",
    )
    parser.add_argument("--open", action="store_true", help="show the report in a browser at the end")
    parser.add_argument(
        "--matches", type=int, metavar="K", help="write an image of the matches with the last keyframe every K frames"
    )
    add_verbosity_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Run, write the output folder, print the closing summary. One for a bucket is written here, then sent."""
    from stereo_sfm.storage.folders import send_folder
    from stereo_sfm.storage.remote import Remote, place

    target = None if args.output is None else place(args.output)
    if not isinstance(target, Remote):
        return _run(args, target)[0]
    from stereo_sfm.storage import objects

    objects.listed(target)  # a bucket that is not there is found before anything is computed
    with tempfile.TemporaryDirectory(prefix="run") as folder:
        code, written = _run(args, Path(folder) / target.name)
        size = send_folder(written, target)
    if not args.quiet:
        print(f"sent to {target}: {size / 1e6:.1f} MB")
    return code


def _run(args: argparse.Namespace, output: Path | None) -> tuple[int, Path]:
    from stereo_sfm.commands._execute import RunOptions, execute
    from stereo_sfm.maps.folders import MapFolders
    from stereo_sfm.storage.remote import Remote, place

    map_in, map_out = (None if name is None else place(name) for name in (args.map_in, args.map_out))
    if isinstance(map_in, Remote):
        from stereo_sfm.fleet.copies import fetched_map

        map_in = fetched_map(map_in)
    if isinstance(map_out, Remote):
        raise StereoSfmError(f"--map-out is a folder here; 'stereo-sfm map update {map_out} RUN' changes that store")
    folders = MapFolders(map_in, args.localize_only, map_out)
    folders.check(args.overwrite)
    options = RunOptions(
        source_choice(args, args.realtime, args.speed, args.camera_store),
        load_config(args),
        wiring_of(args),
        folders,
        output=output,
        overwrite=args.overwrite,
        frame=args.frame,
        max_lost_percent=args.max_lost,
        matches=args.matches,
        quiet=args.quiet,
        verbose=args.verbose,
    )
    code, folder = execute(options)
    if args.open:
        from stereo_sfm.commands._browser import show

        show(folder / "report.html")
    return code, folder
