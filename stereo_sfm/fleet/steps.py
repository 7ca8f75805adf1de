"""The steps of a night, each of which may be repeated: what is done already is found, not done twice.

A walk becomes a session's map and a result, under a name that depends on its bytes, its configuration and the version
of the program. A night's sessions become one version of the store's map: the exchange of the store's head is the only
moment at which anything counts, so a worker that is killed before has changed nothing.
"""

from __future__ import annotations

import itertools
import json
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from stereo_sfm.config import Config
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.eval.stats_file import checked_stats
from stereo_sfm.fleet.catalogue import night_tables, walk_row, write_tables
from stereo_sfm.fleet.editing import Checkout, checked_out, session_id
from stereo_sfm.fleet.plan import Walk
from stereo_sfm.fleet.versions import Version, history
from stereo_sfm.fleet.work_folder import work_folder
from stereo_sfm.input_file import read_json as read_file
from stereo_sfm.jobs import Result
from stereo_sfm.log.reader import LogReader
from stereo_sfm.storage import objects
from stereo_sfm.storage.folders import SUMS, fetch_into, send_folder
from stereo_sfm.storage.remote import Remote

RESULT = "result.json"
WRITERS = 10  # tries to write a version while others do


class Damaged(StereoSfmError):
    """What an earlier step made is not there any more."""


class Outcome(NamedTuple):
    """What a night made of a walk."""

    why: str  # it is not in the map, "" if it is
    session: str  # checksum of its map
    again: bool = False  # it is tried again next time


def map_walk(root: Remote, walk: Walk, config: Config) -> Result:
    """A session's own map in the bucket, and the numbers of its run.

    A failure is kept as well where it is one of the bytes, which fail again: not that of the network, of a limit, of an
    error of ours, nor of a source that the plan names itself.
    """
    place = root / walk.store / "work" / walk.key(config)
    done = read_json(place / RESULT)
    if done is not None:
        return {**done, "resumed": True}
    begin = time.perf_counter()
    with work_folder() as folder:
        result = _mapped(walk, config, folder)
        if result["ok"]:
            result["session_bytes"] = send_folder(Path(result.pop("map")), place / "map")
            result["session"] = str(place / "map")
    result["cost_s"] = time.perf_counter() - begin
    if result.setdefault("lasting", True):
        objects.write(place / RESULT, json.dumps(result, default=str).encode())
    return result


def _mapped(walk: Walk, config: Config, folder: Path) -> Result:
    """Of a map: itself, once its checksums are right. Of a source: that of a run."""
    from stereo_sfm.eval.batch import BatchTask, run_one
    from stereo_sfm.maps.saved_map import load_map, save_map

    source = walk.source
    try:
        if walk.state and not source.endswith(".mcap"):
            here = folder / "walk"
            fetch_into(Remote.of(source), here)
            made = next((p for p in (here, here / "map") if (p / "map.json").is_file()), None)
            if made is not None:
                session = load_map(made)
                save_map(session, folder / "map", compress=False)
                about = _about(session, session_id(session))
                return about | {"ok": True, "map": str(folder / "map"), "stats": _stats_of(here)}
            source = str(here)
        elif walk.state:
            with LogReader(Remote.of(source)) as reader:
                if reader.truncated:
                    return {"ok": False, "error": f"it is cut off ({reader.truncated}): send it again"}
    except StereoSfmError as error:
        return {"ok": False, "error": str(error), "lasting": not isinstance(error, objects.Unreachable)}
    result = run_one(BatchTask(source, str(folder / "run"), config, True))
    if not result["ok"]:
        ours = result.get("kind") in (None, objects.Unreachable.__name__)
        return {"ok": False, "error": result["error"], "lasting": bool(walk.state) and not ours}
    try:
        session = load_map(folder / "run" / "map")
    except StereoSfmError:
        return {"ok": False, "error": "nothing was mapped: tracking failed", "stats": result["stats"]}
    save_map(session, folder / "map", compress=False)
    about = _about(session, session_id(session))
    return about | {"ok": True, "map": str(folder / "map"), "stats": result["stats"]}


def _stats_of(run: Path) -> dict[str, Any] | None:
    """The numbers of the run whose folder a robot has sent; None where it has sent its map alone."""
    try:
        return checked_stats(read_file(run / "stats.json"))
    except (OSError, ValueError):
        return None


def _about(session: Any, identity: str) -> dict[str, Any]:
    """What the catalogue says of a session, from its map."""
    camera = session.cameras[session.session_ids[-1]]
    return {
        "id": identity,
        "keyframes": len(session),
        "camera": camera.calibrated.serial,
        "terms": camera.terms.tolist(),
    }


