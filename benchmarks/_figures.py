"""Figures that benchmarks write as JSON, and the page that is made from them.

One file a benchmark in `benchmarks/figures/`. Each row is a figure: what of which sequence, its value and unit, and the
standard deviation over how many runs. A file says with which commit, on which machine and with which versions.
"""

from __future__ import annotations

import json
import platform
import subprocess
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).parent / "figures"
VERSIONS = ("numpy", "scipy", "numba", "opencv-python-headless", "gtsam")
UNKNOWN = "not recorded"


@dataclass(frozen=True)
class Figure:
    """One measured number."""

    sequence: str
    quantity: str
    value: float | str  # a text where a number says too little: "30 of 30"
    unit: str = ""
    spread: float | None = None  # standard deviation, in the same unit
    runs: int = 1

    def text(self) -> str:
        """As the table shows it."""
        if isinstance(self.value, str):
            return " ".join([self.value, self.unit]).strip()
        spread = "" if self.spread is None else f" ± {self.spread:.3g}"
        return f"{self.value:.4g}{spread} {self.unit}".strip()


def commit() -> str:
    """The short name of this checkout's commit; with "+" where files were changed since."""
    try:
        name = subprocess.run(
            ["git", "describe", "--always", "--dirty=+", "--exclude=*"],
            cwd=FOLDER.parent,
            capture_output=True,
            text=True,
            check=True,
        )
    except (OSError, subprocess.CalledProcessError):
        return UNKNOWN
    return name.stdout.strip()


def processor() -> str:
    """The model's name where Linux tells it."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or UNKNOWN
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return f"{names[0]}, {len(names)} cores" if names else platform.machine()


def write(name: str, title: str, figures: Sequence[Figure], folder: Path = FOLDER, at: str = "") -> Path:
    """Replace the figures of the benchmark `name`, which ran on this machine with this checkout or that of `at`.

    Returns:
        The file.
    """
    made: dict[str, Any] = {
        "title": title,
        "command": f"python -m benchmarks {name}",
        "commit": at or commit(),
        "date": datetime.now(UTC).date().isoformat(),
        "machine": processor(),
        "versions": {"python": platform.python_version()} | {one: version(one) for one in VERSIONS},
        "figures": [asdict(figure) for figure in figures],
    }
    path = folder / f"{name}.json"
    path.write_text(json.dumps(made, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    return path


def table(path: Path) -> list[str]:
    """The figures of one file as a section of the page."""
    made = json.loads(path.read_text("utf-8"))
    figures = [Figure(**one) for one in made["figures"]]
    columns = list(dict.fromkeys(one.quantity for one in figures))
    found = {(one.sequence, one.quantity): one for one in figures}
    runs = sorted({one.runs for one in figures})
    lines = [f"## {made['title']}", "", "| | " + " | ".join(columns) + " |", "|---" * (len(columns) + 1) + "|"]
    for sequence in dict.fromkeys(one.sequence for one in figures):
        cells = [found[sequence, one].text() if (sequence, one) in found else "" for one in columns]
        lines.append(f"| {sequence} | " + " | ".join(cells) + " |")
    versions = ", ".join(f"{key} {value}" for key, value in (made["versions"] or {}).items())
    how = "" if runs == [1] else f", {' or '.join(map(str, runs))} runs each"
    name = made["command"].removeprefix("python -m benchmarks ")
    about = f"`{name}`{how}. Commit {made['commit']}, {made['date']}; {made['machine']}"
    lines += ["", about + (f"; {versions}." if versions else "."), ""]
    return lines


def page(folder: Path = FOLDER) -> list[str]:
    """All sections, in the order that `order.txt` of the folder gives."""
    names = (folder / "order.txt").read_text().split()
    return [line for name in names for line in table(folder / f"{name}.json")]
