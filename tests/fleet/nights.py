"""The jobs of a plan, one after the other and without Ray."""

from __future__ import annotations

from stereo_sfm.fleet.plan import Plan, find_walks
from stereo_sfm.fleet.run import jobs_of
from stereo_sfm.jobs import Job, Limits, Result, _within  # pyright: ignore[reportPrivateUsage]
from stereo_sfm.storage.remote import Remote

STORE = "017"


def carry_out(plan: Plan, only: int | None = None, kept: bool = False) -> dict[str, Result]:
    """The jobs in their order.

    Args: only, so many of them, as if then everything were killed. kept: errors become results, as with Ray.
    """
    results: dict[str, Result] = {}
    jobs: list[Job] = jobs_of(plan, find_walks(plan)[0])
    for job in jobs[:only]:
        before = {name: results[name] for name in job.after}
        if kept:
            results[job.name] = _within(job.work, job.args, before, Limits(minutes=60.0))
        else:
            results[job.name] = job.work(*job.args, before) if before else job.work(*job.args)
    return results


def walks(plan: Plan) -> Remote:
    return plan.root / STORE / "walks"
