"""`stereo-sfm map update|undo|versions|label|plan`: the map of a store over months."""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from stereo_sfm.commands._options import add_config_arguments, load_config
from stereo_sfm.errors import StereoSfmError

if TYPE_CHECKING:
    from stereo_sfm.config import Config
    from stereo_sfm.maps.saved_map import SavedMap

PLAN, FRONTS, DOORS = "floor_plan.pgm", "shelf_fronts.yaml", "doors.yaml"
ACTIONS = ("update", "undo", "versions", "label", "plan")


@dataclass(frozen=True)
class LabelOptions:
    """Options of `map label`."""

    store: Path
    name: str
    start: tuple[float, float] | None
    end: tuple[float, float] | None
    door: bool
    remove: bool


def add_arguments(add_action: Callable[..., argparse.ArgumentParser]) -> None:
    """The actions of this file and their options."""
    update = add_action("update", help="put sessions into the map of a store, which stays as large as the store")
    update.add_argument("store", type=Path, metavar="STORE", help="map folder; created by the first session")
    update.add_argument(
        "walks",
        nargs="+",
        metavar="SESSION",
        help="a recording or another source, the folder of a run, or its map",
    )
    update.add_argument("--keep", type=int, default=5, metavar="N", help="earlier versions to keep (default: 5)")
    add_config_arguments(update)
    undo = add_action("undo", help="bring back the version before the last update")
    undo.add_argument("store", type=Path, metavar="STORE", help="map folder")
    versions = add_action("versions", help="list the versions of a store and what changed last")
    versions.add_argument("store", type=Path, metavar="STORE", help="map folder")
    label = add_action("label", help="name an aisle, or a door, by a line on the floor plan")
    label.add_argument("store", type=Path, metavar="STORE", help="map folder")
    label.add_argument("name", help="such as 'aisle 4' or, with --door, 'stockroom'")
    label.add_argument("start", nargs="?", type=_point, metavar="X,Y", help="metres of the floor plan")
    label.add_argument("end", nargs="?", type=_point, metavar="X,Y", help="the other end")
    label.add_argument("--door", action="store_true", help="the line is across a door, not along an aisle")
    label.add_argument("--remove", action="store_true", help="forget this name")
    plan = add_action("plan", help="write the floor plan for robots, with shelf fronts, doors, keep-out zones")
    plan.add_argument("store", type=Path, metavar="STORE", help="map folder; the files are written into it")
    plan.add_argument("--resolution", type=float, default=0.05, metavar="M", help="metres a pixel (default: 0.05)")


def _point(text: str) -> tuple[float, float]:
    x, _, y = text.partition(",")
    return float(x), float(y)


def run(args: argparse.Namespace) -> int:
    """Run the chosen action."""
    if args.action == "update":
        if args.keep < 1:
            raise StereoSfmError("--keep must be at least 1")
        return _update(args.store, args.walks, load_config(args), args.keep)
    if args.action == "undo":
        return _undo(args.store)
    if args.action == "versions":
        return _versions(args.store)
    if args.action == "plan":
        return _plan(args.store, args.resolution)
    return _label(LabelOptions(args.store, args.name, args.start, args.end, args.door, args.remove))


def _update(store: Path, walks: list[str], config: Config, keep: int) -> int:
    """One version for each session."""
    from stereo_sfm.loop.vocabulary_file import configured_vocabulary
    from stereo_sfm.maps.changes import changed_cells, describe_changes
    from stereo_sfm.maps.saved_map import load_map
    from stereo_sfm.maps.store import lock, read_about, write_version
    from stereo_sfm.maps.update import update

    with lock(store):
        for name in walks:
            walk = _mapped(name, config)
            if not (store / "map.json").exists():
                write_version(store, walk, ["the first session"], keep)
                print(f"{store}: begun with {name}, {len(walk)} keyframes")
                continue
            saved = load_map(store, walk.rig)
            result = update(saved, walk, configured_vocabulary(config.loop), config.loop, config.mapper)
            about = read_about(store, saved)
            changes = describe_changes(changed_cells(result, about.map_T_floor), about.aisles)
            number = write_version(store, result.saved, changes, keep)
            print(
                f"{store} version {number}: {name}, {len(result.loops)} loops, {result.fused} points found again,"
                f" {len(saved)} + {len(walk)} - {result.forgotten} -> {len(result.saved)} keyframes,"
                f" {len(result.saved.snapshot.pt_ids)} points"
            )
            print("\n".join(f"  {line}" for line in changes or ["no shelf changed"]))
    return 0


