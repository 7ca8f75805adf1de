"""`fleet report`: what the catalogue says, as text and as one page with plots."""

from __future__ import annotations

import datetime
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from stereo_sfm.eval.html_page import take_plots, to_html
from stereo_sfm.eval.plots import plot_trends
from stereo_sfm.eval.tables import write_table

OLD_NIGHTS = 3  # without an update, from which on a map counts as old
DRIFTED_DEG = 0.05  # half of the 0.1 degrees that `benchmarks self_calibration` calls a small error

# A night without a date is before and after no other one.
STORES = """
WITH last AS (SELECT store, max(night) FILTER (ok AND night <> 'undated') AS updated,
                     min(night) FILTER (night <> 'undated') AS begun FROM walks GROUP BY store),
     newest AS (SELECT store, max(version) AS version, arg_max(stored, version) AS stored,
                arg_max(delta, version) AS delta, sum(changes) AS changes FROM versions GROUP BY store)
SELECT w.store, n.version, l.updated AS "last update",
       coalesce(getvariable('today'), current_date) - CAST(coalesce(l.updated, l.begun) AS DATE) AS "nights ago",
       count(*) AS walks, count(*) FILTER (NOT ok) AS failed, n.changes, round(n.stored / 1e6, 2) AS "map MB",
       round(n.delta / 1e6, 2) AS "last delta MB", round(median(w.lost_percent), 2) AS "lost %",
       round(median(w.drift_percent), 2) AS "drift %"
FROM walks w LEFT JOIN last l USING (store) LEFT JOIN newest n USING (store)
GROUP BY w.store, n.version, l.updated, l.begun, n.changes, n.stored, n.delta
ORDER BY "nights ago" DESC NULLS LAST, failed DESC, w.store
"""
ROBOTS = """
WITH dated AS (SELECT *, nullif(night, 'undated') AS day FROM walks)
SELECT robot, store, count(*) AS walks, count(*) FILTER (NOT ok) AS failed, max(day) AS "last walk",
       round(arg_max(lost_percent, day), 2) AS "lost, last, %",
       round(arg_max(drift_percent, day), 2) AS "drift, last, %",
       count(*) FILTER (health <> '') AS "unwell walks", arg_max(health, day) AS "health, last"
FROM dated GROUP BY robot, store
ORDER BY coalesce("health, last", '') = '', "unwell walks" DESC, failed DESC, robot, store
"""
CAMERAS = """
WITH turned AS (SELECT robot, camera, nullif(night, 'undated') AS night, avg(turned_x_deg) AS x,
                       avg(turned_y_deg) AS y, avg(turned_z_deg) AS z
                FROM walks WHERE turned_x_deg IS NOT NULL GROUP BY ALL)
SELECT robot, camera, count(*) AS nights, round(arg_max(x, night), 3) AS "x deg",
       round(arg_max(y, night), 3) AS "y deg", round(arg_max(z, night), 3) AS "z deg",
       round(sqrt(pow(arg_max(x, night) - arg_min(x, night), 2) + pow(arg_max(y, night) - arg_min(y, night), 2)
             + pow(arg_max(z, night) - arg_min(z, night), 2)), 3) AS "turned since the first night, deg"
FROM turned GROUP BY robot, camera ORDER BY 7 DESC NULLS LAST, robot
"""
FAILED = "SELECT store, night, robot, walk, why FROM walks WHERE NOT ok ORDER BY night DESC, store, walk"
CHANGED = "SELECT store, night, version, text FROM changes ORDER BY night DESC, store, text"
TRENDS = """
SELECT w.night, count(*) AS walks, count(*) FILTER (NOT ok) AS "walks in no map",
       median(lost_percent) AS "lost, median, %", median(drift_percent) AS "drift at loops, median, %",
       sum(w.cost_s) / 3600 AS "core-hours",
       (SELECT median(delta) / 1e6 FROM versions v WHERE v.night = w.night) AS "difference of a map, median, MB"
FROM walks w GROUP BY w.night ORDER BY w.night
"""
MOST_SHOWN = 50  # rows of a table on the page; the files hold all


