"""Words that must be one of a list: what was probably meant when they are not."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

from stereo_sfm.errors import StereoSfmError

_ALIKE = 0.6  # similarity (difflib's ratio) above which a known word is taken to be meant


def guess(word: str, among: Iterable[str]) -> str:
    """The known word that is most like this one, whatever the case; "" when none is."""
    known = {name.lower(): name for name in among}
    found = difflib.get_close_matches(word.lower(), known, n=1, cutoff=_ALIKE)
    return known[found[0]] if found else ""


def did_you_mean(word: str, among: Iterable[str]) -> str:
    """For the end of a message: ": did you mean 'aisle'?", or "" when no known word is like this one."""
    found = guess(word, among)
    return f": did you mean '{found}'?" if found else ""


def one_of(word: str, among: Iterable[str], what: str) -> str:
    """The word, which must be one of a list.

    Args:
        word: as the user wrote it.
        among: the words that are known.
        what: what such a word stands for, for the message: "scene", "projection".

    Raises:
        StereoSfmError: it is none of them; with the nearest one and all of them.
    """
    known = tuple(among)
    if word in known:
        return word
    raise StereoSfmError(f"unknown {what} '{word}'{did_you_mean(word, known)} (choose from {', '.join(known)})")
