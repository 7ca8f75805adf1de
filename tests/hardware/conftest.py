"""Which camera the hardware tests use, and the report that they leave."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

REPORT = Path("hardware_report.json")
_reports: dict[str, Any] = {}


@pytest.fixture(scope="session")
def camera() -> str:
    """The source of the tests: $STEREO_SFM_CAMERA, or the attached camera. t265:simulated runs without one."""
    given = os.environ.get("STEREO_SFM_CAMERA")
    if given:
        return given
    from stereo_sfm.drivers.devices import list_devices

    cameras, problems = list_devices()
    if len(cameras) == 1:
        return cameras[0].id
    if not cameras:
        pytest.skip(f"no camera attached: plug one in, or set STEREO_SFM_CAMERA {problems or ''}")
    pytest.skip(f"several cameras attached: set STEREO_SFM_CAMERA to one of {[c.id for c in cameras]}")


@pytest.fixture
def report(request: pytest.FixtureRequest) -> Iterator[dict[str, Any]]:
    """Numbers of one test, for the report."""
    numbers: dict[str, Any] = {}
    yield numbers
    if numbers:
        _reports[request.node.name] = numbers


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """The report to paste into an issue."""
    if not _reports:
        return
    where = {"system": platform.platform(), "python": platform.python_version()}
    text = json.dumps(where | _reports, indent=1, default=str)
    REPORT.write_text(text)
    terminalreporter.section(f"hardware report (also in {REPORT}): paste it into an issue")
    terminalreporter.write_line(text)