def report(connection: Any, folder: Path, today: datetime.date | None = None) -> tuple[list[str], Path]:
    """Write fleet.html, and each table as CSV and Parquet, into a folder.

    Args:
        connection: of `catalogue.opened`. folder: made if needed. today: that ages count to, None: of the clock.

    Returns:
        Lines for the screen, and the page.
    """
    folder.mkdir(parents=True, exist_ok=True)
    if today is not None:
        connection.execute(f"SET VARIABLE today = DATE '{today}'")
    queries = {
        "stores": STORES, "robots": ROBOTS, "cameras": CAMERAS, "failed": FAILED, "changes": CHANGED, "trends": TRENDS,
    }  # fmt: skip
    tables = {name: _table(connection, query) for name, query in queries.items()}
    for name, (columns, rows) in tables.items():
        write_table(folder / name, columns, rows)
    lines = summary(tables)
    titles = {
        "stores": "Stores", "robots": "Robots", "cameras": "Cameras", "failed": "Walks that are in no map",
        "changes": "Changed shelves",
    }  # fmt: skip
    parts = ["# Fleet", "", *(f"* {line}" for line in lines), "", "## Trends", "", "![trends](trends.png)", ""]
    for name, title in titles.items():
        columns, rows = tables[name]
        parts += [f"## {title}", "", *(_markdown(columns, rows[:MOST_SHOWN]) if rows else ["None."]), ""]
        if len(rows) > MOST_SHOWN:
            parts += [f"{len(rows) - MOST_SHOWN} more are in {name}.csv.", ""]
    with tempfile.TemporaryDirectory() as place:
        plot_trends(Path(place) / "trends.png", *tables["trends"])
        plots = take_plots(Path(place), ("trends",))
    page = folder / "fleet.html"
    page.write_text(to_html("stereo-sfm fleet", "\n".join(parts), plots), encoding="utf-8", errors="replace")
    return lines, page


def summary(tables: dict[str, tuple[list[str], list[tuple[Any, ...]]]]) -> list[str]:
    """What somebody should look at, worst first."""
    stores, robots, cameras, failed = (tables[name][1] for name in ("stores", "robots", "cameras", "failed"))
    nights = tables["trends"][1]
    walks = sum(row[1] for row in nights)
    lines = [f"{len(stores)} stores, {len(nights)} nights, {walks} walks, {len(failed)} of them in no map"]
    old = [f"{row[0]} ({row[3]} nights)" for row in stores if row[3] is not None and row[3] >= OLD_NIGHTS]
    lines += [f"maps without an update for {OLD_NIGHTS} nights: {_some(old)}"] if old else []
    turned = [f"{row[0]} ({row[-1]:.2f} deg)" for row in cameras if row[-1] is not None and row[-1] >= DRIFTED_DEG]
    lines += [f"robots whose cameras turned: {_some(turned)}"] if turned else []
    lines += [f"robot {row[0]} of {row[1]} is not well: {row[-1]}" for row in robots[:10] if row[-1]]
    return lines + [f"{row[0]} {row[1]}, {row[3]}: {row[4]}" for row in failed[:10]]


def _some(names: Sequence[str], most: int = 10) -> str:
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def _table(connection: Any, query: str) -> tuple[list[str], list[tuple[Any, ...]]]:
    found = connection.execute(query)
    return [str(column[0]) for column in found.description], found.fetchall()


def _markdown(columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> list[str]:
    """Numbers stand to the right, with as many decimals as the longest of their column."""
    shown = list(zip(*(_texts(column) for column in zip(*rows, strict=True)), strict=True))
    numbers = [all(isinstance(cell, int | float | None) for cell in column) for column in zip(*rows, strict=True)]
    rule = ["---:" if number else "---" for number in numbers]
    return [f"| {' | '.join(row)} |" for row in (columns, rule, *shown)]


def _texts(column: Sequence[Any]) -> list[str]:
    places = max((len(str(cell).partition(".")[2]) for cell in column if isinstance(cell, float)), default=0)
    numbers = [f"{cell + 0.0:.{places}f}" if isinstance(cell, float) else cell for cell in column]  # -0.0 is 0
    return ["" if cell is None else str(cell).replace("|", "/") for cell in numbers]
