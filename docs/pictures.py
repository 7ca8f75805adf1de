"""The pictures of the documentation, from a run on the bundled recording.

    python docs/pictures.py [NAME ...]

`viewer.png` needs a graphics adapter (rerun draws it without a window); `errors.png` is a plot of the report.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

DOCS = Path(__file__).parent
SIZE = "1600x950"


def viewer(run: Path, picture: Path) -> None:
    """The viewer at the end of the run."""
    rerun = Path(sys.executable).with_name("rerun")
    made = run / "viewer.png"
    command = [rerun, "--headless", run / "run.rrd", "--screenshot-to", made, "--window-size", SIZE]
    subprocess.run(command, check=False, capture_output=True)
    if not made.is_file():
        raise SystemExit("viewer.png: rerun finds no graphics adapter here; the other pictures are written")
    shutil.copy(made, picture)


def errors(run: Path, picture: Path) -> None:
    """The errors of the run, as its report shows them."""
    shutil.copy(run / "errors.png", picture)


PICTURES: dict[str, Callable[[Path, Path], None]] = {"errors.png": errors, "viewer.png": viewer}


def main(names: list[str]) -> None:
    """Run once, then make the named pictures, or all."""
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        command = [sys.executable, "-m", "stereo_sfm.cli", "run", "--viz", "save", "-q", "-o", run]
        subprocess.run(command, check=True, cwd=DOCS.parent)
        for name in names or PICTURES:
            PICTURES[name](run, DOCS / name)


if __name__ == "__main__":
    main(sys.argv[1:])
