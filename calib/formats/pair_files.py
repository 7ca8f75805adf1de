"""Files of a left and a right camera beside each other, by their names: left.yaml and right.yaml, infra1 and infra2."""

from __future__ import annotations

import re
from pathlib import Path

# Words of the left and the right camera. A number pairs with the next one, whatever stands before it (cam0, infra1).
_WORDS = (("left", "right"), ("l", "r"))
_WORD = re.compile(r"[A-Za-z]+|\d+")


def partner(left: Path) -> Path | None:
    """The right camera's file of a left camera's, None where there is none."""
    return next((file for name in right_names(left.name) if (file := left.with_name(name)).is_file()), None)


def right_names(name: str) -> list[str]:
    """What the right camera's file may be called: one word or number of the left one's name exchanged.

    Whole words of letters, so that the l of "calib" is none, then the last number: 0 and 1, 1 and 2, a pair's both ways
    of counting.
    """
    found: list[str] = []
    matches = list(_WORD.finditer(Path(name).stem))
    for match in matches:
        for one, other in _WORDS:
            if match[0].lower() == one:
                new = other.upper() if match[0].isupper() else other.capitalize() if match[0][0].isupper() else other
                found.append(name[: match.start()] + new + name[match.end() :])
    for match in reversed(matches):
        if match[0].isdigit() and int(match[0]) <= 1:
            found.append(name[: match.start()] + f"{int(match[0]) + 1:0{len(match[0])}d}" + name[match.end() :])
    return found


def left_files(folder: Path, *suffixes: str) -> list[Path]:
    """Files of a folder that have a partner, in the order of their names."""
    return [p for p in sorted(folder.iterdir()) if p.suffix in suffixes and p.is_file() and partner(p) is not None]