def _mapped(name: str, config: Config) -> SavedMap:
    """The session's own map: of a map or run folder, or of a run over the source made now."""
    from stereo_sfm.maps.saved_map import load_map

    for folder in (Path(name), Path(name) / "map"):
        if (folder / "map.json").is_file():
            return load_map(folder)
    from stereo_sfm.commands._execute import RunOptions, execute
    from stereo_sfm.drivers.choice import SourceChoice
    from stereo_sfm.maps.folders import MapFolders
    from stereo_sfm.pipeline.session import Wiring

    with tempfile.TemporaryDirectory(prefix="walk") as place:
        choice = SourceChoice.of(name)
        out = Path(place) / "run"
        code, folder = execute(RunOptions(choice, config, Wiring(log="none"), MapFolders(), output=out, quiet=True))
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
    from stereo_sfm.maps.header import read_header
    from stereo_sfm.maps.store import CHANGES, read_about, versions, versions_folder

    _check_store(store)
    folders = [(n, versions_folder(store) / f"{n:05d}") for n in versions(store)]
    newest = read_about(store).version
    for number, folder in [*((n, f) for n, f in folders if n < newest), (newest, store)]:
        head = read_header(folder, ())
        print(f"version {number}: {head['sessions']} sessions, {head['keyframes']} keyframes, {head['points']} points")
        path = folder / CHANGES
        lines = path.read_text("utf-8").splitlines() if path.is_file() else []
        print("".join(f"  {line}\n" for line in lines), end="")
    return 0


def _label(options: LabelOptions) -> int:
    import dataclasses

    from stereo_sfm.maps.labels import Aisle, Door
    from stereo_sfm.maps.store import lock_about, read_about, write_about

    _check_store(options.store)
    with lock_about(options.store):
        about = read_about(options.store)
        aisles = tuple(a for a in about.aisles if a.name != options.name)
        doors = tuple(d for d in about.doors if d.name != options.name)
        if options.remove and (aisles, doors) == (about.aisles, about.doors):
            raise StereoSfmError(f"{options.store} has no label '{options.name}'")
        if not options.remove:
            if options.start is None or options.end is None or options.start == options.end:
                raise StereoSfmError(
                    "a label needs two different points, as in: map label STORE 'aisle 4' 1.5,3 13.5,3"
                )
            if options.door:
                doors = (*doors, Door(options.name, options.start, options.end))
            else:
                aisles = (*aisles, Aisle(options.name, options.start, options.end))
        write_about(options.store, dataclasses.replace(about, aisles=aisles, doors=doors))
    return 0


def _plan(store: Path, resolution: float) -> int:
    """Floor plan, keep-out mask and drawing, shelf fronts, doors."""
    from stereo_sfm.export.doors import plan_doors
    from stereo_sfm.export.floor_plan import make_floor_plan, write_floor_plan
    from stereo_sfm.export.keep_out import read_zones, write_zones
    from stereo_sfm.export.shelf_fronts import shelf_fronts
    from stereo_sfm.maps.store import load_current, lock_about, read_about, write_about

    _check_store(store)
    with lock_about(store):
        saved = load_current(store)
        about = read_about(store, saved)
        write_about(store, about)  # the frame of the drawing
        plan = make_floor_plan(saved.snapshot, resolution, about.map_T_floor)
        zones = read_zones(store, plan)
        write_floor_plan(plan, store / PLAN)
        write_zones(store, plan, zones)
        fronts = shelf_fronts(plan, about.aisles)
        doors = plan_doors(plan, about.doors)
        _write_rows(
            store / FRONTS,
            [{"label": f.label, "start": list(f.start), "end": list(f.end), "faces": list(f.faces)} for f in fronts],
        )
        _write_rows(
            store / DOORS,
            [
                {"label": d.door.name, "start": list(d.door.start), "end": list(d.door.end)}
                | {"width": round(d.door.length, 3), "seen_open": d.seen_open}
                for d in doors
            ],
        )
    square = float(zones.sum()) * resolution**2
    print(
        f"{store / PLAN}, {len(fronts)} shelf fronts in {FRONTS}, {len(doors)} doors in {DOORS},"
        f" {square:.1f} m2 of keep-out zones in keepout.png"
    )
    return 0


def _write_rows(path: Path, rows: Sequence[Mapping[str, object]]) -> None:
    import yaml

    path.write_text(yaml.safe_dump([dict(row) for row in rows], sort_keys=False, allow_unicode=True), encoding="utf-8")


def _check_store(store: Path) -> None:
    if not (store / "map.json").is_file():
        raise StereoSfmError(f"no map at {store}: 'stereo-sfm map update {store} SESSION' begins one")
