"""Jobs: within their limits, in their order, again after a worker died, and no failure stops another one."""

from __future__ import annotations

import contextlib
import importlib.util
import os
import signal
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from stereo_sfm import jobs as jobs_module
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.jobs import Job, Limits, _within, run_jobs  # pyright: ignore[reportPrivateUsage]


def work(what: str, before: dict[str, Any] | None = None) -> dict[str, Any]:
    if what == "bad input":
        raise StereoSfmError("bad input")
    if what == "error":
        raise ZeroDivisionError
    if what == "endless":
        while True:
            time.sleep(0.01)
    if what == "large":
        return {"ok": True, "size": len(bytearray(2_000_000_000))}
    return {"ok": True, "what": what, "before": before}


@pytest.mark.parametrize(
    ("what", "said"),
    [("bad input", "bad input"), ("error", "ZeroDivisionError"), ("endless", "more than 0.005 minutes"),
     ("large", "more than 1 GB of memory")],
)  # fmt: skip
def test_a_job_that_fails_is_a_result(what: str, said: str) -> None:
    result = _within(work, (what,), {}, Limits(memory_gb=1.0, minutes=0.005))
    assert not result["ok"] and said in result["error"]
    assert signal.getitimer(signal.ITIMER_REAL)[0] == 0
    assert _within(work, ("fine",), {"a": {"ok": False}}, Limits())["before"] == {"a": {"ok": False}}


def dies(counter: Path, times: int) -> dict[str, Any]:
    with counter.open("a") as stream:
        stream.write("x")
    if len(counter.read_text()) <= times:
        os.kill(os.getpid(), signal.SIGKILL)
    return {"ok": True, "tries": len(counter.read_text())}


class Counted(tuple[str, ...]):
    """What a job waits for, which counts how often it is looked at."""

    looks = 0

    def __iter__(self) -> Iterator[str]:
        Counted.looks += 1
        return super().__iter__()


class AtOnce:
    """In place of Ray: a job is done where it is given."""

    def remote(self, **_: Any) -> Callable[..., Any]:
        return lambda work: SimpleNamespace(remote=lambda *args: Done(work(*args)))

    def wait(self, pending: list[Done], num_returns: int) -> tuple[list[Done], list[Done]]:
        return pending[-num_returns:], pending[:-num_returns]

    def get(self, done: Done) -> dict[str, Any]:
        return done.result


@dataclass(eq=False)
class Done:
    result: dict[str, Any]


def test_a_long_plan_is_looked_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each job's conditions are read a few times, however many others there are; results go to whoever waits."""
    pytest.importorskip("ray")
    monkeypatch.setattr(jobs_module, "_ray", lambda _: contextlib.nullcontext(AtOnce()))
    count = 300
    walks = [Job(f"walk {k}", work, ("walk",)) for k in range(count)]
    nights = [
        Job(f"night {k}", work, ("night",), Counted([f"walk {k}", *([f"night {k - 1}"] if k else [])]))
        for k in range(count)
    ]
    order = [job.name for job, _ in run_jobs(walks + nights, Limits(), None, "fleet")]
    assert len(order) == 2 * count and Counted.looks <= 3 * count
    assert all(order.index(name) < order.index(job.name) for job in nights for name in job.after)


@pytest.mark.slow
def test_jobs_on_ray(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if importlib.util.find_spec("ray") is None:  # imported by run_jobs, which sets it up before
        pytest.skip("needs ray")
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent), prepend=os.pathsep)  # workers import this module
    jobs = [
        Job("dies", dies, (tmp_path / "dies", 2)),
        Job("always", dies, (tmp_path / "always", 99)),
        Job("error", work, ("error",)),
        Job("last", work, ("last",), ("dies", "error")),
    ]
    results = {job.name: result for job, result in run_jobs(jobs, Limits(retries=3), None, "fleet")}
    assert results["dies"] == {"ok": True, "tries": 3}
    assert not results["always"]["ok"] and "died" in results["always"]["error"]
    assert results["last"]["ok"] and results["last"]["before"].keys() == {"dies", "error"}
