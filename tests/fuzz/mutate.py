"""Seeded damage to files: bytes for any format, words and lines for text, values of JSON."""

from __future__ import annotations

import json
import random
from typing import Any

WORDS = ("nan", "inf", "-1", "0", "1e308", "-1e-308", "9" * 20, "null", "true", "[]", "{}", '""', "é", "%")
VALUES: tuple[Any, ...] = (
    None, True, "", "x", -1, 0, 0.5, 1e308, 1 << 70, float("nan"), float("inf"), [], {}, [[]], [1, "x"], {"a": 1},
)  # fmt: skip


def damaged(data: bytes, rng: random.Random) -> bytes:
    """One to four changes: cut, repeat, swap, overwrite, flip, make a number huge."""
    out = bytearray(data)
    for _ in range(rng.randrange(1, 5)):
        at = rng.randrange(len(out) + 1)
        size = rng.choice((1, 2, 4, 8, 64, 4096))
        kind = rng.randrange(6)
        if kind == 0:
            del out[at : at + size]
        elif kind == 1:
            out[at:at] = out[at : at + size]
        elif kind == 2:
            out[at : at + size] = rng.randbytes(min(size, len(out) - at))
        elif kind == 3 and at < len(out):
            out[at] ^= 1 << rng.randrange(8)
        elif kind == 4:
            out[at : at + size] = rng.choice((b"\xff", b"\x00", b"\x7f")) * min(size, len(out) - at)
        elif rng.random() < 0.3:
            del out[at:]
    return bytes(out)


def damaged_text(text: str, rng: random.Random) -> str:
    """One to four changes: words exchanged, lines left out, repeated, indented, brackets lost."""
    lines = text.splitlines(keepends=True)
    for _ in range(rng.randrange(1, 5)):
        if not lines:
            break
        at = rng.randrange(len(lines))
        kind = rng.randrange(6)
        if kind == 0:
            del lines[at]
        elif kind == 1:
            lines.insert(at, lines[rng.randrange(len(lines))])
        elif kind == 2:
            lines[at] = "  " + lines[at]
        elif kind == 3:
            lines[at] = lines[at].replace(rng.choice("[]{}:,=\"'"), rng.choice(("", "[", "}", ":", "\t")), 1)
        else:
            words = lines[at].split(" ")
            words[rng.randrange(len(words))] = rng.choice(WORDS)
            lines[at] = " ".join(words)
            lines[at] += "" if lines[at].endswith("\n") else "\n"
    return "".join(lines)


def damaged_json(text: str, rng: random.Random) -> str:
    """One to three values, at any depth, exchanged, left out or written twice."""
    data: Any = json.loads(text)
    for _ in range(rng.randrange(1, 4)):
        if rng.random() < 0.05:
            data = rng.choice(VALUES)
        parts = [part for part in _inside(data) if part]
        if not parts:
            break
        part = data if data and rng.random() < 0.4 else rng.choice(parts)
        key = rng.choice(list(part) if isinstance(part, dict) else range(len(part)))
        if rng.random() < 0.3:
            del part[key]
        else:
            part[key] = rng.choice((*VALUES, [part[key]] * 2))
    return json.dumps(data)


def _inside(data: Any) -> list[Any]:
    """All lists and mappings in a value, itself among them."""
    if not isinstance(data, dict | list):
        return []
    values: Any = data.values() if isinstance(data, dict) else data  # pyright: ignore[reportUnknownMemberType]
    return [data, *(part for value in values for part in _inside(value))]
