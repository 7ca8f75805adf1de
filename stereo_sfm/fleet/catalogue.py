"""The catalogue: a row for each walk, session, version of a map and change, as Parquet; DuckDB answers questions.

    ROOT/STORE/catalogue/walks-2026-11-25.parquet, sessions-..., versions-..., changes-...

A walk that was sent twice is one session. Costs are seconds of processor time: that of a walk is for all its steps,
with its part of the update; that of a version is the update's alone.

A night's files are written as a whole, so that writing them again doubles nothing.
"""

from __future__ import annotations

import csv
import io
import re
import tempfile
from collections.abc import Generator, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from stereo_sfm.calib.choice import SCALES
from stereo_sfm.errors import StereoSfmError, require
from stereo_sfm.fleet.editing import ROLLED_BACK
from stereo_sfm.fleet.plan import Walk
from stereo_sfm.fleet.versions import Version, read_head
from stereo_sfm.storage import objects
from stereo_sfm.storage.remote import Remote

# The terms of `calib.choice`, in its order and units.
TERMS = (
    "turned_x_deg", "turned_y_deg", "turned_z_deg", "baseline_y_deg", "baseline_z_deg", "focal_percent",
    "decentred_x_deg", "decentred_y_deg",
)  # fmt: skip
# column -> type of DuckDB and of pyarrow ("VARCHAR", "BIGINT", "DOUBLE", "BOOLEAN")
WALKS = {
    "store": "VARCHAR", "night": "VARCHAR", "robot": "VARCHAR", "walk": "VARCHAR", "ok": "BOOLEAN", "why": "VARCHAR",
    "session": "VARCHAR", "version": "BIGINT", "health": "VARCHAR", "camera": "VARCHAR",
    **dict.fromkeys(TERMS, "DOUBLE"), "keyframes": "BIGINT",
    "frames": "BIGINT", "seconds": "DOUBLE", "path_m": "DOUBLE", "lost_percent": "DOUBLE", "losses": "BIGINT",
    "loops": "BIGINT", "drift_percent": "DOUBLE", "result": "VARCHAR", "software": "VARCHAR", "cost_s": "DOUBLE",
    "bytes": "BIGINT",
}  # fmt: skip
VERSIONS = {
    "store": "VARCHAR", "night": "VARCHAR", "version": "BIGINT", "parent": "VARCHAR", "sessions": "BIGINT",
    "added": "BIGINT", "bytes": "BIGINT", "stored": "BIGINT", "delta": "BIGINT", "changes": "BIGINT",
    "software": "VARCHAR", "cost_s": "DOUBLE",
}  # fmt: skip
CHANGES = {"store": "VARCHAR", "night": "VARCHAR", "version": "BIGINT", "text": "VARCHAR"}
SESSIONS = {
    "store": "VARCHAR", "night": "VARCHAR", "session": "VARCHAR", "version": "BIGINT", "walk": "VARCHAR",
    "robot": "VARCHAR", "camera": "VARCHAR", "keyframes": "BIGINT", "software": "VARCHAR",
}  # fmt: skip
TABLES = {"walks": WALKS, "sessions": SESSIONS, "versions": VERSIONS, "changes": CHANGES}
NOTHING = "no shelf changed"
AT_ONCE = 16  # files of a catalogue that are fetched
_TABLE = re.compile(rf"(?:{'|'.join(TABLES)})-[^/]*\.parquet")

Rows = list[dict[str, Any]]


def night_tables(
    store: str, night: str, walks: Rows, versions: Sequence[Version], costs: Mapping[str, float]
) -> dict[str, Rows]:
    """The rows of a night by table.

    Args:
        store, night. walks: its rows of `walk_row`, which get the number of their version.
        versions: of the store, newest first. costs: processor time of the updates, by the number of their version.
    """
    by_name = {v.name: v for v in versions}
    added = {v.name: v.sessions.keys() - (by_name[v.parent].sessions.keys() if v.parent else ()) for v in versions}
    number = {session: v.number for v in versions for session in added[v.name]}
    walks = [{**row, "version": number.get(row["session"])} for row in walks]
    by_session = {row["session"]: row for row in walks[::-1]}
    put = {v.name: [s for s in added[v.name] if v.sessions[s].startswith(f"{night} ")] for v in versions}
    made = [v for v in versions if put[v.name]]
    return {
        "walks": walks,
        "sessions": [
            {
                "store": store, "night": night, "session": session, "version": v.number,
                **{name: by_session.get(session, {}).get(name) for name in list(SESSIONS)[4:]},
            }
            for v in made for session in sorted(put[v.name])
        ],
        "versions": [
            {
                "store": store, "night": night, "version": v.number, "parent": v.parent, "sessions": len(v.sessions),
                "added": len(added[v.name]), "bytes": sum(f.bytes for f in v.files.values()),
                "stored": sum(f.stored for f in v.files.values()), "delta": delta_bytes(v, by_name.get(v.parent)),
                "changes": sum(text != NOTHING for text in v.changes), "software": v.software,
                "cost_s": costs.get(str(v.number)),
            }
            for v in made
        ],
        "changes": [
            {"store": store, "night": night, "version": v.number, "text": text}
            for v in made for text in v.changes if text != NOTHING
        ],
    }  # fmt: skip


def delta_bytes(version: Version, parent: Version | None) -> int:
    """Bytes of files that a robot with the parent fetches."""
    known = {f.sha256 for f in parent.files.values()} if parent else set[str]()
    return sum(f.patched or f.stored for f in version.files.values() if f.sha256 not in known)