def read_json(remote: Remote) -> dict[str, Any] | None:
    """The content of a small object; None where there is none, or a damaged one, which is made again."""
    try:
        data = json.loads(objects.read(remote))
    except (objects.Missing, ValueError):
        return None
    return data if isinstance(data, dict) else None


def update_store(root: Remote, walks: list[Walk], config: Config, results: Mapping[str, Result]) -> Result:
    """One night of one store: its sessions into the map, plan and shelves, and the tables of the catalogue.

    Args:
        root: of all stores. walks: of this night, by name. config: of all.
        results: of `map_walk`, by the name of its job; others are of earlier nights, which are only waited for.
    """
    store, night = walks[0].store, walks[0].night
    marker = root / store / "catalogue" / f"{night}.json"
    mine = {walk: results[job_name(walk)] for walk in walks}
    wanted = {walk.name: walk.key(config) for walk in walks}
    done = read_json(marker)
    before: dict[str, Any] = done["rows"] if done is not None else {}
    if done is not None and all(done["walks"].get(name) == key for name, key in wanted.items()):
        return {"ok": True, "version": done["version"], "failed": done["failed"], "resumed": True}
    begin = time.perf_counter()
    place = root / store / "map"
    outcomes, version = _put_all(place, mine, config)
    lasting = all(result.get("lasting") and not outcomes[walk].again for walk, result in mine.items())
    failed = {walk.name: outcome.why for walk, outcome in outcomes.items() if outcome.why}
    # Walks whose recordings were deleted since keep their rows.
    rows = before | {walk.name: walk_row(walk, mine[walk], o.why, o.session) for walk, o in outcomes.items()}
    versions = history(place) if version is not None else []
    tables = night_tables(store, night, [rows[k] for k in sorted(rows)], versions, time.perf_counter() - begin)
    write_tables(root / store / "catalogue", night, tables)
    result = {"version": version.number if version else 0, "failed": failed}
    if lasting:
        known = done["walks"] if done is not None else {}
        objects.write(marker, json.dumps({**result, "walks": known | wanted, "rows": rows}).encode())
    return {"ok": True, **result}


def job_name(walk: Walk) -> str:
    """Of the job that maps a walk."""
    return f"{walk.store} {walk.night} {walk.name}"


Outcomes = dict[Walk, Outcome]


def _put_all(place: Remote, mine: Mapping[Walk, Result], config: Config) -> tuple[Outcomes, Version | None]:
    """The sessions of a night put into the version that counts, as one new version; None: the store has none.

    Where another program is faster, they are put into its version.
    """
    for attempt in itertools.count(1):
        try:
            return _put_once(place, mine, config)
        except objects.Changed:
            if attempt == WRITERS:
                raise
    raise AssertionError  # the count does not end


def _put_once(place: Remote, mine: Mapping[Walk, Result], config: Config) -> tuple[Outcomes, Version | None]:
    """Raises Changed if another program was faster."""
    from stereo_sfm.export.store_plan import write_store_plan

    outcomes: Outcomes = {}
    with checked_out(place, begin=True) as out:
        sessions: dict[str, str] = {}
        changes: list[str] = []
        for walk, result in mine.items():
            identity = str(result.get("id", ""))
            outcomes[walk] = Outcome("" if result["ok"] else result["error"].strip().splitlines()[-1], identity)
            if not result["ok"] or identity in sessions:
                continue
            held = out.holds(identity)
            if held:
                outcomes[walk] = Outcome("" if "already" in held else held, identity)
                continue
            try:
                changes += _put(out, walk, result, config)
                sessions[identity] = f"{walk.night} {walk.name}"
            except (objects.Unreachable, TimeoutError, MemoryError):
                raise
            except Exception as error:  # one walk stops no night
                why = str(error).strip().partition("\n")[0] or type(error).__name__
                again = isinstance(error, Damaged) or not isinstance(error, StereoSfmError)
                outcomes[walk] = Outcome(why, identity, again)
        if not sessions:
            return outcomes, out.version
        try:
            write_store_plan(out.folder)
        except StereoSfmError as error:
            changes.append(f"no floor plan: {error}")
        return outcomes, out.publish(sessions, changes)


def _put(out: Checkout, walk: Walk, result: Result, config: Config) -> list[str]:
    from stereo_sfm.maps.put_session import put_session
    from stereo_sfm.maps.saved_map import load_map

    made = Remote.of(result["session"])
    with work_folder() as folder:
        try:
            fetch_into(made, folder / "map")
            session = load_map(folder / "map")
            if session_id(session) != result["id"]:
                raise StereoSfmError(f"{made} is not what was made")
        except objects.Unreachable:
            raise
        except StereoSfmError as error:
            objects.delete([made.parent / RESULT, made / SUMS])
            raise Damaged(f"{error}: it is made again next time") from None
    return put_session(out.folder, session, walk.name, config, compress=False).changes
