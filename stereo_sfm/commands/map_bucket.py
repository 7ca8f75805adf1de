"""The actions of `stereo-sfm map` on a store in a bucket."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from stereo_sfm.commands import map_store
from stereo_sfm.commands._options import load_config, typed
from stereo_sfm.config import Config
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.storage.remote import Remote


def run(store: Remote, args: argparse.Namespace) -> int:
    """Run the chosen action."""
    if args.action == "update":
        return _update(store, args.walks, load_config(args))
    if args.action == "undo":
        from stereo_sfm.fleet.versions import roll_back

        print(f"{store} is version {roll_back(store).number} again")
        return 0
    if args.action == "versions":
        return _versions(store)
    if args.action == "release":
        from stereo_sfm.fleet.versions import release

        release(store, args.version, tuple(args.robots))
        print(f"{store}: version {args.version} is for {', '.join(args.robots) or 'all robots'}")
        return 0
    if args.action == "fetch":
        return _fetch(store, args.folder, args.robot)
    from stereo_sfm.fleet.editing import checked_out

    with checked_out(store) as out:
        if args.action == "plan":
            map_store.plan(out.folder, args.resolution)
        else:
            map_store.label(typed(map_store.LabelOptions, args), out.folder)
        made = out.publish({}, ["the plan" if args.action == "plan" else f"label {args.name}"])
    print(f"{store} version {made.number}")
    return 0


def _update(store: Remote, walks: list[str], config: Config) -> int:
    from stereo_sfm.fleet.editing import checked_out, session_id
    from stereo_sfm.maps.put_session import put_session

    for name in walks:
        session = map_store.mapped(name, config)
        identity = session_id(session)
        with checked_out(store, begin=True) as out:
            held = out.holds(identity)
            if held:
                raise StereoSfmError(f"{name} is not put into {store}: {held}")
            put = put_session(out.folder, session, name, config, compress=False)
            made = out.publish({identity: Path(name).name}, put.changes or ["the first session"])
        print(f"{store} version {made.number}: {put.text.partition(': ')[2] or put.text}")
        print("".join(f"  {line}\n" for line in put.changes), end="")
    return 0


def _versions(store: Remote) -> int:
    from stereo_sfm.fleet.versions import history

    for version in reversed(history(store)):
        stored = sum(file.patched or file.stored for file in version.files.values())
        print(f"version {version.number}: {len(version.sessions)} sessions, {stored / 1e6:.2f} MB to fetch after")
        print("".join(f"  {line}\n" for line in version.changes), end="")
    return 0


def _fetch(store: Remote, folder: Path, robot: str) -> int:
    """Without a network, the version that the folder has is kept and the exit code is 0."""
    from stereo_sfm.fleet.copies import fetch_version, version_of
    from stereo_sfm.fleet.versions import released
    from stereo_sfm.storage.objects import Unreachable

    try:
        found = fetch_version(store, released(store, robot), folder)
    except Unreachable as error:
        kept = version_of(folder, store)[1]
        if not kept:
            raise
        print(f"warning: {error}: {folder} stays version {kept}", file=sys.stderr)
        return 0
    print(f"{folder} is version {found.version} of {store}: {found.received / 1e6:.2f} MB fetched")
    return 0
