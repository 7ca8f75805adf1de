"""The catalogue: a row for each walk, version of a map and change, as Parquet; DuckDB answers questions about it.

    ROOT/STORE/catalogue/walks-2026-11-25.parquet, versions-..., changes-...

A night's files are written as a whole, so that writing them again doubles nothing.
"""

from __future__ import annotations

import csv
import io
import tempfile
from collections.abc import Generator, Iterable, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

import stereo_sfm
from stereo_sfm.calib.choice import SCALES
from stereo_sfm.errors import StereoSfmError, require
from stereo_sfm.fleet.plan import Walk
from stereo_sfm.fleet.versions import Version
from stereo_sfm.storage import objects
from stereo_sfm.storage.folders import fetch_file
from stereo_sfm.storage.remote import Remote

# column -> type of DuckDB and of pyarrow ("VARCHAR", "BIGINT", "DOUBLE", "BOOLEAN")
WALKS = {
    "store": "VARCHAR", "night": "VARCHAR", "robot": "VARCHAR", "walk": "VARCHAR", "ok": "BOOLEAN", "why": "VARCHAR",
    "session": "VARCHAR", "version": "BIGINT", "camera": "VARCHAR", "turned_x_deg": "DOUBLE",
    "turned_y_deg": "DOUBLE", "turned_z_deg": "DOUBLE", "focal_percent": "DOUBLE", "keyframes": "BIGINT",
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
TABLES = {"walks": WALKS, "versions": VERSIONS, "changes": CHANGES}
NOTHING = "no shelf changed"

Rows = list[dict[str, Any]]


def night_tables(store: str, night: str, walks: Rows, versions: Sequence[Version], cost_s: float) -> dict[str, Rows]:
    """The rows of a night by table.

    Args:
        store, night. walks: its rows of `walk_row`, which get the number of their version.
        versions: of the store, newest first. cost_s: seconds of the update.
    """
    by_name = {v.name: v for v in versions}
    added = {v.name: v.sessions.keys() - (by_name[v.parent].sessions.keys() if v.parent else ()) for v in versions}
    number = {session: v.number for v in versions for session in added[v.name]}
    walks = [{**row, "version": number.get(row["session"])} for row in walks]
    mine = {row["session"] for row in walks}
    made = [v for v in versions if added[v.name] & mine]
    return {
        "walks": walks,
        "versions": [
            {
                "store": store, "night": night, "version": v.number, "parent": v.parent, "sessions": len(v.sessions),
                "added": len(added[v.name]), "bytes": sum(f.bytes for f in v.files.values()),
                "stored": sum(f.stored for f in v.files.values()), "delta": delta_bytes(v, by_name.get(v.parent)),
                "changes": sum(text != NOTHING for text in v.changes), "software": v.software, "cost_s": cost_s,
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


def walk_row(walk: Walk, result: Mapping[str, Any], why: str, session: str) -> dict[str, Any]:
    """A walk in the catalogue.

    Args: walk. result: of `steps.map_walk`. why: it is not in the map, "" if it is. session: checksum of its map.
    """
    stats = result.get("stats") or {}
    terms = (SCALES * np.array(result.get("terms") or [np.nan] * len(SCALES))).tolist()
    row = {
        "store": walk.store, "night": walk.night, "robot": walk.robot, "walk": walk.name, "ok": not why, "why": why,
        "session": session, "version": None, "camera": result.get("camera"), "turned_x_deg": terms[0],
        "turned_y_deg": terms[1], "turned_z_deg": terms[2], "focal_percent": terms[5],
        "keyframes": result.get("keyframes"), "frames": stats.get("frames"), "seconds": stats.get("duration_s"),
        "path_m": stats.get("path_m"), "lost_percent": stats.get("lost_percent"),
        "losses": len(stats["lost_intervals"]) if stats else None, "loops": stats.get("loops_accepted"),
        "drift_percent": stats.get("closure_drift_percent_median"), "result": stats.get("fingerprint"),
        "software": f"stereo-sfm {stereo_sfm.__version__}", "cost_s": result.get("cost_s"), "bytes": walk.bytes,
    }  # fmt: skip
    return {name: _value(value) for name, value in row.items()}


def write_tables(place: Remote, night: str, tables: Mapping[str, Rows]) -> None:
    """Write a night's files; tables without rows as well, so that nothing of an earlier try stays."""
    require(("pyarrow",), "fleet", "the catalogue")
    import pyarrow
    from pyarrow import parquet

    types = {
        "VARCHAR": pyarrow.string(), "BIGINT": pyarrow.int64(), "DOUBLE": pyarrow.float64(),
        "BOOLEAN": pyarrow.bool_(),
    }  # fmt: skip
    for name, columns in TABLES.items():
        schema = pyarrow.schema([(column, types[kind]) for column, kind in columns.items()])
        rows = [{column: _value(row[column]) for column in columns} for row in tables[name]]
        buffer = io.BytesIO()
        parquet.write_table(pyarrow.Table.from_pylist(rows, schema), buffer)
        objects.write(place / f"{name}-{night}.parquet", buffer.getvalue())


def _value(value: Any) -> Any:
    """None for what is no number."""
    return None if isinstance(value, float) and not np.isfinite(value) else value


@contextmanager
def opened(root: Remote, stores: Iterable[str]) -> Generator[Any]:
    """A DuckDB connection with the tables `walks`, `versions` and `changes` of these stores.

    Raises:
        StereoSfmError: there is no catalogue yet.
    """
    require(("duckdb",), "fleet", "the catalogue")
    import duckdb

    with tempfile.TemporaryDirectory(prefix="catalogue") as folder:
        found: dict[str, list[str]] = {name: [] for name in TABLES}
        for store in stores:
            for name, size, _ in objects.listed(root / store / "catalogue"):
                table = name.partition("-")[0]
                if name.endswith(".parquet") and table in found and "/" not in name:
                    path = Path(folder) / store / name
                    fetch_file(root / store / "catalogue" / name, path, size)
                    found[table].append(str(path))
        if not found["walks"]:
            raise StereoSfmError(f"there is no catalogue at {root}: 'stereo-sfm fleet run PLAN.toml' makes one")
        with duckdb.connect() as connection:
            for table, columns in TABLES.items():
                names = ", ".join(f"{name} {kind}" for name, kind in columns.items())
                connection.execute(f"CREATE TABLE {table} ({names})")
                if found[table]:
                    # Tables of other versions may have fewer columns, or more.
                    rows = connection.read_parquet(found[table], union_by_name=True)
                    known = ", ".join(name for name in columns if name in rows.columns)
                    connection.execute(f"INSERT INTO {table} BY NAME SELECT {known} FROM rows")
            yield connection


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
