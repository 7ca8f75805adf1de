"""Seeded damage to files: bytes for any format, words and lines for text."""

from __future__ import annotations

import random

WORDS = ("nan", "inf", "-1", "0", "1e308", "-1e-308", "9" * 20, "null", "true", "[]", "{}", '""', "é", "%")


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
