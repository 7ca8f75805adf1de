"""Many recordings as jobs: each its own inline run in its own folder, resumable, one table of results."""

from __future__ import annotations

import json
import os
import re
import time
import traceback
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

from stereo_sfm.config import Config, dump
from stereo_sfm.errors import Hindered, StereoSfmError, printable
from stereo_sfm.eval.statistics import failure
from stereo_sfm.eval.stats_file import checked_stats
from stereo_sfm.eval.tables import write_table
from stereo_sfm.input_file import read_json
from stereo_sfm.jobs import Job, Limits, run_jobs

RESULT = "result.json"
MAP = "map"  # folder of the merged map, beside those of the recordings


@dataclass(frozen=True)
class BatchTask:
    """One recording."""

    spec: str
    folder: str
    config: Config
    map_out: bool


def names(recordings: Sequence[str]) -> list[str]:
    """A unique folder name for each recording, in order: of characters that need no quotes in a shell."""
    stems = [re.sub(r"[^\w.-]+", "_", Path(r).stem or r).strip("_") for r in recordings]
    taken = {s for s in stems if stems.count(s) == 1} | {MAP}
    out: list[str] = []
    for stem in stems:
        name = stem
        if stems.count(stem) > 1 or stem == MAP:
            name = next(f"{stem}_{k}" for k in count(1) if f"{stem}_{k}" not in taken)
            taken.add(name)
        out.append(name)
    return out


def run_one(task: BatchTask) -> dict[str, Any]:
    """Run one recording to the end; errors become part of the result.

    Raises:
        TimeoutError, MemoryError: the limits of its job.
    """
    import cv2

    from stereo_sfm.drivers.choice import SourceChoice
    from stereo_sfm.eval.record import RunRecord
    from stereo_sfm.eval.run_results import write_results
    from stereo_sfm.export.run_folder import prepare_folder
    from stereo_sfm.maps.folders import MapFolders
    from stereo_sfm.pipeline.session import Session, Wiring

    cv2.setNumThreads(1)
    folder, record = Path(task.folder), RunRecord.of(task.config)
    result: dict[str, Any] = {"recording": task.spec, "config": dump(task.config), "node": os.uname().nodename}
    try:
        prepare_folder(folder, overwrite=True)
        folders = MapFolders(map_out=folder / "map" if task.map_out else None)
        opener = SourceChoice.of(task.spec)
        with closing(Session(opener, task.config, [record], Wiring(inline=True), folders, folder, True)) as session:
            with session:
                begin = time.perf_counter()
                for _ in session:
                    pass
                wall_s = time.perf_counter() - begin - session.waited_s(begin)
            info = session.info
            stats, _ = write_results(folder, info.name, info.rig, task.config, record, wall_s, info.ground_truth)
        result |= {"ok": True, "stats": stats, "failure": failure(stats)}
    except StereoSfmError as error:
        result |= {"ok": False, "error": str(error), "hindered": isinstance(error, Hindered)}
    except (TimeoutError, MemoryError):
        raise
    except Exception:
        result |= {"ok": False, "error": traceback.format_exc()}
    folder.mkdir(parents=True, exist_ok=True)
    temporary = folder / f"{RESULT}.part"
    temporary.write_text(json.dumps(result, indent=2, default=str), encoding="utf-8")
    temporary.replace(folder / RESULT)
    return result


def finished(task: BatchTask) -> dict[str, Any] | None:
    """The result of an earlier batch with the same recording and configuration, if it went well."""
    path = Path(task.folder) / RESULT
    try:
        result = read_json(path)
        same = result["ok"] and result["recording"] == task.spec and result["config"] == dump(task.config)
        checked_stats(result["stats"])
    except (OSError, ValueError, LookupError, TypeError):
        return None
    has_map = not task.map_out or (Path(task.folder) / "map" / "map.json").exists()
    return result if same and has_map else None


def run_batch(
    tasks: Sequence[BatchTask], address: str | None = None, limits: Limits | None = None
) -> Iterator[tuple[BatchTask, dict[str, Any]]]:
    """Run what is not finished yet, on this machine or on a cluster; yields in the order of completion.

    Args:
        tasks: what to run; the folders must be reachable from every node.
        address: of a Ray cluster, None for this machine. limits: of each recording.
    """
    waiting: list[BatchTask] = []
    for task in tasks:
        done = finished(task)
        if done is None:
            waiting.append(task)
        else:
            yield task, {**done, "resumed": True}
    if not waiting:
        return
    of = {task.folder: task for task in waiting}
    jobs = [Job(task.folder, run_one, (task,)) for task in waiting]
    for job, result in run_jobs(jobs, limits or Limits(), address, "batch"):
        yield of[job.name], {"recording": of[job.name].spec, **result}


def why_failed(result: dict[str, Any]) -> str:
    """Why a recording has no result, or one that counts as failed as that of `run` does; "" where all is well."""
    return str(result.get("failure", "")) if result["ok"] else result["error"].strip().splitlines()[-1]


CELL = 160  # letters of a cell that people read
COLUMNS = ("recording", "frames", "tracked %", "keyframes", "loops", "path m", "ATE mm", "frames/s", "result")


def table_row(name: str, result: dict[str, Any]) -> list[Any]:
    """One line of the table of results; None where there is no value."""
    why = why_failed(result)
    if not result["ok"]:
        return [name, *[None] * (len(COLUMNS) - 2), f"failed: {why}"]
    stats = result["stats"]
    ate = stats["evaluation"].get("map", stats["evaluation"].get("odometry"))
    return [
        name,
        stats["frames"],
        round(100 - stats["lost_percent"], 1),
        stats["keyframes"],
        stats["loops_accepted"],
        round(stats["path_m"], 1),
        None if ate is None else round(ate["ape_m"]["rmse"] * 1e3, 1),
        round(stats["frames_per_s"], 1),
        f"failed: {why}" if why else str(stats["fingerprint"]),
    ]


def _shown(cell: str) -> str:
    cell = printable(cell)
    return cell if len(cell) <= CELL else f"{cell[: CELL - 1]}…"


def write_results(rows: Sequence[Sequence[Any]], folder: Path) -> None:
    """results.md for people; results.csv and results.parquet for programs, whole, where what is missing is empty."""
    shown = [["-" if cell is None else _shown(str(cell)) for cell in row] for row in rows]
    lines = [f"| {' | '.join(r)} |" for r in (COLUMNS, ["---"] * len(COLUMNS), *shown)]
    (folder / "results.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
    write_table(folder / "results", COLUMNS, rows)


def merge_maps(folders: Sequence[Path], config: Config, out: Path) -> str:
    """Merge the maps of all sessions that loops connect; returns a line about the result."""
    from stereo_sfm.loop.vocabulary_file import configured_vocabulary
    from stereo_sfm.maps.merge import merge, share_a_session
    from stereo_sfm.maps.saved_map import load_map, save_map

    vocabulary = configured_vocabulary(config.loop)
    common = load_map(folders[0])
    joined, alone = [folders[0].parent.name], list[str]()
    for folder in folders[1:]:
        try:
            other = load_map(folder)
            if share_a_session(common, other):
                raise StereoSfmError("the same recording as one before")
            common = merge([common, other], vocabulary, config.loop, config.mapper).saved
            joined.append(folder.parent.name)
        except StereoSfmError as error:
            alone.append(f"{folder.parent.name} ({error})")
    save_map(common, out)
    text = f"one map of {', '.join(joined)}: {len(common)} keyframes, {out}"
    return text + (f"; not connected: {'; '.join(alone)}" if alone else "")
