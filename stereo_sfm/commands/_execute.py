"""One run from typed options to its folder: what `run` and `replay` do."""

from __future__ import annotations

import sys
import time
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from stereo_sfm.commands._progress import CompilationProgress, frame_state, progress
from stereo_sfm.commands._stop import INTERRUPTED, StopRequest
from stereo_sfm.errors import StereoSfmError, from_os_error

if TYPE_CHECKING:
    from stereo_sfm.commands._step import Stepper
    from stereo_sfm.config import Config
    from stereo_sfm.drivers.choice import SourceChoice
    from stereo_sfm.eval.record import RunRecord
    from stereo_sfm.log.recorded import RecordedRun
    from stereo_sfm.maps.folders import MapFolders
    from stereo_sfm.messages import Sink
    from stereo_sfm.pipeline.session import Session, Wiring
    from stereo_sfm.viz.match_images import MatchImages

TRACKING_FAILED = 4
INLINE_END_S = 3.0  # a run in one process waits this long for its source to stop
LOOK_S = 3.0  # after an interruption, for the plots of the report


@dataclass(frozen=True)
class RunOptions:
    """One run.

    Attributes:
        source: what is read. config: what decides the result. wiring: how the stages run, what is logged and shown.
        folders: the maps that it loads and saves.
        output: its folder; None: runs/DATE_NAME. overwrite: replace an existing run.
        frame: whose poses the trajectories hold, "cam0" or "body".
        max_lost_percent: frames without a pose above which the run counts as failed.
        matches: frames between two images of the matches; None: no images.
        quiet: no progress and no summary. verbose: print events.
        step_from_s: stop at every frame from this second on and wait for the user; None: do not stop.
        replayed: an earlier run whose schedule is followed.
        command: the command's name in messages.
    """

    source: SourceChoice
    config: Config
    wiring: Wiring
    folders: MapFolders
    output: Path | None = None
    overwrite: bool = False
    frame: str = "cam0"
    max_lost_percent: float = 20.0
    matches: int | None = None
    quiet: bool = False
    verbose: bool = False
    step_from_s: float | None = None
    replayed: RecordedRun | None = None
    command: str = "run"


def execute(options: RunOptions) -> tuple[int, Path]:
    """Run, write the output folder, print the closing summary: the exit code and the folder."""
    wiring = _wiring(options)
    if not wiring.inline:
        from stereo_sfm.pipeline.fork_server import start_context

        start_context(options.config.pipeline.threads)  # loads code while this process does
    from stereo_sfm.calib.camera_store import CorrectionKeeper
    from stereo_sfm.eval.record import RunRecord
    from stereo_sfm.eval.run_results import write_results
    from stereo_sfm.eval.statistics import failure, summary
    from stereo_sfm.export.run_folder import link_latest
    from stereo_sfm.pipeline.session import Session

    o = options
    o.source.refuse_to_overwrite(o.output)
    record = RunRecord.of(o.config, o.folders.localize_only)
    match_images, stepper = _match_images(o.matches), _stepper(o)
    shown = CompilationProgress()
    sinks = [*_sinks(o, record, match_images), shown]
    session = Session(o.source, o.config, sinks, wiring, o.folders, o.output, o.overwrite, o.replayed)
    with StopRequest(INLINE_END_S if wiring.inline else 0.0) as stop, closing(session):
        stop.then = session.stop
        with session:
            if match_images is not None:
                match_images.folder = session.folder / "matches"
            begin = time.perf_counter()
            interrupted, problem = _follow(session, record, stop, o.quiet or stepper is not None, stepper, shown)
            wall_s = time.perf_counter() - begin - session.waited_s(begin)
            stop.finished()
        stop.then = None
        if problem is not None or interrupted:
            record.warnings[f"the run ended early: {problem or 'it was interrupted'}"] = None
        folder, info = session.folder, session.info
        stats, evaluations = write_results(
            folder, info.name, info.rig, o.config, record, wall_s, info.ground_truth, o.frame, o.source.numbering,
            o.max_lost_percent, lambda: stop.since_s < LOOK_S,
        )  # fmt: skip
        CorrectionKeeper(o.source.camera_store, info.rig, info.given_rig).keep_last(record.calibrations)
        link_latest(folder)
    if not o.quiet:
        where = f"written to {folder} (start with {folder / 'report.md'}, or report.html)"
        print("\n".join([*summary(stats, evaluations), where]))
    if problem is not None:
        raise problem
    if interrupted:
        return INTERRUPTED, folder
    failed = failure(stats)
    if failed:
        print(f"stereo-sfm {o.command}: {failed}; see {folder / 'report.md'}", file=sys.stderr)
        return TRACKING_FAILED, folder
    return 0, folder


def _wiring(options: RunOptions) -> Wiring:
    """As asked for, but in one process when stepping, or when a sink needs the images."""
    from dataclasses import replace

    needs_inline = options.matches is not None or options.step_from_s is not None
    return replace(options.wiring, inline=options.wiring.inline or needs_inline)


def _sinks(options: RunOptions, record: RunRecord, match_images: MatchImages | None) -> list[Sink]:
    from stereo_sfm.log.events import EventLines

    sinks: list[Sink] = [record] if match_images is None else [record, match_images]
    return [*sinks, EventLines()] if options.verbose else sinks


def _match_images(every: int | None) -> MatchImages | None:
    if every is None:
        return None
    if every < 1:
        raise StereoSfmError(f"--matches must be at least 1, not {every}")
    from stereo_sfm.viz.match_images import MatchImages

    return MatchImages(every)


def _stepper(options: RunOptions) -> Stepper | None:
    if options.step_from_s is None:
        return None
    from stereo_sfm.commands._step import Stepper

    return Stepper(options.step_from_s)


def _follow(
    session: Session,
    record: RunRecord,
    stop: StopRequest,
    quiet: bool,
    stepper: Stepper | None,
    shown: CompilationProgress,
) -> tuple[bool, StereoSfmError | None]:
    """Run to the end, to Ctrl-C, or to an error; what was tracked so far stays in the record."""
    info = session.info
    with progress(info.name, info.frame_count, quiet) as bar:
        shown.bar = bar
        try:
            for frame in session:
                bar.step(frame_state(frame))
                if stepper is not None and not stepper.go_on(frame):
                    session.stop()
        except KeyboardInterrupt:
            return True, None
        except (StereoSfmError, OSError) as error:
            known = from_os_error(error) if isinstance(error, OSError) else error
            if known is None or not len(record.frames):
                raise
            return False, known
        return stop.asked, None
