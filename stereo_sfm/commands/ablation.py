"""`stereo-sfm ablation`: features, estimators and modules of the papers on any sources, and the default system."""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from stereo_sfm.commands._options import typed
from stereo_sfm.commands._progress import progress
from stereo_sfm.commands._stop import INTERRUPTED, StopRequest
from stereo_sfm.errors import StereoSfmError, did_you_mean

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from stereo_sfm.eval.ablation import Cell

# configuration that distinguishes the cells -> the option that chooses it
DECIDED = {
    "seed": "--seed",
    "features.kind": "--features",
    "odometry.method": "--odometry",
    "mapper.enabled": "--stages",
    "loop.enabled": "--stages",
    "loop.correction": "--stages",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this command."""
    parser.add_argument("sources", nargs="+", metavar="SOURCE", help="dataset folders, recordings, sim:SCENE")
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="DIR", help="folder of tables, plots and results"
    )
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="number of parallel processes")
    parser.add_argument("--frames", type=int, default=0, metavar="N", help="use at most N frames of each source")
    parser.add_argument("--features", metavar="A,B", help="some of orb, sift, akaze (default: all)")
    parser.add_argument("--odometry", metavar="A,B", help="motion estimators (default: em-r, vp-r, r-um, um)")
    parser.add_argument(
        "--stages", metavar="A,B", help="some of tracking, mapping, averaging, pose_graph (default: all)"
    )
    parser.add_argument("--systems", metavar="A,B", help="presets to add (default: all; none: omit them)")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="set one value in every cell, as in odometry.refine=false",
    )
    parser.add_argument("--seed", type=int, default=0, help="random seed")
    parser.add_argument("--again", action="store_true", help="recompute cells that have a result")
    parser.add_argument("-q", "--quiet", action="store_true", help="no progress")


@dataclass(frozen=True)
class AblationOptions:
    """Options of this command, as the parser names them."""

    sources: list[str]
    output: Path
    jobs: int
    frames: int
    features: str | None
    odometry: str | None
    stages: str | None
    systems: str | None
    set: list[str]
    seed: int
    again: bool
    quiet: bool


def run(args: argparse.Namespace) -> int:
    """Run what is missing, then write the report over everything asked for."""
    return ablation(typed(AblationOptions, args))


def ablation(options: AblationOptions) -> int:
    """The exit code."""
    from stereo_sfm.eval.ablation import finished, load_result
    from stereo_sfm.eval.ablation_report import write_report

    cells = _cells(options)
    folder, store = options.output, options.output / "cells"
    missing = [cell for cell in cells if options.again or not finished(load_result(store / cell.file_name))]
    _check_sources(missing)
    store.mkdir(parents=True, exist_ok=True)
    whole = not missing or _run_all(missing, store, options.jobs, options.quiet, len(cells))
    results = [result for cell in cells if (result := load_result(store / cell.file_name)) is not None]
    report = write_report(folder, results)
    if not whole:
        print(
            f"interrupted with {len(results)} of {len(cells)} cells; run the same command to continue: {report}",
            file=sys.stderr,
        )
        return INTERRUPTED
    if not options.quiet:
        good = sum(result["status"] == "ok" for result in results)
        print(f"{good} of {len(cells)} cells with a result, {len(cells) - good} without, see the reasons in {report}")
    return 0


def _cells(options: AblationOptions) -> list[Cell]:
    from stereo_sfm.config import estimator_names
    from stereo_sfm.eval import ablation
    from stereo_sfm.papers.extraction import TABLE as FEATURES
    from stereo_sfm.presets import PRESETS

    if options.jobs < 1 or options.frames < 0:
        raise StereoSfmError("--jobs must be at least 1 and --frames at least 0")
    for setting in options.set:
        key = setting.partition("=")[0].strip()
        if key in DECIDED:
            raise StereoSfmError(f"--set {key} has no effect here: use {DECIDED[key]} to choose the cells")
    return ablation.grid(
        _different(options.sources),
        _chosen(options.features, ablation.FEATURES, FEATURES, "features"),
        _chosen(options.odometry, ablation.ESTIMATORS, estimator_names(), "odometry"),
        _chosen(options.stages, tuple(ablation.STAGES), ablation.STAGES, "stages"),
        () if options.systems == "none" else _chosen(options.systems, ablation.SYSTEMS, PRESETS, "systems"),
        options.frames,
        options.seed,
        options.set,
    )


def _different(sources: Sequence[str]) -> list[str]:
    """Each source once, as it was first written."""
    found: dict[str, str] = {}
    for source in sources:
        found.setdefault(str(Path(source).resolve()) if Path(source).exists() else source, source)
    return list(found.values())


def _check_sources(cells: Sequence[Cell]) -> None:
    """Check, before anything is computed, that every source can be opened and has ground truth with rotations.

    Raises:
        StereoSfmError: one cannot be opened or has none.
    """
    from stereo_sfm.drivers.source import open_source

    for spec in dict.fromkeys(cell.source for cell in cells):
        with open_source(spec) as source:
            if source.ground_truth is None:
                raise StereoSfmError(
                    f"{source.name} has no ground truth to compare with: choose a source that has, as sim:loop"
                )
            if not source.ground_truth.oriented:
                raise StereoSfmError(
                    f"{source.name} has a ground truth of positions alone, and the papers compare rotations, too: "
                    "choose another source"
                )


def _chosen(text: str | None, default: Sequence[str], known: Iterable[str], what: str) -> Sequence[str]:
    if text is None:
        return default
    names = [name.strip() for name in text.split(",") if name.strip()]
    wrong = [name for name in names if name not in set(known)]
    if wrong or not names:
        near = did_you_mean(wrong[0], known) if wrong else ""
        raise StereoSfmError(f"--{what}: unknown '{', '.join(wrong) or text}'{near} (there are: {', '.join(known)})")
    return names


def _run_all(cells: Sequence[Cell], store: Path, jobs: int, quiet: bool, total: int) -> bool:
    """Distribute the cells over processes; each file is written by the process that computed it.

    After Ctrl-C the running cells are finished and no other is started.

    Returns:
        Whether all cells were run.
    """
    import multiprocessing
    from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
    from concurrent.futures.process import BrokenProcessPool

    from stereo_sfm.eval.ablation_worker import compute, one_thread
    from stereo_sfm.pipeline.interrupts import ignored_by_children

    spawn = multiprocessing.get_context("spawn")
    left, running = list(reversed(cells)), dict[Future[str], str]()
    with (
        ProcessPoolExecutor(jobs, mp_context=spawn, initializer=one_thread) as pool,
        progress("ablation", total, quiet, "cells", total - len(cells)) as bar,
        StopRequest() as stop,
    ):
        try:
            while True:
                # Not all at once: jobs waiting in the pool could not be cancelled.
                while left and len(running) < jobs and not stop.asked:
                    cell = left.pop()
                    with ignored_by_children():
                        job = pool.submit(compute, cell, store / cell.file_name)
                    running[job] = f"{Path(cell.source).name} {cell.name}"
                if not running:
                    return not left
                for done in wait(running, return_when=FIRST_COMPLETED).done:
                    name = running.pop(done)
                    bar.step(name, f"{name}: {done.result()}")
        except BrokenProcessPool:
            if stop.asked:
                return False
            raise StereoSfmError(
                "a process died while it computed a cell (too little memory? try fewer --jobs); "
                "finished cells are kept, run the same command to continue"
            ) from None
        except KeyboardInterrupt:
            for child in multiprocessing.active_children():
                child.terminate()
            raise
