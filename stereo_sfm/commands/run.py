"""`stereo-sfm run`: turn a source into a trajectory."""

from __future__ import annotations

import argparse
import shutil
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

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

if TYPE_CHECKING:
    from stereo_sfm.storage.remote import Remote


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
    from stereo_sfm.commands._execute import RunOptions, execute
    from stereo_sfm.maps.folders import MapFolders
    from stereo_sfm.storage import objects
    from stereo_sfm.storage.remote import Remote, place

    target = None if args.output is None else place(args.output)
    folders = MapFolders(_map_to_read(args.map_in), args.localize_only, _map_to_write(args.map_out))
    folders.check(args.overwrite)
    if isinstance(target, Remote) and objects.listed(target) and not args.overwrite:  # or there is no such bucket
        raise StereoSfmError(f"{target} exists: choose another -o, or add --overwrite")
    options = RunOptions(
        source_choice(args, args.realtime, args.speed, args.camera_store),
        load_config(args),
        wiring_of(args),
        folders,
        output=Path(tempfile.mkdtemp(prefix="run")) / target.name if isinstance(target, Remote) else target,
        overwrite=args.overwrite,
        frame=args.frame,
        max_lost_percent=args.max_lost,
        matches=args.matches,
        quiet=args.quiet,
        verbose=args.verbose,
    )
    try:
        code, written = execute(options)
        if args.open:
            from stereo_sfm.commands._browser import show

            show(written / "report.html")
    finally:  # what an unplugged camera leaves is a run, too
        if isinstance(target, Remote) and options.output is not None:
            _send(options.output, target, args.overwrite, args.quiet)
    return code


def _send(folder: Path, target: Remote, overwrite: bool, quiet: bool) -> None:
    """Send the folder of a run and remove it here, with the folder around it; it stays where it cannot be sent.

    Args:
        overwrite: files of an earlier run are removed there.
    """
    from stereo_sfm.export.run_folder import FILES
    from stereo_sfm.storage import objects
    from stereo_sfm.storage.folders import send_folder

    if folder.is_dir() and any(folder.iterdir()):
        try:
            size = send_folder(folder, target)
            objects.delete(target / name for name in FILES if overwrite and not (folder / name).exists())
        except StereoSfmError as error:
            raise StereoSfmError(f"{error}: the run is kept in {folder}") from None
        if not quiet:
            print(f"sent to {target}: {size / 1e6:.1f} MB")
    shutil.rmtree(folder.parent, ignore_errors=True)


def _map_to_read(name: str | None) -> Path | None:
    """The folder of `--map-in`; one in a bucket is fetched."""
    from stereo_sfm.storage.remote import Remote, place

    found = None if name is None else place(name)
    if isinstance(found, Remote):
        from stereo_sfm.fleet.copies import fetched_map

        return fetched_map(found)
    return found


def _map_to_write(name: str | None) -> Path | None:
    """The folder of `--map-out`.

    Raises:
        StereoSfmError: it is in a bucket.
    """
    from stereo_sfm.storage.remote import Remote, place

    found = None if name is None else place(name)
    if isinstance(found, Remote):
        raise StereoSfmError(f"--map-out is a folder here; 'stereo-sfm map update {found} RUN' changes that store")
    return found
