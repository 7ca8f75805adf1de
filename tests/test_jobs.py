"""Jobs: within their limits, in their order, again after a worker died, and no failure stops another one."""

from __future__ import annotations

import importlib.util
import os
import signal
import time
from pathlib import Path
from typing import Any

import pytest

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
