"""Which stage is connected with which.

    capture -> tracker, dense        images by slot
    tracker -> mapper                keyframes
    main    -> loop                  keyframes
    main    -> mapper                loop results
    mapper  -> tracker               updates
    mapper <-> optimizer             full bundle adjustment
    tracker, logger, dense -> capture    slots that are free again
    every stage -> main -> logger, viewer

Every arrow is a pipe of its own, so a killed process leaves no lock behind, and its death is an end of file to its
readers.
"""

from __future__ import annotations

from dataclasses import dataclass
from multiprocessing.connection import Connection

from stereo_sfm.drivers.choice import Opener
from stereo_sfm.pipeline import depth_stage, logger, viewer, workers
from stereo_sfm.pipeline.channels import Outbox
from stereo_sfm.pipeline.logger import LogOptions
from stereo_sfm.pipeline.logger_link import LoggerLink
from stereo_sfm.pipeline.loop_link import LoopLink
from stereo_sfm.pipeline.stage_processes import StageProcesses
from stereo_sfm.pipeline.viewer import ViewerLink, ViewerOptions


@dataclass(frozen=True)
class OuterEnds:
    """Where main sends messages; each None where there is none."""

    loop: LoopLink | None = None
    logger: LoggerLink | None = None
    viewer: ViewerLink | None = None
    release: Outbox | None = None  # of images that main reads in place of a logger

    def close(self) -> None:
        """Close the pipes, whose readers have ended, and end the threads that write into them."""
        for end in (self.loop, self.logger, self.viewer, self.release):
            if end is not None:
                end.close()


def start_stages(
    stages: StageProcesses,
    opener: Opener | None,
    log: LogOptions | None,
    viewer_options: ViewerOptions | None,
    live_depth: bool = False,
) -> OuterEnds:
    """Start the processes of a run with the pipes between them. Args: opener, of the source; None: it is sent later."""
    pipe, spawn = stages.pipe, stages.spawn
    images, updates = pipe(), pipe()
    to_mapper, loops = pipe(), pipe()
    jobs, results = pipe(), pipe()
    tracker_free, second_free = pipe(), pipe()
    logged, shown = pipe(), pipe()
    depth = (pipe(), pipe()) if live_depth else ()  # images to it, slots from it
    slots = (tracker_free[0], second_free[0], *(back[0] for back in depth[1:]))
    spawn("capture", workers.run_capture, opener, images[1], slots, depth[0][1] if depth else None)
    if depth:
        spawn("dense", depth_stage.run_depth, depth[0][0], depth[1][1])
    spawn("tracker", workers.run_tracker, images[0], tracker_free[1], updates[0], to_mapper[1])
    spawn("mapper", workers.run_mapper, to_mapper[0], loops[0], updates[1], jobs[1], results[0])

    def begin_loop() -> Connection:
        keyframes = pipe()
        spawn("loop", workers.run_loop, keyframes[0])
        keyframes[0].close()
        return keyframes[1]

    loop = LoopLink(begin_loop, loops[1])
    spawn("optimizer", workers.run_optimizer, jobs[0], results[1])
    if log is not None:
        spawn("logger", logger.run_logger, logged[0], second_free[1], log)
    if viewer_options is not None:
        spawn("viewer", viewer.run_viewer, shown[0], viewer_options)
    kept = {
        loops[1]: True,
        second_free[1]: log is None,
        logged[1]: log is not None,
        shown[1]: viewer_options is not None,
    }
    for ends in (images, updates, to_mapper, loops, jobs, results, tracker_free, second_free, logged, shown, *depth):
        for end in ends:
            if not kept.get(end, False):
                end.close()  # only the stages hold these: their death must be seen as an end of file
    return OuterEnds(
        loop,
        None if log is None else LoggerLink(log, logged[1], stages),
        None if viewer_options is None else ViewerLink(shown[1]),
        Outbox(second_free[1], 64) if log is None else None,
    )