def walk_row(walk: Walk, result: Mapping[str, Any], why: str, session: str, cost_s: float = 0.0) -> dict[str, Any]:
    """A walk in the catalogue.

    Args:
        walk. result: of `steps.map_walk`. why: it is not in the map, "" if it is. session: checksum of its map.
        cost_s: processor time of putting it into the map.
    """
    stats = result.get("stats") or {}
    terms = (SCALES * np.array(result.get("terms") or [np.nan] * len(SCALES))).tolist()
    row = {
        "store": walk.store, "night": walk.night, "robot": walk.robot, "walk": walk.name, "ok": not why, "why": why,
        "session": session, "version": None, "health": result.get("health"), "camera": result.get("camera"),
        **dict(zip(TERMS, terms, strict=True)), "keyframes": result.get("keyframes"), "frames": stats.get("frames"),
        "seconds": stats.get("duration_s"), "path_m": stats.get("path_m"), "lost_percent": stats.get("lost_percent"),
        "losses": len(stats["lost_intervals"]) if stats else None, "loops": stats.get("loops_accepted"),
        "drift_percent": stats.get("closure_drift_percent_median"), "result": stats.get("fingerprint"),
        "software": result.get("software"), "cost_s": (result.get("cost_s") or 0.0) + cost_s, "bytes": walk.bytes,
    }  # fmt: skip
    return {name: _value(value) for name, value in row.items()}


def write_tables(place: Remote, night: str, tables: Mapping[str, Rows]) -> None:
    """Write a night's files; tables without rows as well, so that nothing of an earlier try stays.

    Rows of an earlier version of the program may lack columns.
    """
    require(("pyarrow",), "fleet", "the catalogue")
    import pyarrow
    from pyarrow import parquet

    types = {
        "VARCHAR": pyarrow.string(), "BIGINT": pyarrow.int64(), "DOUBLE": pyarrow.float64(),
        "BOOLEAN": pyarrow.bool_(),
    }  # fmt: skip
    for name, columns in TABLES.items():
        schema = pyarrow.schema([(column, types[kind]) for column, kind in columns.items()])
        rows = [{column: _value(row.get(column)) for column in columns} for row in tables[name]]
        buffer = io.BytesIO()
        parquet.write_table(pyarrow.Table.from_pylist(rows, schema), buffer)
        objects.write(place / f"{name}-{night}.parquet", buffer.getvalue())


def _value(value: Any) -> Any:
    """None for what is no number."""
    return None if isinstance(value, float) and not np.isfinite(value) else value


@contextmanager
def opened(root: Remote, stores: Iterable[str]) -> Generator[Any]:
    """A DuckDB connection with the tables of these stores. What was rolled back since is in no version there.

    Raises:
        StereoSfmError: there is no catalogue yet.
    """
    require(("duckdb",), "fleet", "the catalogue")
    import duckdb

    with tempfile.TemporaryDirectory(prefix="catalogue") as folder:
        refused: list[tuple[str, str]] = []
        paths: dict[Path, Remote] = {}
        for store in stores:
            place = root / store / "catalogue"
            names = [name for name, _, _ in objects.listed(place) if _TABLE.fullmatch(name)]
            if names:
                (Path(folder) / store).mkdir(parents=True)
                paths |= {Path(folder) / store / name: place / name for name in names}
                refused += [(store, session) for session in read_head(root / store / "map").refused]
        if not paths:
            raise StereoSfmError(f"there is no catalogue at {root}: 'stereo-sfm fleet run PLAN.toml' makes one")
        with ThreadPoolExecutor(AT_ONCE) as pool:
            list(pool.map(lambda path: path.write_bytes(objects.read(paths[path])), paths))
        with duckdb.connect() as connection:
            for table, columns in TABLES.items():
                names = ", ".join(f"{name} {kind}" for name, kind in columns.items())
                connection.execute(f"CREATE TABLE {table} ({names})")
                found = [str(path) for path in paths if path.name.startswith(f"{table}-")]
                if found:
                    # Tables of other versions may have fewer columns, or more.
                    rows = connection.read_parquet(found, union_by_name=True)
                    known = ", ".join(name for name in columns if name in rows.columns)
                    connection.execute(f"INSERT INTO {table} BY NAME SELECT {known} FROM rows")
            _follow_heads(connection, refused)
            yield connection


def _follow_heads(connection: Any, refused: list[tuple[str, str]]) -> None:
    """Take what was rolled back out of the tables. Args: refused, (store, session)."""
    connection.execute("CREATE TEMP TABLE refused (store VARCHAR, session VARCHAR)")
    if refused:
        connection.executemany("INSERT INTO refused VALUES (?, ?)", refused)
    out = "(store, session) IN (SELECT (store, session) FROM refused)"
    for table in ("versions", "changes", "sessions"):
        lost = f"SELECT (store, version) FROM walks WHERE {out} AND version IS NOT NULL"
        connection.execute(f"DELETE FROM {table} WHERE (store, version) IN ({lost})")
    connection.execute(f"UPDATE walks SET ok = false, why = ?, version = NULL WHERE {out}", [ROLLED_BACK])


def ask(connection: Any, query: str) -> list[str]:
    """The answer to a question in SQL, as lines of a CSV file.

    Raises:
        StereoSfmError: it is no valid SQL.
    """
    import duckdb

    try:
        found = connection.execute(query)
    except duckdb.Error as error:
        raise StereoSfmError(f"--sql: {str(error).splitlines()[0]}") from None
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow([column[0] for column in found.description])
    writer.writerows(found.fetchall())
    return buffer.getvalue().splitlines()
