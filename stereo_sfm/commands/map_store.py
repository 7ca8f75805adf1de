"""`stereo-sfm map update|undo|versions|label|plan`: the map of a store over months."""

from __future__ import annotations

import argparse
import contextlib
import math
import re
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from stereo_sfm.commands._options import add_config_arguments, load_config, typed
from stereo_sfm.commands._stop import INTERRUPTED
from stereo_sfm.errors import StereoSfmError

if TYPE_CHECKING:
    from stereo_sfm.config import Config
    from stereo_sfm.maps.saved_map import SavedMap

_NEGATIVE = re.compile(r"-[\d.].*")  # of a point: a value, no option
ACTIONS = ("update", "undo", "versions", "label", "plan", "release", "fetch")


@dataclass(frozen=True)
class LabelOptions:
    """Options of `map label`, as the parser names them."""

    name: str
    start: tuple[float, float] | None
    end: tuple[float, float] | None
    door: bool
    remove: bool


def add_arguments(add_action: Callable[..., argparse.ArgumentParser]) -> None:
    """The actions of this file and their options."""
    update = add_action("update", help="put sessions into the map of a store, which stays as large as the store")
    update.add_argument(
        "store", metavar="STORE", help="map folder, or address in a bucket; created by the first session"
    )
    update.add_argument(
        "walks",
        nargs="+",
        metavar="SESSION",
        help="a recording or another source, the folder of a run, or its map",
    )
    update.add_argument("--keep", type=int, default=5, metavar="N", help="earlier versions to keep (default: 5)")
    add_config_arguments(update)
    undo = add_action("undo", help="bring back the version before the last update")
    undo.add_argument("store", metavar="STORE", help="map folder, or address in a bucket")
    versions = add_action("versions", help="list the versions of a store and what changed last")
    versions.add_argument("store", metavar="STORE", help="map folder, or address in a bucket")
    label = add_action("label", help="name an aisle, or a door, by a line on the floor plan")
    label.add_argument("store", metavar="STORE", help="map folder, or address in a bucket")
    label._negative_number_matcher = _NEGATIVE  # pyright: ignore[reportPrivateUsage]
    label.add_argument("name", help="such as 'aisle 4' or, with --door, 'stockroom'")
    label.add_argument("start", nargs="?", type=_point, metavar="X,Y", help="metres of the floor plan")
    label.add_argument("end", nargs="?", type=_point, metavar="X,Y", help="the other end")
    label.add_argument("--door", action="store_true", help="the line is across a door, not along an aisle")
    label.add_argument("--remove", action="store_true", help="forget this name")
    plan = add_action("plan", help="write the floor plan for robots, with shelf fronts, doors, keep-out zones")
    plan.add_argument(
        "store", metavar="STORE", help="map folder, or address in a bucket; the files are written into it"
    )
    plan.add_argument("--resolution", type=float, default=0.05, metavar="M", help="metres a pixel (default: 0.05)")

    release = add_action("release", help="give a version of a store in a bucket to robots")
    release.add_argument("store", metavar="STORE", help="address in a bucket")
    release.add_argument("version", type=int, metavar="VERSION", help="number, as 'map versions' lists it")
    release.add_argument("--robots", nargs="+", default=[], metavar="NAME", help="these robots (default: all)")
    fetch = add_action("fetch", help="make a folder a robot's version of a store in a bucket, by what has changed")
    fetch.add_argument("store", metavar="STORE", help="address in a bucket")
    fetch.add_argument("folder", type=Path, metavar="FOLDER", help="map folder; kept when the network is away")
    fetch.add_argument("--robot", default="", metavar="NAME", help="whose version (default: that of all robots)")


