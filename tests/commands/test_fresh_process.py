"""The installed command, as a shell starts it: without imports and set-up of other tests."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

SCRIPT = Path(sys.executable).parent / "stereo-sfm"


def run(folder: Path, *options: str) -> dict[str, Any]:
    """Three frames of the bundled recording; its stats.json."""
    command = [SCRIPT, "run", "--max-frames", "3", "-o", folder, *options]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "tracked 3/3 frames" in done.stdout and "Traceback" not in done.stderr
    assert (folder / "report.md").is_file() and (folder / "run.mcap").is_file()
    return json.loads((folder / "stats.json").read_text())


def test_a_run_gives_the_same_in_one_process_and_in_many(tmp_path: Path) -> None:
    one, many = run(tmp_path / "one", "--inline"), run(tmp_path / "many")
    assert one["fingerprint"] == many["fingerprint"] and one["keyframes"] == many["keyframes"]


def test_the_package_is_the_command() -> None:
    done = subprocess.run([sys.executable, "-m", "stereo_sfm", "sources"], capture_output=True, text=True, check=False)
    assert done.returncode == 0 and "euroc" in done.stdout
