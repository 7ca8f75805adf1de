"""Many jobs as Ray tasks, on this machine or on a cluster: in order, within limits, again when a worker died.

A job is a function of this package with plain arguments and a dict as result. Whatever happens to it becomes part of
its result: no job stops another one.
"""

from __future__ import annotations

import contextlib
import logging
import os
import resource
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from graphlib import TopologicalSorter
from typing import Any

from stereo_sfm.errors import StereoSfmError, printable, require

# Ray's own switch for a single computer: all its ports are on the loopback address.
LOOPBACK_ONLY = "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"
# A node whose agents take more than 15 s to start ends itself, and no setting of Ray changes these seconds.
STARTS = 3  # tries on a busy computer
GRACE = 1.2  # of its time, after which a job that does not react is ended with its worker

Result = dict[str, Any]


@dataclass(frozen=True)
class Limits:
    """Of each job."""

    retries: int = 3  # after its worker or node died
    memory_gb: float = 0.0  # more than that fails; as much is reserved. 0: no limit
    minutes: float = 0.0  # 0: no limit


@dataclass(frozen=True)
class Job:
    """One piece of work.

    Attributes:
        name: unique.
        work: called with `args` and the results of the jobs in `after`, by name.
        after: jobs that must have ended before, well or not.
    """

    name: str
    work: Callable[..., Result]
    args: tuple[Any, ...]
    after: tuple[str, ...] = ()


def run_jobs(jobs: Sequence[Job], limits: Limits, address: str | None, extra: str) -> Iterator[tuple[Job, Result]]:
    """Run all; yields in the order of completion.

    Args:
        jobs: `after` names others of them. limits: of each.
        address: of a Ray cluster, None for this machine.
        extra: of the package, that an error names where Ray is missing.

    Raises:
        StereoSfmError: Ray is not installed. ConnectionError, ValueError: no cluster at this address.
    """
    require(("ray",), extra, "running many recordings")
    with _ray(address) as ray:
        from ray.exceptions import RayError

        options: dict[str, Any] = {"num_cpus": 1, "max_retries": limits.retries}
        if limits.memory_gb:
            options["memory"] = int(limits.memory_gb * 1e9)
            _check_memory(ray.nodes(), options["memory"])
        remote = ray.remote(**options)(_within)
        order, of = TopologicalSorter({job.name: job.after for job in jobs}), {job.name: job for job in jobs}
        order.prepare()
        results: dict[str, Result] = {}
        pending: dict[Any, Job] = {}
        try:
            while order.is_active():
                for job in map(of.__getitem__, order.get_ready()):
                    before = {name: results[name] for name in job.after}
                    pending[remote.remote(job.work, job.args, before, limits)] = job
                done, _ = ray.wait(list(pending), num_returns=1)
                for reference in done:
                    job = pending.pop(reference)
                    try:
                        result: Result = ray.get(reference)
                    except RayError as error:
                        result = {"ok": False, "error": f"the task died: {_why(error)}"}
                    results[job.name] = result
                    order.done(job.name)
                    yield job, result
        finally:
            for reference in pending:
                ray.cancel(reference, force=True)


def _why(error: Exception) -> str:
    """One line of an error of Ray: the last of a traceback, the first of a death."""
    lines = [line for line in str(error).splitlines() if line.strip()]
    return lines[-1 if hasattr(error, "traceback_str") else 0].strip() if lines else type(error).__name__


def _check_memory(nodes: Sequence[Mapping[str, Any]], wanted: int) -> None:
    """Raises StereoSfmError where no computer has so many bytes: Ray would wait for one that has."""
    most = max((node["Resources"].get("memory", 0.0) for node in nodes if node["Alive"]), default=0.0)
    if most < wanted:
        raise StereoSfmError(
            f"no computer has {wanted / 1e9:g} GB of memory for a job, at most {most / 1e9:.1f} GB: lower job.memory_gb"
        )


@contextmanager
def _ray(address: str | None) -> Generator[Any]:
    """Ray, started where it does not run already."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    if address is None:
        os.environ[LOOPBACK_ONLY] = "0"
    import ray

    ours = not ray.is_initialized()
    if ours:
        sys.argv = [*map(printable, sys.argv)]  # which Ray reads
        _start(ray, address)
    try:
        yield ray
    finally:
        if ours:
            ray.shutdown()


def _start(ray: Any, address: str | None) -> None:
    """Connect, or start a cluster of this computer alone.

    Raises:
        StereoSfmError: it does not start.
    """
    options: dict[str, Any] = {"include_dashboard": False, "log_to_driver": False, "logging_level": logging.ERROR}
    if address is not None:
        ray.init(address=address, **options)
        return
    for attempt in range(STARTS):
        try:
            # Not None: otherwise Ray waits for the last cluster that it knows, even if that is gone.
            ray.init(address="local", **options)
            return
        except Exception as error:  # Ray raises nothing narrower
            ray.shutdown()
            if attempt == STARTS - 1:
                raise StereoSfmError(
                    f"Ray does not start on this computer ({_why(error)}): "
                    "try again when it is less busy, or name a cluster with --address"
                ) from None


def _within(work: Callable[..., Result], args: tuple[Any, ...], before: Mapping[str, Result], limits: Limits) -> Result:
    """In the worker: the job's result, or why there is none."""
    try:
        with _limited(limits):
            return work(*args, before) if before else work(*args)
    except StereoSfmError as error:
        return {"ok": False, "error": str(error)}
    except TimeoutError:
        most = f"it took more than {limits.minutes:g} minutes"
        return {"ok": False, "error": most if limits.minutes else traceback.format_exc()}
    except MemoryError:
        most = f"it needs more than {limits.memory_gb:g} GB of memory"
        return {"ok": False, "error": most if limits.memory_gb else "this computer has too little memory for it"}
    except Exception:
        return {"ok": False, "error": traceback.format_exc()}


@contextmanager
def _limited(limits: Limits) -> Generator[None]:
    """Within its time and memory: the interpreter is interrupted; one that does not react is ended."""
    old_memory = resource.getrlimit(resource.RLIMIT_DATA)
    end = threading.Timer(60 * limits.minutes * GRACE, os._exit, (1,)) if limits.minutes else None
    old_alarm: Any = None
    try:
        if limits.memory_gb:
            most = _data_bytes() + int(limits.memory_gb * 1e9)
            with contextlib.suppress(ValueError, OSError):  # a lower limit is set already
                resource.setrlimit(resource.RLIMIT_DATA, (most, old_memory[1]))
        if end is not None:
            end.daemon = True
            end.start()
            old_alarm = signal.signal(signal.SIGALRM, _too_late)
            signal.setitimer(signal.ITIMER_REAL, 60 * limits.minutes)
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, old_memory)
        if end is not None:
            signal.setitimer(signal.ITIMER_REAL, 0)
            signal.signal(signal.SIGALRM, old_alarm)
            end.cancel()


def _too_late(number: int, frame: object) -> None:
    raise TimeoutError


def _data_bytes() -> int:
    """Memory that this process has now, as the limit counts it."""
    with open("/proc/self/status", encoding="ascii", errors="replace") as stream:
        kilobytes = [int(line.split()[1]) for line in stream if line.startswith("VmData:")]
    return kilobytes[0] * 1024 if kilobytes else 0
