"""`stereo-sfm compare`: several runs on one page."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

from stereo_sfm.commands._options import typed
from stereo_sfm.errors import StereoSfmError, writing_to


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this command."""
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="folder of a run")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="folder of page and tables")
    parser.add_argument("--ref", help="ground truth: a trajectory file, or a source that has it (default: of the runs)")
    parser.add_argument("--open", action="store_true", help="show the page in a browser")


@dataclass(frozen=True)
class CompareOptions:
    """Options of this command, as the parser names them."""

    runs: list[Path]
    output: Path
    ref: str | None
    open: bool


def run(args: argparse.Namespace) -> int:
    """Write the page and print where it is."""
    options = typed(CompareOptions, args)
    from stereo_sfm.commands._browser import show
    from stereo_sfm.commands.eval import estimate_file, load, own_truth
    from stereo_sfm.drivers.ground_truth import read_trajectory
    from stereo_sfm.eval import compare

    names = compare.names_of(options.runs)
    if len(set(names)) < len(names):
        raise StereoSfmError("compare: the same run is named twice")
    found: list[compare.ComparedRun] = []
    for name, folder in zip(names, options.runs, strict=True):
        stats = compare.stats_of(folder)
        if options.ref is not None:
            estimate, truth = load(folder, None, options.ref)
        else:
            estimate = read_trajectory(estimate_file(folder, None))
            try:
                truth = own_truth(folder)
            except StereoSfmError:
                truth = None
        found.append(compare.ComparedRun(name, stats, estimate, truth))
    with writing_to(options.output):
        options.output.mkdir(parents=True, exist_ok=True)
        page = compare.compare(found, options.output)
    print(f"written to {page}")
    if options.open:
        show(page)
    return 0
