"""What every process of a run shares: its entry, its messages to main, and the set-up that main sends."""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import sys
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from typing import Any

from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import STAGES, Config
from stereo_sfm.errors import StereoSfmError, from_os_error
from stereo_sfm.log.provenance import Opening
from stereo_sfm.maps.folders import MapFolders
from stereo_sfm.messages import Compiling
from stereo_sfm.pipeline.allocator import return_large_blocks
from stereo_sfm.pipeline.channels import End, Failed, Lost, Outbox
from stereo_sfm.pipeline.interrupts import STOP_SIGNALS
from stereo_sfm.pipeline.text import LOGGER, Listener
from stereo_sfm.pipeline.watchdog import HeartbeatThread
from stereo_sfm.types import Applied, Trajectory

# Beside a live camera the pose comes first: what the others take must not delay it, if all share one core.
NICENESS = {"logger": 2, "mapper": 4, "loop": 6, "optimizer": 8, "dense": 10}
LOWEST_PRIORITY = 19
RAISED = -5  # of a service's poses, where the system permits it: as much as others that share the core three times over
AT_CAMERA_RATE = "capture", "tracker"  # their arrays are of the same sizes with every image
HELPER = "loop"  # compiles a part of what the tracker needs in a first run, before its own kernels
UPSTREAM_LOST = 70  # exit code of a worker that ended because another one died


@dataclass(frozen=True, eq=False)
class Setup:
    """What every stage gets once the source is open."""

    rig: Rig
    config: Config
    ground_truth: Trajectory | None
    source_name: str
    ring_name: str
    applied: tuple[Applied, ...] | None  # a recorded schedule to repeat
    realtime: bool
    folders: MapFolders
    delays: int | None  # seed of random delays in every stage (tests)
    opening: Opening = field(default_factory=Opening)  # of the source
    depth_frames: frozenset[int] | None = None  # of a recorded run: which images get a live depth
    pose_first: bool = False  # the first pose waits for the code of the first image only


@dataclass(frozen=True, eq=False)
class WarmUp:
    """A request before the set-up: load the code for images of such a rig, and what opening its source takes."""

    config: Config
    rig: Rig
    modules: tuple[str, ...] = ()  # of the source


class Report(Outbox):
    """The messages of a worker to main, with its heartbeat."""

    def __init__(self, stage: str, connection: Connection) -> None:
        super().__init__(connection, 512)
        self.pulse = HeartbeatThread(stage, self.send)


def guarded(stage: str, body: Callable[..., None], report: Connection, *args: Any) -> None:
    """Entry of every worker process."""
    for number in STOP_SIGNALS:
        signal.signal(number, signal.SIG_IGN)  # main handles Ctrl-C
    to_main = Report(stage, report)
    logging.getLogger(LOGGER).setLevel(logging.INFO)  # main decides what is printed
    try:
        with Listener(stage, to_main.send), to_main.pulse:
            body(to_main, *args)
        to_main.send(End(stage))
        to_main.close()
    except Lost:
        sys.stdout.flush()
        os._exit(UPSTREAM_LOST)
    except StereoSfmError as error:
        to_main.send(Failed(stage, str(error), True, error.exit_code))
        to_main.close()
        os._exit(error.exit_code)
    except BaseException as error:
        known = from_os_error(error) if isinstance(error, OSError) else None
        failed = (
            Failed(stage, str(known), True, known.exit_code)
            if known
            else Failed(stage, traceback.format_exc(), False, 1)
        )
        to_main.send(failed)
        to_main.close()
        os._exit(failed.exit_code)


@dataclass(frozen=True)
class Ready:
    """The stage has loaded what it needs; a run begins when all are ready."""

    stage: str


def ready(
    stage: str, setup: Setup, to_main: Outbox, then: Callable[[], None] = lambda: None, warm: bool = False
) -> None:
    """Load the stage's code and send `Ready`; one helps the tracker first.

    Args: then, called between the two. warm: its code is loaded.
    """
    from stereo_sfm.kernel_cache import listening
    from stereo_sfm.pipeline.first_kernels import help_tracker
    from stereo_sfm.pipeline.warm_up import warm_up_stage

    with listening(lambda kernel: to_main.send(Compiling(stage, kernel))):
        if stage == HELPER:
            help_tracker(setup.config, setup.rig)
        if not warm:
            warm_up_stage(stage, setup.config, setup.rig, patient=not setup.realtime or setup.pose_first)
    then()
    to_main.send(Ready(stage))


def raise_priority(stage: str = "") -> None:
    """Let this thread, and the processes and threads that it starts, go before others of the computer (`RAISED`).

    Root may do that, and who has such a limit (`LimitNICE`); for others nothing changes.

    Args: stage, which gives way to the poses as this one does.
    """
    with contextlib.suppress(OSError, AttributeError):
        own = os.getpriority(os.PRIO_PROCESS, 0)
        os.setpriority(os.PRIO_PROCESS, 0, min(own, RAISED) + NICENESS.get(stage, 0))


def lower_priority(stage: str) -> None:
    """Let the stages that make the pose go first (`NICENESS`)."""
    if hasattr(os, "setpriority"):
        own = os.getpriority(os.PRIO_PROCESS, 0)
        os.setpriority(os.PRIO_PROCESS, 0, min(own + NICENESS.get(stage, 0), LOWEST_PRIORITY))


def prepare(stage: str, setup: Setup) -> Callable[[], None]:
    """Threads and cores of this process; returns what injects a random delay (tests) or nothing."""
    import cv2
    from threadpoolctl import threadpool_limits

    if setup.realtime:
        lower_priority(stage)
    if stage not in AT_CAMERA_RATE:
        return_large_blocks()
    cv2.setNumThreads(setup.config.pipeline.threads)
    threadpool_limits(setup.config.pipeline.threads)  # the environment: of a program's first run only
    cpus = setup.config.pipeline.cpus.get(stage)
    if cpus and hasattr(os, "sched_setaffinity"):
        try:
            os.sched_setaffinity(0, cpus)
        except OSError:
            raise StereoSfmError(f"configuration: pipeline.cpus.{stage} is {list(cpus)}: no such core here") from None
    if setup.delays is None:
        return lambda: None
    import numpy as np

    rng = np.random.default_rng([setup.delays, STAGES.index(stage)])
    return lambda: time.sleep(float(rng.exponential(0.01)) if rng.random() < 0.3 else 0.0)
