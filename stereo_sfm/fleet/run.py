"""A plan carried out: every walk and every night of every store as jobs, as many at once as there are cores."""

from __future__ import annotations

import contextlib
import datetime
from collections.abc import Iterable, Iterator, Sequence
from itertools import groupby, pairwise
from typing import Any

from stereo_sfm.fleet import versions
from stereo_sfm.fleet.plan import UNDATED, Plan, Walk, night_of
from stereo_sfm.fleet.steps import job_name, map_walk, read_json, update_store
from stereo_sfm.jobs import Job, Limits, Result, run_jobs
from stereo_sfm.storage import objects
from stereo_sfm.storage.remote import Remote
from stereo_sfm.storage.spool import SUM


def jobs_of(plan: Plan, walks: list[Walk]) -> list[Job]:
    """A job for each walk, and one for each night of a store, which waits for its walks and for the night before."""
    config, root = plan.config(), plan.root
    jobs = [Job(job_name(walk), map_walk, (root, walk, config)) for walk in walks]
    for _, of_store in groupby(walks, key=lambda w: w.store):
        nights = [list(of_night) for _, of_night in groupby(of_store, key=lambda w: w.night)]
        for before, night in pairwise([None, *nights]):
            assert night is not None
            after = [job_name(walk) for walk in night] + ([night_name(before[0])] if before else [])
            jobs.append(Job(night_name(night[0]), update_store, (root, night, config), tuple(after)))
    return jobs


def night_name(walk: Walk) -> str:
    """Of the job of its store and night."""
    return f"{walk.store} {walk.night}"


def run_plan(plan: Plan, address: str | None, walks: list[Walk]) -> Iterator[tuple[Job, Result]]:
    """Carry out what is not done yet; yields each job as it ends."""
    limits = Limits(plan.job.retries, plan.job.memory_gb, plan.job.minutes)
    yield from run_jobs(jobs_of(plan, walks), limits, address, "fleet")


def forget_images(plan: Plan, walks: list[Walk], today: datetime.date, waiting: Sequence[str] = ()) -> int:
    """Delete recordings that are older than the plan allows; maps, results and tables stay.

    Args: walks, of which those whose map is not made yet are kept. waiting: folders that have not arrived as a whole.

    Returns:
        Bytes that were deleted.
    """
    days = plan.fleet.keep_images_days
    if not days:
        return 0
    deleted = 0
    for place in map(Remote.of, waiting):
        if (today - _day(night_of(place.name), place)).days > days:
            files = objects.listed(place)
            objects.delete([place / name for name, _, _ in files])
            deleted += sum(size for _, size, _ in files)
    marks: dict[str, Any] = {}
    for walk in walks:
        place = plan.root / walk.store / "walks" / walk.name
        # Without a state the plan names its source itself: it is not ours to delete.
        if not walk.state or (today - _day(walk.night, place)).days <= days:
            continue
        marker = plan.root / walk.store / "catalogue" / f"{walk.night}.json"
        if str(marker) not in marks:
            marks[str(marker)] = (read_json(marker) or {}).get("walks", {})
        if walk.name not in marks[str(marker)]:  # it came late: its map is made first
            continue
        names = [name for name, _, _ in objects.listed(place)]
        beside = place.parent / f"{place.name}{SUM}"
        objects.delete([place / name for name in names] if names else [place, beside])
        deleted += walk.bytes
    return deleted


def forget_versions(plan: Plan, stores: Iterable[str]) -> int:
    """Delete the files of versions that the plan does not keep; bytes of them."""
    deleted = 0
    for store in stores if plan.fleet.keep_versions else ():
        with contextlib.suppress(objects.Changed):  # somebody writes this store: next night
            deleted += versions.forget_versions(plan.root / store / "map", plan.fleet.keep_versions)
    return deleted


def _day(night: str, place: Remote) -> datetime.date:
    """Of a recording: by its name, else when the newest of its files was written."""
    if night != UNDATED:
        return datetime.date.fromisoformat(night)
    return max(objects.written(file) for file in [place / name for name, _, _ in objects.listed(place)] or [place])
