"""`stereo-sfm diff`: compare two logs and show where they first differ."""

from __future__ import annotations

import argparse
from pathlib import Path

CHECK_FAILED = 3


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this command."""
    parser.add_argument("a", type=Path, metavar="A.mcap", help="one log")
    parser.add_argument("b", type=Path, metavar="B.mcap", help="the other")
    parser.add_argument("--topics", nargs="+", default=[], metavar="TOPIC", help="compare only these")
    parser.add_argument("--tol", type=float, default=0.0, metavar="X", help="tolerance for numbers")
    parser.add_argument(
        "--all", action="store_true", help="print the first difference of every topic, not only the first of all"
    )


def run(args: argparse.Namespace) -> int:
    """Print "identical" and return 0, or the first difference and 3."""
    from stereo_sfm.log.diff import configurations, diff
    from stereo_sfm.log.reader import LogReader

    with LogReader(args.a) as a, LogReader(args.b) as b:
        found = diff(a, b, args.topics, args.tol)
        changed = configurations(a, b)
    if not found:
        print("identical")
        return 0
    for difference in found if args.all else found[:1]:
        print(difference)
    more = len(found) - 1
    if more and not args.all:
        print(f"and {more} more topic{'s differ' if more > 1 else ' differs'} (--all shows where)")
    if changed:
        print("the configurations differ: " + "; ".join(changed[:5]))
    return CHECK_FAILED
