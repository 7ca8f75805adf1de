"""`stereo-sfm compile`: compile the numerical kernels, as the last step of an installation."""

from __future__ import annotations

import argparse
import sys


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this command."""
    parser.add_argument("-q", "--quiet", action="store_true", help="do not print what is compiled")


def run(args: argparse.Namespace) -> int:
    """Run every stage once on synthetic images; later runs load the compiled kernels."""
    from stereo_sfm.config import Config
    from stereo_sfm.demo import demo_recording
    from stereo_sfm.drivers.source import open_source
    from stereo_sfm.kernel_cache import listening
    from stereo_sfm.mapping.mapper import run_job
    from stereo_sfm.pipeline.warm_up import scratch_job, warm_up_stage

    def report(kernel: str) -> None:
        if not args.quiet:
            print(f"compiling {kernel}", file=sys.stderr)

    with listening(report) as compilation, open_source(str(demo_recording())) as source:
        for stage in ("tracker", "mapper", "loop"):
            warm_up_stage(stage, Config(), source.rig)
        job = scratch_job(Config(), source.rig)
        if job is not None:
            run_job(job)
    if not args.quiet:
        print(f"{compilation.kernels} kernels compiled in {compilation.seconds:.0f} s; later runs start at once")
    return 0
