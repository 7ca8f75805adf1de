"""Names of the two cameras of a pair: topics, folders and files whose names differ in nothing but the side.

Names are split into words and numbers (`/cam_left/imageRaw0`: cam, left, image, raw, 0), so that "direct" does not
contain "rect".
"""

from __future__ import annotations

import re
from collections.abc import Sequence

LEFT_RIGHT = (("left", "right"), ("l", "r"))  # words, the most usual first


def words_of(name: str) -> list[str]:
    """The words and numbers of a name, in lower case."""
    return [part.lower() for part in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])|[0-9]+", name)]


def side_pairs(names: Sequence[str]) -> list[tuple[str, str]]:
    """(left, right) of the names that differ in nothing but the side, most certain first.

    Sides are the words left and right (also at the beginning or end of a word) or l and r, else numbers that follow
    each other: cam0 and cam1, fisheye1 and fisheye2.
    """
    split = {name: words_of(name) for name in names}
    found = [(rank, a, b) for a in names for b in names if a != b and (rank := _rank(split[a], split[b])) is not None]
    place = {name: k for k, name in enumerate(names)}
    return [(a, b) for _, a, b in sorted(found, key=lambda row: (row[0], place[row[1]], place[row[2]]))]


def _rank(left: list[str], right: list[str]) -> tuple[int, int] | None:
    """How certain two names are left and right, the least most; None if they are not."""
    if len(left) != len(right):
        return None
    ranks = {_word_rank(a, b) for a, b in zip(left, right, strict=True) if a != b}
    return ranks.pop() if len(ranks) == 1 else None


def _word_rank(left: str, right: str) -> tuple[int, int] | None:
    if left.isdecimal() and right.isdecimal():
        return (len(LEFT_RIGHT), int(left)) if int(right) == int(left) + 1 else None
    for k, (one, other) in enumerate(LEFT_RIGHT):
        if (left, right) == (one, other):
            return k, 0
        if len(one) > 1 and (
            (left.startswith(one) and right == other + left[len(one) :])
            or (left.endswith(one) and right == left[: -len(one)] + other)
        ):
            return k, 1
    return None
