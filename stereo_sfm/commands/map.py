"""`stereo-sfm map`: describe, merge, prune, update and export saved maps."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING

from stereo_sfm.commands._options import typed
from stereo_sfm.storage.remote import InputPath

if TYPE_CHECKING:
    from stereo_sfm.loop.vocabulary import Vocabulary
    from stereo_sfm.maps.saved_map import SavedMap


MOST_POINTS = (1, 99)  # percentiles along each axis: a few points are far off


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this command."""
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
    info = actions.add_parser("info", help="describe a map")
    info.add_argument("map", type=InputPath, help="map folder")
    merge = actions.add_parser("merge", help="merge the maps of several sessions in one store")
    merge.add_argument(
        "maps", type=InputPath, nargs="+", metavar="MAP", help="map folders; the result is in the frame of the first"
    )
    _output(merge)
    merge.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="set a configuration value, as in 'run'"
    )
    prune = actions.add_parser("prune", help="remove points that are no longer there")
    prune.add_argument("map", type=InputPath, help="map folder")
    _output(prune)
    prune.add_argument(
        "--min-views", type=int, default=0, metavar="N", help="remove points seen by fewer than N keyframes"
    )
    prune.add_argument(
        "--min-seen-share",
        type=float,
        default=0.0,
        metavar="X",
        help="remove points seen in less than this share of the keyframes that had them in view",
    )
    prune.add_argument(
        "--unseen-sessions", type=int, default=0, metavar="N", help="remove points not seen in the newest N sessions"
    )
    from stereo_sfm.commands import export, map_store

    map_store.add_arguments(actions.add_parser)
    export.add_arguments(actions.add_parser("export", help="export a map to the formats of other programs"))


def _output(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="folder for the new map")
    parser.add_argument("--overwrite", action="store_true", help="replace an existing map")


@dataclass(frozen=True)
class MergeOptions:
    """Options of `map merge`, as the parser names them."""

    maps: list[Path]
    output: Path
    overwrite: bool
    set: list[str]


@dataclass(frozen=True)
class PruneOptions:
    """Options of `map prune`, as the parser names them."""

    map: Path
    output: Path
    overwrite: bool
    min_views: int
    min_seen_share: float
    unseen_sessions: int


def run(args: argparse.Namespace) -> int:
    """Run the chosen action."""
    if args.action == "export":
        from stereo_sfm.commands import export

        return export.run(args)
    from stereo_sfm.commands import map_store

    if args.action in map_store.ACTIONS:
        return map_store.run(args)
    if args.action == "info":
        return _info(args.map)
    return _merge(typed(MergeOptions, args)) if args.action == "merge" else _prune(typed(PruneOptions, args))


def _info(folder: Path) -> int:
    from stereo_sfm.maps.saved_map import load_map

    own = folder / "map"  # of a run
    print("\n".join(describe(load_map(own if (own / "map.json").is_file() else folder))))
    return 0


def describe(saved: SavedMap) -> list[str]:
    """The content of a map as text."""
    import numpy as np

    s = saved.snapshot
    views = np.bincount(s.obs_pt, minlength=len(s.pt_ids))
    steps = np.linalg.norm(np.diff(s.map_T_kf[:, :3, 3], axis=0), axis=1)
    extent = np.ptp(np.percentile(s.points, MOST_POINTS, axis=0), axis=0)
    rig = saved.rig
    return [
        f"{len(s.kf_ids)} keyframes, {len(s.pt_ids)} points, {len(s.obs_kf)} observations"
        f" ({views.mean():.1f} per point)",
        f"{len(s.corner_kf)} corners for place recognition in {len(np.unique(s.corner_kf))} keyframes",
        f"{int(saved.sessions.max()) + 1} session(s), {len(np.unique(s.submap_ids))} submap(s),"
        f" {float(steps[s.submap_ids[1:] == s.submap_ids[:-1]].sum()):.1f} m of path along the keyframes",
        f"98 % of the points extend {extent[0]:.1f} m along x (right), {extent[1]:.1f} m along y (down),"
        f" {extent[2]:.1f} m along z (forward), as the first camera stood",
        f"camera {rig.left.model} {rig.left.width}x{rig.left.height}, baseline {1000 * rig.baseline:.1f} mm",
        f"vocabulary {saved.vocabulary_id}",
    ]


def _merge(options: MergeOptions) -> int:
    from stereo_sfm import config as configuration
    from stereo_sfm.errors import StereoSfmError
    from stereo_sfm.maps.merge import merge, share_a_session
    from stereo_sfm.maps.saved_map import load_map, save_map
    from stereo_sfm.maps.store import lock_versioned

    if len(options.maps) < 2:
        raise StereoSfmError("merge takes at least two maps")
    _check_free(options.output, options.overwrite)
    config = configuration.load(None, options.set)
    with lock_versioned(options.output):
        maps = [load_map(folder) for folder in options.maps]
        for (name_a, a), (name_b, b) in combinations(zip(options.maps, maps, strict=True), 2):
            if share_a_session(a, b):
                raise StereoSfmError(
                    f"{name_a} and {name_b} contain the same session: merge takes maps of different sessions"
                )
        result = merge(maps, _vocabulary(maps[0], config.loop.vocabulary), config.loop, config.mapper)
        save_map(result.saved, options.output)
    print(f"{len(maps)} maps joined by {len(result.loops)} loops, {result.fused} points seen in more than one session")
    print("\n".join(describe(result.saved)))
    return 0


def _vocabulary(saved: SavedMap, named: str) -> Vocabulary:
    """The vocabulary to compare maps with: any can be used, since maps keep their descriptors."""
    from stereo_sfm.loop.vocabulary_file import default_vocabulary, load_vocabulary

    return load_vocabulary(Path(named)) if named else default_vocabulary()


def _prune(options: PruneOptions) -> int:
    from stereo_sfm.maps.merge import prune
    from stereo_sfm.maps.saved_map import load_map, save_map
    from stereo_sfm.maps.store import lock_versioned

    _check_free(options.output, options.overwrite)
    with lock_versioned(options.output):
        saved = load_map(options.map)
        pruned = prune(saved, options.min_views, options.min_seen_share, options.unseen_sessions)
        save_map(pruned, options.output)
    before, after = saved.snapshot, pruned.snapshot
    counts = f"{len(before.pt_ids)} -> {len(after.pt_ids)} points, {len(saved)} -> {len(pruned)} keyframes"
    print(f"{counts}: {options.output}")
    return 0


def _check_free(output: Path, overwrite: bool) -> None:
    from stereo_sfm.errors import StereoSfmError
    from stereo_sfm.export.run_folder import is_free

    if (output / "map.json").exists():
        if not overwrite:
            raise StereoSfmError(f"{output} holds a map: choose another -o or give --overwrite")
    elif not is_free(output):
        raise StereoSfmError(f"{output} exists and is not a map: choose another -o")
