"""How the processes of a run are started: forked from a process that has loaded their code and started no thread, where
possible. They share its memory, and none takes a second to load the same code."""

from __future__ import annotations

import multiprocessing
from multiprocessing import forkserver
from multiprocessing.context import ForkServerContext, SpawnContext

from stereo_sfm.pipeline.interrupts import ignored_by_children
from stereo_sfm.pipeline.threads import thread_environment


def start_context(threads: int) -> SpawnContext | ForkServerContext:
    """A context in which stages may be started; the process that they are forked from begins to load their code.

    Args: threads, that numeric libraries may use in each process.
    """
    if "forkserver" not in multiprocessing.get_all_start_methods():
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["stereo_sfm.pipeline.preload"])
    with ignored_by_children(), thread_environment(threads):
        forkserver.ensure_running()
    return context