def _point(text: str) -> tuple[float, float]:
    try:
        x, y = map(float, text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' is no point: write X,Y in metres, as 1.5,3") from None
    if not (math.isfinite(x) and math.isfinite(y)):
        raise argparse.ArgumentTypeError(f"{text} is nowhere: a point has two finite numbers of metres")
    return x, y


def run(args: argparse.Namespace) -> int:
    """Run the chosen action."""
    from stereo_sfm.fleet.versions import HEAD
    from stereo_sfm.storage.remote import Remote, place

    store = place(args.store)
    if isinstance(store, Path) and (store / HEAD).is_file():  # of versions, as in a bucket
        store = Remote("file", "", str(store.resolve()).strip("/"))
    if args.action == "update" and args.keep < 1:
        raise StereoSfmError("--keep must be at least 1")
    if args.action in ("release", "fetch") and not isinstance(store, Remote):
        raise StereoSfmError(f"map {args.action} is for a store in a bucket: give its address, as in s3://BUCKET/STORE")
    if isinstance(store, Remote):
        from stereo_sfm.commands import map_bucket

        return map_bucket.run(store, args)
    if args.action == "update":
        return _update(store, args.walks, load_config(args), args.keep)
    if args.action == "undo":
        return _undo(store)
    if args.action == "versions":
        return _versions(store)
    if args.action == "plan":
        return plan(store, args.resolution)
    return label(typed(LabelOptions, args), store)


def _update(store: Path, walks: list[str], config: Config, keep: int) -> int:
    """One version for each session."""
    from stereo_sfm.maps.put_session import put_session
    from stereo_sfm.maps.store import lock, versions_folder

    try:
        with lock(store):
            for name in walks:
                put = put_session(store, mapped(name, config), name, config, keep)
                # "STORE: begun with NAME", "STORE version 3: NAME, ..."
                print(f"{store}{':' if put.text.startswith('begun') else ''} {put.text}")
                print("".join(f"  {line}\n" for line in put.changes), end="")
    finally:
        if not store.exists():
            with contextlib.suppress(OSError):  # it is not empty
                versions_folder(store).rmdir()
    return 0


def mapped(name: str, config: Config) -> SavedMap:
    """The session's own map: of a map or run folder, or of a run over the source made now."""
    from stereo_sfm.fleet.copies import fetched
    from stereo_sfm.maps.saved_map import load_map
    from stereo_sfm.storage.remote import Remote, is_uri, place

    if is_uri(name) and "?" not in name and not name.endswith(".mcap"):
        found = place(name)
        name = str(fetched(found) if isinstance(found, Remote) else found)
    for folder in (Path(name), Path(name) / "map"):
        if (folder / "map.json").is_file():
            return load_map(folder)
    from stereo_sfm.commands._execute import RunOptions, execute
    from stereo_sfm.drivers.choice import SourceChoice
    from stereo_sfm.maps.folders import MapFolders
    from stereo_sfm.pipeline.session import Wiring

    with tempfile.TemporaryDirectory(prefix="walk") as draft:
        choice = SourceChoice.of(name)
        out = Path(draft) / "run"
        code, folder = execute(RunOptions(choice, config, Wiring(log="none"), MapFolders(), output=out, quiet=True))
        if code == INTERRUPTED:  # a part of a walk is no session: repeated, the command would find it in the store
            raise KeyboardInterrupt
        if not (folder / "map" / "map.json").is_file():
            raise StereoSfmError(f"{name} gave no map (exit code {code}): 'stereo-sfm run {name}' says why")
        return load_map(folder / "map")


def _undo(store: Path) -> int:
    from stereo_sfm.maps.store import lock, undo

    _check_store(store)
    with lock(store):
        print(f"{store} is version {undo(store)} again")
    return 0


def _versions(store: Path) -> int:
    from stereo_sfm.input_file import read_text
    from stereo_sfm.maps.header import read_header
    from stereo_sfm.maps.store import CHANGES, read_about, versions, versions_folder

    _check_store(store)
    folders = [(n, versions_folder(store) / f"{n:05d}") for n in versions(store)]
    newest = read_about(store).version
    for number, folder in [*((n, f) for n, f in folders if n < newest), (newest, store)]:
        head = read_header(folder, ())
        print(f"version {number}: {head['sessions']} sessions, {head['keyframes']} keyframes, {head['points']} points")
        path = folder / CHANGES
        lines = read_text(path).splitlines() if path.is_file() else []
        print("".join(f"  {line}\n" for line in lines), end="")
    return 0


def label(options: LabelOptions, store: Path) -> int:
    """Set or remove a label in `store.yaml`."""
    import dataclasses

    from stereo_sfm.maps.labels import Aisle, Door
    from stereo_sfm.maps.store import lock_about, read_about, write_about

    _check_store(store)
    with lock_about(store):
        about = read_about(store)
        aisles = tuple(a for a in about.aisles if a.name != options.name)
        doors = tuple(d for d in about.doors if d.name != options.name)
        if options.remove and (aisles, doors) == (about.aisles, about.doors):
            raise StereoSfmError(f"{store} has no label '{options.name}'")
        if not options.remove:
            if options.start is None or options.end is None or options.start == options.end:
                raise StereoSfmError(
                    "a label needs two different points, as in: map label STORE 'aisle 4' 1.5,3 13.5,3"
                )
            if options.door:
                doors = (*doors, Door(options.name, options.start, options.end))
            else:
                aisles = (*aisles, Aisle(options.name, options.start, options.end))
        write_about(store, dataclasses.replace(about, aisles=aisles, doors=doors))
    return 0


def plan(store: Path, resolution: float) -> int:
    """Floor plan, keep-out mask and drawing, shelf fronts, doors."""
    from stereo_sfm.export.store_plan import write_store_plan

    _check_store(store)
    print(write_store_plan(store, resolution))
    return 0


def _check_store(store: Path) -> None:
    if not (store / "map.json").is_file():
        raise StereoSfmError(f"no map at {store}: 'stereo-sfm map update {store} SESSION' begins one")
