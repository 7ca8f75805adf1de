"""`fleet run` as users call it: killed and started again, the result is the one of a run that nobody disturbed."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from stereo_sfm.cli import main
from stereo_sfm.fleet.versions import current
from stereo_sfm.maps.saved_map import save_map
from stereo_sfm.storage.folders import send_folder
from stereo_sfm.storage.remote import Remote
from tests.fleet.s3_server import Server
from tests.maps.maps import small_map

ROOT = Path(__file__).parents[2]


@pytest.mark.slow
def test_a_killed_driver_goes_on(place: str, s3: Server, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("ray")
    save_map(small_map()[1], tmp_path / "map")
    for store in ("a", "b"):
        send_folder(tmp_path / "map", Remote.of(place) / store / "walks" / "r1" / "2026-11-25_2200")
    plan = tmp_path / "plan.toml"
    plan.write_text(
        f'[fleet]\nroot = "{place}"\n[job]\nmemory_gb = 1.0\n'
        '[[walk]]\nstore = "a"\nnight = "2026-11-26"\nrobot = "r2"\n'
        'source = "sim:aisle?size=212x200&frames=12&rate=15"\n'
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    child = subprocess.Popen(
        [sys.executable, "-m", "stereo_sfm.cli", "fleet", "run", str(plan)], env=environment, stderr=subprocess.PIPE
    )
    assert child.stderr is not None
    child.stderr.readline()  # the first job has ended
    child.kill()
    child.wait()
    time.sleep(1.0)
    assert main(["fleet", "run", str(plan)]) in (0, 3)  # 3: the short walk may not be found in the other map
    first = capsys.readouterr()
    assert "2 walks" not in first.out and "3 walks in 3 nights of 2 stores" in first.out
    assert all(len(current(Remote.of(place) / store / "map").sessions) >= 1 for store in ("a", "b"))
    assert current(Remote.of(place) / "b" / "map").number == 1
    assert main(["fleet", "run", str(plan)]) in (0, 3)
    assert "0 of 6 jobs done now" in capsys.readouterr().out
