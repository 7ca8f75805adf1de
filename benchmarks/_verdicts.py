"""Rows of sentences that must hold, kept in a file so that a run that was broken off goes on with the next part.

The figures name each commit that made a part of them.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from _figures import Figure, commit, write


@dataclass(frozen=True)
class Row:
    """A sentence, whether it holds, and the figure that says so."""

    sentence: str
    holds: bool
    figure: str

    def text(self) -> str:
        return f"| {self.sentence} | {self.figure} | {'PASS' if self.holds else 'FAIL'} |"


class Verdicts:
    """Rows by part; those of the file are not measured again."""

    def __init__(self, kept: Path | None) -> None:
        self._kept, self._part = kept, ""
        self._rows: dict[str, list[Row]] = {}
        self._commits: dict[str, str] = {}
        if kept is not None and kept.is_file():
            known = json.loads(kept.read_text("utf-8"))
            self._commits = known["commits"]
            self._rows = {part: [Row(**row) for row in rows] for part, rows in known["rows"].items()}

    def begins(self, part: str) -> bool:
        """Whether a part is to be run; a known one is printed."""
        self._part = part
        for row in self._rows.get(part, []):
            print(row.text(), flush=True)
        return part not in self._rows

    def row(self, sentence: str, holds: bool, figure: str) -> None:
        """A result of the part that runs."""
        row = Row(sentence, bool(holds), figure)  # numpy has a bool of its own, which JSON does not know
        self._rows.setdefault(self._part, []).append(row)
        print(row.text(), flush=True)

    def keep(self) -> None:
        """The part has ended."""
        self._commits[self._part] = commit()
        if self._kept is not None:
            rows = {part: [vars(row) for row in rows] for part, rows in self._rows.items()}
            self._kept.write_text(json.dumps({"commits": self._commits, "rows": rows}, indent=1), encoding="utf-8")

    @property
    def failed(self) -> bool:
        return any(not row.holds for rows in self._rows.values() for row in rows)

    def write(self, parts: Sequence[str], name: str, title: str) -> Path:
        """Replace the benchmark's figures, in the order of the parts."""
        figures: list[Figure] = []
        for row in (row for part in parts for row in self._rows.get(part, [])):
            holds = "yes" if row.holds else "no"
            figures += [Figure(row.sentence, "measured", row.figure), Figure(row.sentence, "holds", holds)]
        made = dict.fromkeys(self._commits[part] for part in parts if part in self._commits)
        return write(name, title, figures, at=", ".join(made))
