"""The rows of `benchmarks fleet`, kept in a file so that a run that was broken off goes on with the next part."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

from _figures import Figure, commit


@dataclass(frozen=True)
class Row:
    """A sentence, whether it holds, and the figure that says so."""

    sentence: str
    holds: bool
    figure: str

    def text(self) -> str:
        return f"| {self.sentence} | {self.figure} | {'PASS' if self.holds else 'FAIL'} |"


class Verdicts:
    """Rows by part; those of an unchanged commit are read from the file."""

    def __init__(self, kept: Path | None) -> None:
        self._kept, self._part = kept, ""
        self._rows: dict[str, list[Row]] = {}
        if kept is not None and kept.is_file():
            known = json.loads(kept.read_text("utf-8"))
            if known["commit"] == commit():
                self._rows = {part: [Row(**row) for row in rows] for part, rows in known["parts"].items()}

    def begins(self, part: str) -> bool:
        """Whether a part is to be run; a known one is printed."""
        self._part = part
        for row in self._rows.get(part, []):
            print(row.text(), flush=True)
        return part not in self._rows

    def row(self, sentence: str, holds: bool, figure: str) -> None:
        """A result of the part that runs."""
        row = Row(sentence, holds, figure)
        self._rows.setdefault(self._part, []).append(row)
        print(row.text(), flush=True)

    def keep(self) -> None:
        """The part has ended."""
        if self._kept is not None:
            parts = {part: [vars(row) for row in rows] for part, rows in self._rows.items()}
            self._kept.write_text(json.dumps({"commit": commit(), "parts": parts}, indent=1), encoding="utf-8")

    @property
    def failed(self) -> bool:
        return any(not row.holds for rows in self._rows.values() for row in rows)

    def figures(self, parts: tuple[str, ...]) -> list[Figure]:
        """For the page of results, in the order of the parts."""
        rows = [row for part in parts for row in self._rows.get(part, [])]
        pairs = [
            (Figure(r.sentence, "measured", r.figure), Figure(r.sentence, "holds", "yes" if r.holds else "no"))
            for r in rows
        ]
        return [figure for pair in pairs for figure in pair]
