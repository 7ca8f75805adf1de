"""`stereo-sfm batch`: run many recordings, on this machine or on a Ray cluster, and merge their maps."""

from __future__ import annotations

import argparse
import fnmatch
import glob
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from stereo_sfm.commands._cluster import on_cluster
from stereo_sfm.errors import StereoSfmError

if TYPE_CHECKING:
    from stereo_sfm.storage.remote import Remote

SOME_FAILED = 3


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this command."""
    from stereo_sfm.commands._options import add_config_arguments

    parser.add_argument("recordings", nargs="+", help="files, folders, sim:SCENE, or quoted patterns")
    parser.add_argument(
        "-o", "--output", type=Path, required=True, help="folder for all results; an existing batch is continued"
    )
    parser.add_argument("--address", help="address of a Ray cluster (default: this machine)")
    parser.add_argument("--memory-gb", type=float, default=0.0, metavar="N", help="most memory of a run (default: any)")
    parser.add_argument("--minutes", type=float, default=0.0, metavar="N", help="longest time of a run (default: any)")
    parser.add_argument("--no-merge", action="store_true", help="do not merge the maps of the recordings")
    add_config_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Run all, write the table, merge the maps. A failed recording does not stop the others."""
    from stereo_sfm.commands._options import load_config
    from stereo_sfm.eval import batch
    from stereo_sfm.jobs import Limits

    config = load_config(args)
    limits = Limits(memory_gb=args.memory_gb, minutes=args.minutes)
    recordings = _expand(args.recordings)
    args.output.mkdir(parents=True, exist_ok=True)
    names = batch.names(recordings)
    merging = not args.no_merge and config.mapper.enabled
    folders = [args.output.resolve() / name for name in names]
    tasks = [
        batch.BatchTask(spec, str(folder), config, merging) for spec, folder in zip(recordings, folders, strict=True)
    ]
    results = {}
    for task, result in on_cluster(batch.run_batch(tasks, args.address, limits), args.address):
        results[task.folder] = result
        state = "failed" if batch.why_failed(result) else "ok"
        again = ", from before" if result.get("resumed") else ""
        print(f"{len(results)}/{len(tasks)} {Path(task.folder).name}: {state}{again}", file=sys.stderr)
        rows = [batch.table_row(n, results[str(f)]) for n, f in zip(names, folders, strict=True) if str(f) in results]
        batch.write_results(rows, args.output)
    print((args.output / "results.md").read_text("utf-8-sig"), end="")
    good = [folder for folder in folders if not batch.why_failed(results[str(folder)])]
    maps = [folder / "map" for folder in good if (folder / "map" / "map.json").exists()]
    if merging and len(maps) > 1:
        print(batch.merge_maps(maps, config, args.output / batch.MAP))
    return SOME_FAILED if len(good) < len(folders) else 0


def _expand(patterns: list[str]) -> list[str]:
    """Expand patterns as a shell does; paths become absolute for other nodes.

    Raises:
        StereoSfmError: an address is none, or has credentials in it, which would stand in every result.
    """
    from stereo_sfm.storage.remote import Remote, is_uri, place

    out: list[str] = []
    for pattern in patterns:
        head, mark, query = pattern.partition("?")
        if is_uri(behind := head.partition(":")[2]):  # a kind of source stands before it
            place(behind)
        elif is_uri(head):
            address = place(head)
            if isinstance(address, Remote):
                out += [name + mark + query for name in _in_bucket(address)]
                continue
            pattern = f"{address}{mark}{query}"
        found = sorted(glob.glob(pattern))
        if not found and any(c in pattern for c in "*[") and not pattern.startswith("sim:"):
            raise StereoSfmError(f"no recording matches {pattern}: check the folder and the pattern")
        out += [str(Path(f).resolve()) for f in found] or [pattern]
    return out


def _in_bucket(pattern: Remote) -> list[str]:
    """The objects that a pattern in the last part of an address means; an address without one as it is."""
    from stereo_sfm.storage import objects

    if not any(c in pattern.name for c in "*["):
        return [str(pattern)]
    names = [name for name, _, _ in objects.listed(pattern.parent) if fnmatch.fnmatchcase(name, pattern.name)]
    if not names:
        raise StereoSfmError(f"no recording matches {pattern}")
    return [str(pattern.parent / name) for name in names]
