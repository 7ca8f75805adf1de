"""`stereo-sfm fleet`: the nights of many stores and robots, in a bucket and on a Ray cluster."""

from __future__ import annotations

import argparse
import datetime
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from stereo_sfm.commands._cluster import on_cluster
from stereo_sfm.errors import StereoSfmError

if TYPE_CHECKING:
    from stereo_sfm.fleet.plan import Plan

SOME_FAILED = 3


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this command."""
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
    run = actions.add_parser("run", help="map all walks of a plan that have arrived, and update their stores")
    run.add_argument("plan", type=Path, nargs="?", metavar="PLAN.toml", help="places, limits, walks")
    run.add_argument("--address", help="address of a Ray cluster (default: this machine)")
    run.add_argument("--print-plan", action="store_true", help="print every setting of a plan, and run nothing")
    report = actions.add_parser("report", help="print how stores and robots are, and write a page")
    report.add_argument("plan", type=Path, metavar="PLAN.toml", help="as of 'run'")
    report.add_argument("-o", "--output", type=Path, default=Path("fleet"), metavar="DIR", help="folder of the page")
    report.add_argument("--sql", metavar="QUERY", help="ask the tables walks, sessions, versions and changes; no page")
    upload = actions.add_parser("upload", help="send a recording, or the recordings of a service's folder, to a bucket")
    upload.add_argument("path", type=Path, metavar="PATH", help="a file, or a folder of recordings")
    upload.add_argument("to", metavar="ADDRESS", help="of the object, or of the folder that recordings go to")
    upload.add_argument("--mbit", type=float, default=0.0, metavar="N", help="most megabits a second (default: any)")


def run(args: argparse.Namespace) -> int:
    """Run the chosen action."""
    if args.action == "upload":
        return _upload(args.path, args.to, args.mbit)
    from stereo_sfm.fleet.plan import Plan, explain, load_plan

    if args.action == "run" and args.print_plan:
        print(explain(Plan() if args.plan is None else load_plan(args.plan)), end="")
        return 0
    if args.plan is None:
        raise StereoSfmError("fleet run needs a plan: 'stereo-sfm fleet run --print-plan > PLAN.toml' begins one")
    plan = load_plan(args.plan)
    return _run(plan, args.address) if args.action == "run" else _report(plan, args.output, args.sql)


def _run(plan: Plan, address: str | None) -> int:
    """A walk or a night that failed does not stop the others; the exit code says that there is one."""
    from stereo_sfm.fleet.plan import find_walks
    from stereo_sfm.fleet.run import forget_images, forget_versions, run_plan

    walks, waiting = find_walks(plan)
    for place in waiting:
        print(f"no whole walk: {place}", file=sys.stderr)
    failed = again = count = 0
    for count, (job, result) in enumerate(on_cluster(run_plan(plan, address, walks), address) if walks else (), 1):
        why = [] if result["ok"] else [result["error"].strip().splitlines()[-1]]
        why += [f"{name}: {text}" for name, text in result.get("failed", {}).items()] if result["ok"] else []
        again += bool(result.get("resumed"))
        failed += bool(why)
        if not result.get("resumed"):
            version = f", version {result['version']}" if result.get("version") else ""
            print(f"{count} {job.name}: {'; '.join(why) or 'ok'}{version}", file=sys.stderr)
    found = [walk for walk in walks if not walk.error]
    stores = sorted({walk.store for walk in found})
    try:
        deleted = forget_images(plan, walks, datetime.date.today(), waiting)
    finally:  # neither stops the other
        forgotten = forget_versions(plan, stores)
    nights = len({(walk.store, walk.night) for walk in found})
    print(
        f"{len(found)} walks in {nights} nights of {len(stores)} stores:"
        f" {count - again} of {count} jobs done now, {failed} failed"
        + (f", {deleted / 1e9:.2f} GB of recordings deleted" if deleted else "")
        + (f", {forgotten / 1e9:.2f} GB of old versions deleted" if forgotten else "")
    )
    return SOME_FAILED if failed else 0


def _report(plan: Plan, folder: Path, query: str | None) -> int:
    from stereo_sfm.fleet.catalogue import ask, opened
    from stereo_sfm.fleet.plan import stores_of
    from stereo_sfm.fleet.report import report

    with opened(plan.root, stores_of(plan)) as connection:
        if query is not None:
            print("\n".join(ask(connection, query)))
            return 0
        lines, page = report(connection, folder)
    print("\n".join([*lines, f"written to {page}"]))
    return 0


def _upload(path: Path, to: str, mbit: float) -> int:
    from stereo_sfm.storage.folders import Pace, send_folder
    from stereo_sfm.storage.remote import Remote
    from stereo_sfm.storage.spool import Spool

    target, bytes_s = Remote.of(to), mbit * 1e6 / 8
    if path.is_file():
        spool = Spool.kept(path, target)
        _refuse_unfinished(path)
        spool.send(Pace(bytes_s))
        print(f"sent {path} to {target}")
        return 0
    if not path.is_dir():
        raise StereoSfmError(f"no such file or folder: {path}")
    from stereo_sfm.recording.segments import recordings
    from stereo_sfm.recording.upload import Uploader

    if recordings(path):
        count = Uploader(path, target, bytes_s).send_all()
        print(f"sent {count} files of {len(recordings(path))} recordings to {target}")
    else:
        _refuse_unfinished(*path.rglob("*.mcap"))
        print(f"sent {send_folder(path, target, Pace(bytes_s)) / 1e6:.1f} MB to {target}")
    return 0


def _refuse_unfinished(*files: Path) -> None:
    from stereo_sfm.log.whole_file import being_written

    for file in files:
        if being_written(file):
            raise StereoSfmError(f"{file} is being written: send it when it is whole")
