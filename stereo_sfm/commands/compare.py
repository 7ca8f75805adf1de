"""`stereo-sfm compare`: several runs on one page."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from stereo_sfm.commands._options import typed
from stereo_sfm.errors import StereoSfmError, writing_to
from stereo_sfm.storage.remote import InputPath

if TYPE_CHECKING:
    from stereo_sfm.eval.compare import ComparedRun


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this command."""
    parser.add_argument("runs", nargs="+", type=InputPath, metavar="RUN", help="folder of a run")
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
    from stereo_sfm.eval import compare

    found = load_runs(options.runs, options.ref)
    with writing_to(options.output):
        options.output.mkdir(parents=True, exist_ok=True)
        page = compare.compare(found, options.output)
    print(f"written to {page}")
    if options.open:
        show(page)
    return 0


def load_runs(folders: Sequence[Path], ref: str | None = None) -> list[ComparedRun]:
    """The runs in these folders, with the ground truth in `ref`, else with their own if they have it.

    Raises:
        StereoSfmError: one is not the folder of a run, or is named twice.
    """
    from stereo_sfm.commands.eval import estimate_file, in_cam0, load, own_truth, pose_frame
    from stereo_sfm.drivers.ground_truth import read_trajectory
    from stereo_sfm.eval import compare

    names = compare.names_of(folders)
    if len(set(names)) < len(names):
        raise StereoSfmError(f"a run is named twice, name each once: {' '.join(map(str, folders))}")
    found: list[ComparedRun] = []
    for name, folder in zip(names, folders, strict=True):
        stats = compare.stats_of(folder)
        if ref is not None:
            estimate, truth = load(folder, None, ref)
        else:
            file = estimate_file(folder, None)
            estimate = read_trajectory(file)
            estimate = in_cam0(estimate, file) if pose_frame(file) == "body" else estimate
            try:
                truth = own_truth(folder)
            except StereoSfmError:
                truth = None
        found.append(compare.ComparedRun(name, stats, estimate, truth))
    return found
