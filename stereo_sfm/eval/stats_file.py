"""What other commands read of a run's numbers (stats.json): checked where it enters."""

from __future__ import annotations

from itertools import chain
from typing import Any

NUMBERS = ("frames", "lost_percent", "keyframes", "loops_accepted", "path_m", "frames_per_s", "dropped", "pieces")
MOST = 1 << 53  # that a number of any unit can be


def checked_stats(stats: Any) -> dict[str, Any]:
    """The numbers of a run as they are.

    Raises:
        ValueError: one that tables and pages show is missing, or is something else.
    """
    try:
        numbers = chain(
            (stats[name] for name in NUMBERS),
            (times["p50"] for times in stats["ms"].values()),
            (result["ape_m"]["rmse"] for result in stats["evaluation"].values()),
        )
        texts = chain([stats["fingerprint"]], (change["text"] for change in stats["calibration"]))
        whole = all(map(_is_number, numbers)) and all(isinstance(text, str) for text in texts)
        whole = whole and isinstance(stats["lost_intervals"], list)
    except (LookupError, TypeError, AttributeError):
        whole = False
    if not whole:
        raise ValueError("these are not the numbers of a run")
    return stats


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not abs(value) > MOST
