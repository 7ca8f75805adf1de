"""`stereo-sfm diff`: compare two runs as a table, or two logs and show where they first differ."""

from __future__ import annotations

import argparse
from pathlib import Path

from stereo_sfm.errors import StereoSfmError, writing_to
from stereo_sfm.storage.remote import InputPath

CHECK_FAILED = 3


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this command."""
    parser.add_argument("a", type=InputPath, metavar="A", help="the folder of a run, or a log (.mcap)")
    parser.add_argument("b", type=InputPath, metavar="B", help="the other")
    parser.add_argument(
        "--topics", nargs="+", default=[], metavar="TOPIC", help="compare only these topics, of runs in their logs"
    )
    parser.add_argument(
        "-o", "--output", type=Path, metavar="DIR", help="of two runs: also write the page of 'stereo-sfm compare'"
    )
    parser.add_argument(
        "--tol", type=float, default=0.0, metavar="X", help="tolerance for numbers; of runs, those in their logs"
    )
    parser.add_argument(
        "--all", action="store_true", help="print the first difference of every topic, not only the first of all"
    )


def run(args: argparse.Namespace) -> int:
    """Print "identical" and return 0, or what differs and 3."""
    for path in (args.a, args.b):
        if not path.exists():
            raise StereoSfmError(f"no such file or folder: {path}")
    if args.a.is_dir() != args.b.is_dir():
        raise StereoSfmError("give two folders of runs, or two logs")
    if args.a.is_dir() and not (args.topics or args.all or args.tol):
        return _runs([args.a, args.b], args.output)
    if args.output is not None:
        raise StereoSfmError("--output is for two folders of runs, without --topics, --all and --tol")
    paths = [path / "run.mcap" if path.is_dir() else path for path in (args.a, args.b)]
    return _logs(paths[0], paths[1], list(args.topics), float(args.tol), bool(args.all))


def _runs(folders: list[Path], output: Path | None) -> int:
    """Two runs as a table: numbers, corrections, and the settings that differ."""
    from stereo_sfm.commands.compare import load_runs
    from stereo_sfm.eval.compare import changed_settings, compare, differences

    runs = load_runs(folders)
    rows, settings = differences(runs), changed_settings(folders)
    print("\n".join(_table([*rows, *([["settings that differ", "", ""], *settings] if settings else [])])))
    if output is not None:
        with writing_to(output):
            output.mkdir(parents=True, exist_ok=True)
            print(f"written to {compare(runs, output)}")
    if runs[0].stats["fingerprint"] == runs[1].stats["fingerprint"]:
        print("identical results (--topics or --all compare the logs)")
        return 0
    return CHECK_FAILED


def _table(rows: list[list[str]]) -> list[str]:
    widths = [max(len(row[k]) for row in rows) for k in range(2)]
    return [f"{what:<{widths[0]}}  {one:<{widths[1]}}  {other}".rstrip() for what, one, other in rows]


def _logs(path_a: Path, path_b: Path, only: list[str], tolerance: float, everything: bool) -> int:
    """The first difference of two logs."""
    from stereo_sfm.log.diff import configurations, diff
    from stereo_sfm.log.reader import LogReader

    with LogReader(path_a) as a, LogReader(path_b) as b:
        found = diff(a, b, only, tolerance)
        changed = configurations(a, b)
    if not found:
        print("identical")
        return 0
    for difference in found if everything else found[:1]:
        print(difference)
    more = len(found) - 1
    if more and not everything:
        print(f"and {more} more topic{'s differ' if more > 1 else ' differs'} (--all shows where)")
    if changed:
        print("the configurations differ: " + "; ".join(changed[:5]))
    return CHECK_FAILED
