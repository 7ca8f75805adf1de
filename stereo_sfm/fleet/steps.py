"""The steps of a night, each of which may be repeated: what is done already is found, not done twice.

A walk becomes a session's map and a result, under a name that depends on its bytes alone. A night's sessions become one
version of the store's map: the exchange of the store's head is the only moment at which anything counts, so a worker
that is killed before has changed nothing.
"""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import stereo_sfm
from stereo_sfm.config import Config, dump
from stereo_sfm.errors import Hindered, StereoSfmError
from stereo_sfm.eval.stats_file import checked_stats
from stereo_sfm.fleet.catalogue import night_tables, walk_row, write_tables
from stereo_sfm.fleet.editing import Checkout, checked_out, session_id
from stereo_sfm.fleet.plan import Walk
from stereo_sfm.fleet.versions import Version, history, read_head
from stereo_sfm.fleet.work_folder import work_folder
from stereo_sfm.input_file import read_json as read_file
from stereo_sfm.jobs import Result
from stereo_sfm.log.provenance import METADATA
from stereo_sfm.log.reader import LogReader
from stereo_sfm.storage import objects
from stereo_sfm.storage.folders import SUMS, fetch_into, send_folder
from stereo_sfm.storage.remote import Remote

RESULT, BEGUN = "result.json", "begun"
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

    A map counts for good: a walk that another program, or one with another configuration, has mapped is not mapped
    again. A failure is kept as well, for this program and configuration, where it is one of the bytes, which fail
    again: not that of a right, of the network, of a limit, of an error of ours, nor of a source that the plan names.
    """
    place = root / walk.store / "work" / walk.key
    by = hashlib.sha256(json.dumps([stereo_sfm.__version__, dump(config)]).encode()).hexdigest()[:16]
    done = read_json(place / RESULT)
    if done is not None and (done.get("ok") or done.get("by") == by):
        return {**done, "resumed": True}
    objects.create(place / BEGUN, b"begun\n")  # keeps the day of the first try
    begin = processor_s()
    with work_folder() as folder:
        result = _mapped(walk, config, folder)
        if result["ok"]:
            result["session_bytes"] = send_folder(Path(result.pop("map")), place / "map")
            result["session"] = str(place / "map")
    about = {"by": by, "cost_s": processor_s() - begin, "health": _health(result.get("stats"))}
    result = {"software": f"stereo-sfm {stereo_sfm.__version__}", **result, **about}
    if result.setdefault("lasting", True):
        objects.write(place / RESULT, json.dumps(result, default=str).encode())
    return result


def processor_s() -> float:
    """Seconds of processor time that this process and its children have had."""
    return sum(os.times()[:4])


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
                about = _about(session, session_id(session)) | {"software": _software_of(here)}
                return about | {"ok": True, "map": str(folder / "map"), "stats": _stats_of(here)}
            source = str(here)
        elif walk.state:
            with LogReader(Remote.of(source)) as reader:
                if reader.truncated:
                    return {"ok": False, "error": f"it is cut off ({reader.truncated}): send it again"}
    except StereoSfmError as error:
        lasting = not isinstance(error, Hindered | objects.Missing)
        return {"ok": False, "error": str(error), "lasting": lasting}
    result = run_one(BatchTask(source, str(folder / "run"), config, True))
    if not result["ok"]:
        lasting = bool(walk.state) and not result.get("hindered", True)  # of an error of ours nothing is said
        return {"ok": False, "error": result["error"], "lasting": lasting}
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


def _software_of(run: Path) -> str | None:
    """Which program made the run whose folder a robot has sent; None where it has sent its map alone."""
    try:
        with LogReader(run / "run.mcap") as reader:
            version = reader.metadata(METADATA).get("version")
    except (OSError, StereoSfmError):
        return None
    return f"stereo-sfm {version}" if version else None


def _health(stats: dict[str, Any] | None) -> str | None:
    """What the report of a run warns of, "" if it is well; None where its numbers are not known."""
    if stats is None:
        return None
    from stereo_sfm.eval.report import verdicts

    try:
        said = verdicts(stats, {})
    except (LookupError, TypeError, ValueError, AttributeError):  # of another version of the program
        return None
    return "; ".join(line.partition(": ")[2] or line for line in said if not line.startswith("**PASS**"))


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
    night = Night.read(root, walks[0].store, walks[0].night)
    results = {walk.name: results[job_name(walk)] for walk in walks}
    mine = {walk: results[walk.name] for walk in walks if not night.knows(walk, results[walk.name])}
    if mine:
        begin = processor_s()
        outcomes, made = _put_all(root / night.store / "map", mine, config)
        cost_s = processor_s() - begin
        for walk, outcome in outcomes.items():
            night.add(walk, mine[walk], outcome, cost_s / len(mine))
        if made is not None:
            night.version = made.number
            night.costs[str(made.number)] = cost_s
        night.write()
    failed = {walk.name: night.rows[walk.name]["why"] for walk in walks if night.rows[walk.name]["why"]}
    return {"ok": True, "version": night.version, "failed": failed} | ({} if mine else {"resumed": True})


@dataclass
class Night:
    """What is known of a night of a store: the rows of its walks, and which of them need nothing more."""

    root: Remote
    store: str
    night: str
    version: int = 0  # the last one that it made
    rows: dict[str, dict[str, Any]] = field(default_factory=dict)  # of the catalogue, by walk
    settled: dict[str, list[str]] = field(default_factory=dict)  # walk -> its key, and what was made of it
    costs: dict[str, float] = field(default_factory=dict)  # version -> seconds of processor time

    @staticmethod
    def read(root: Remote, store: str, night: str) -> Night:
        """An empty one where nothing is known."""
        out = Night(root, store, night)
        data = read_json(out._place) or {}
        names = ("version", "rows", "settled", "costs")
        return dataclasses.replace(out, **{name: data[name] for name in names if name in data})

    @property
    def _place(self) -> Remote:
        return self.root / self.store / "catalogue" / f"{self.night}.json"

    def is_settled(self, walk: Walk) -> bool:
        """Whether these bytes are in the map, or never will be."""
        return self.settled.get(walk.name, [""])[0] == walk.key

    def knows(self, walk: Walk, result: Result) -> bool:
        """Whether nothing more is to be done: a map was put in, or refused, or the same failure is known already."""
        tried = self.is_settled(walk) and bool(self.rows[walk.name]["session"])
        return tried or self.settled.get(walk.name) == _made(walk, result)

    def add(self, walk: Walk, result: Result, outcome: Outcome, cost_s: float) -> None:
        """A walk that was tried. Args: cost_s, processor time of putting it into the map."""
        self.rows[walk.name] = walk_row(walk, result, outcome.why, outcome.session, cost_s)
        self.settled.pop(walk.name, None)
        if result.get("lasting") and not outcome.again:
            self.settled[walk.name] = _made(walk, result)

    def give_up(self, walk: Walk, days: int) -> None:
        """Say of a walk that its recording was deleted after so many days, and it is in no map."""
        row = self.rows.setdefault(walk.name, walk_row(walk, {}, "", ""))
        said = f"its recording was deleted after {days} days"
        if said not in row["why"]:
            row |= {"ok": False, "why": f"{row['why']}; {said}" if row["why"] else said}
            self.write()

    def write(self) -> None:
        """The tables of the catalogue, and what is known. Walks whose recordings were deleted since keep their rows."""
        place = self.root / self.store
        versions = history(place / "map") if read_head(place / "map").version else []
        rows = [self.rows[name] for name in sorted(self.rows)]
        write_tables(place / "catalogue", self.night, night_tables(self.store, self.night, rows, versions, self.costs))
        kept = {"version": self.version, "rows": self.rows, "settled": self.settled, "costs": self.costs}
        objects.write(self._place, json.dumps(kept).encode())


def _made(walk: Walk, result: Result) -> list[str]:
    """The key of a walk and the session, or the failure, that is known of it."""
    return [walk.key, str(result.get("id") or result.get("by"))]


def job_name(walk: Walk) -> str:
    """Of the job that maps a walk."""
    return f"{walk.store} {walk.night} {walk.name}"


Outcomes = dict[Walk, Outcome]


def _put_all(place: Remote, mine: Mapping[Walk, Result], config: Config) -> tuple[Outcomes, Version | None]:
    """The sessions of a night put into the version that counts, as one new version; None: there was nothing to put.

    Where another program is faster, they are put into its version.
    """
    good = {walk: result for walk, result in mine.items() if result["ok"]}
    whys = {walk: str(result["error"]) for walk, result in mine.items() if not result["ok"]}
    failed = {walk: Outcome(why.strip().splitlines()[-1], "") for walk, why in whys.items()}
    if not good:
        return failed, None
    for attempt in itertools.count(1):
        try:
            outcomes, made = _put_once(place, good, config)
            return failed | outcomes, made
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
            identity = str(result["id"])
            outcomes[walk] = Outcome("", identity)
            if identity in sessions:
                continue
            held = out.holds(identity)
            if held:
                outcomes[walk] = Outcome("" if "already" in held else held, identity)
                continue
            try:
                changes += _put(out, walk, result, config)
                sessions[identity] = f"{walk.night} {walk.name}"
            except (Hindered, TimeoutError, MemoryError):
                raise
            except Exception as error:  # one walk stops no night
                why = str(error).strip().partition("\n")[0] or type(error).__name__
                again = isinstance(error, Damaged) or not isinstance(error, StereoSfmError)
                outcomes[walk] = Outcome(why, identity, again)
        if not sessions:
            return outcomes, None
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
        except Hindered:
            raise
        except StereoSfmError as error:
            objects.delete([made.parent / RESULT, made / SUMS])
            raise Damaged(f"{error}: it is made again next time") from None
    return put_session(out.folder, session, walk.name, config, compress=False).changes
