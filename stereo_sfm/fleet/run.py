"""A plan carried out: every walk and every night of every store as jobs, as many at once as there are cores."""

from __future__ import annotations

import contextlib
import datetime
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from itertools import groupby, pairwise

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.fleet import versions
from stereo_sfm.fleet.editing import holds
from stereo_sfm.fleet.plan import UNDATED, Plan, Walk, night_of, stores_of
from stereo_sfm.fleet.steps import BEGUN, RESULT, Night, job_name, map_walk, read_json, update_store
from stereo_sfm.fleet.versions import read_head, read_version
from stereo_sfm.jobs import Job, Limits, Result, run_jobs
from stereo_sfm.storage import objects
from stereo_sfm.storage.folders import sum_of
from stereo_sfm.storage.remote import Remote


def jobs_of(plan: Plan, walks: list[Walk]) -> list[Job]:
    """A job for each walk, and one for each night of a store, which waits for its walks and for the night before."""
    config, root = plan.config(), plan.root
    jobs = [Job(walk.store, _lost, (walk.error,)) for walk in walks if walk.error]
    walks = [walk for walk in walks if not walk.error]
    jobs += [Job(job_name(walk), map_walk, (root, walk, config)) for walk in walks]
    for _, of_store in groupby(walks, key=lambda w: w.store):
        nights = [list(of_night) for _, of_night in groupby(of_store, key=lambda w: w.night)]
        for before, night in pairwise([None, *nights]):
            assert night is not None
            after = [job_name(walk) for walk in night] + ([night_name(before[0])] if before else [])
            jobs.append(Job(night_name(night[0]), update_store, (root, night, config), tuple(after)))
    return jobs


def _lost(error: str) -> Result:
    """Of a store whose walks cannot be listed."""
    return {"ok": False, "error": error}


def night_name(walk: Walk) -> str:
    """Of the job of its store and night."""
    return f"{walk.store} {walk.night}"


def run_plan(plan: Plan, address: str | None, walks: list[Walk]) -> Iterator[tuple[Job, Result]]:
    """Carry out what is not done yet; yields each job as it ends."""
    limits = Limits(plan.job.retries, plan.job.memory_gb, plan.job.minutes)
    yield from run_jobs(jobs_of(plan, walks), limits, address, "fleet")


def forget_images(plan: Plan, walks: list[Walk], today: datetime.date, waiting: Sequence[str] = ()) -> int:
    """Delete recordings that are older than the plan allows, and the maps of walks as old that are in a version.

    Results and tables stay. A walk whose map is not in the store yet has so many days again from its first try; then
    its recording is deleted in any case, and its row says so.

    Args: walks: that there are. waiting: addresses of what is none, or has not arrived as a whole.

    Returns:
        Bytes that were deleted.
    """
    if not plan.fleet.keep_images_days:
        return 0
    lost = {walk.store for walk in walks if walk.error}
    tasks = [partial(_forget_others, plan, place, today) for place in map(Remote.of, waiting)]
    for store in sorted({*stores_of(plan)} - lost):
        mine = [walk for walk in walks if walk.store == store]
        tasks += [partial(_forget_walks, plan, mine, today), partial(_forget_work, plan, store, mine, today)]
    return _all(tasks)


def _forget_others(plan: Plan, place: Remote, today: datetime.date) -> int:
    """Delete what is old and no walk. What is dated long ago may be arriving now."""
    return _delete(place) if _age(UNDATED, place, today) > plan.fleet.keep_images_days else 0


def _forget_walks(plan: Plan, walks: list[Walk], today: datetime.date) -> int:
    """Delete the old recordings of a store."""
    days, deleted = plan.fleet.keep_images_days, 0
    place = {walk: plan.root / walk.store / "walks" / walk.name for walk in walks}
    # Without a state the plan names its source itself: it is not ours to delete.
    old = [w for w in walks if w.state and _age(w.night, place[w], today) > days]
    for night, found in groupby(old, key=lambda walk: walk.night):
        known = Night.read(plan.root, old[0].store, night)
        for walk in found:
            begun = plan.root / walk.store / "work" / walk.key / BEGUN
            settled = known.is_settled(walk)
            if not settled and (not objects.exists(begun) or (today - objects.written(begun)).days <= days):
                continue
            deleted += _delete(place[walk])
            if not settled:  # said afterwards: a store whose tables cannot be written keeps no images of people
                known.give_up(walk, days)
    return deleted


def _forget_work(plan: Plan, store: str, walks: list[Walk], today: datetime.date) -> int:
    """Delete the maps of a store's old walks that nobody reads again; their results say that they were made."""
    place = plan.root / store / "work"
    names = (name.split("/") for name, _, _ in objects.listed(place))
    made = {parts[0] for parts in names if parts[1:2] == ["map"]}
    old = [k for k in sorted(made) if _age(night_of(k), place / k, today) > plan.fleet.keep_images_days]
    if not old:
        return 0
    waited_for = {walk.key for walk in walks}
    head = read_head(plan.root / store / "map")
    version = read_version(plan.root / store / "map", head.version) if head.version else None

    def needed(key: str) -> bool:
        result = read_json(place / key / RESULT) or {}
        return not holds(head, version, str(result.get("id")))

    return sum(_delete(place / key / "map") for key in old if key not in waited_for or not needed(key))


def forget_versions(plan: Plan, stores: Iterable[str]) -> int:
    """Delete the files of versions that the plan does not keep; bytes of them."""

    def forget(store: str) -> int:
        with contextlib.suppress(objects.Changed):  # somebody writes this store: next night
            return versions.forget_versions(plan.root / store / "map", plan.fleet.keep_versions)
        return 0

    return _all([partial(forget, store) for store in stores]) if plan.fleet.keep_versions else 0


def _all(tasks: Iterable[Callable[[], int]]) -> int:
    """The sum of what they return; none stops another one.

    Raises:
        StereoSfmError: of the first one that failed, after all others.
    """
    total, errors = 0, list[StereoSfmError]()
    for task in tasks:
        try:
            total += task()
        except StereoSfmError as error:
            errors.append(error)
    if errors:
        raise errors[0]
    return total


def _delete(place: Remote) -> int:
    """A file or a folder, and the checksum beside it; bytes that they had."""
    files = objects.listed(place)
    if files:
        objects.delete(place / name for name, _, _ in files)
        return sum(size for _, size, _ in files)
    with contextlib.suppress(objects.Missing):  # somebody else was first
        size = objects.size_and_tag(place)[0]
        objects.delete([place, sum_of(place)])
        return size
    return 0


def _age(night: str, place: Remote, today: datetime.date) -> int:
    """Days since a night, else since the newest file of a place was written."""
    if night != UNDATED:
        return (today - datetime.date.fromisoformat(night)).days
    files = [place / name for name, _, _ in objects.listed(place)] or [place]
    return (today - max(map(objects.written, files))).days
