"""Stages that are started before they are needed: a service that loses its pipeline has poses again sooner.

Each waits for its set-up, capture for the source that it opens. Both have loaded their code; the tracker has what it
computes of the calibration.
"""

from __future__ import annotations

from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import Config
from stereo_sfm.pipeline.child import WarmUp
from stereo_sfm.pipeline.stage_graph import start_stages
from stereo_sfm.pipeline.stage_processes import StageProcesses
from stereo_sfm.pipeline.watchdog import STOPPED, process_state


class Standby:
    """The processes of a run that has not begun."""

    def __init__(self, config: Config, rig: Rig, modules: tuple[str, ...] = ()) -> None:
        """Start them.

        Args: config, rig, modules: of the run that goes on meanwhile (`SourceInfo`), and probably of the next one.
        """
        self.stages = StageProcesses(config.pipeline.threads)
        self.outer = start_stages(self.stages, None, None, None, config.dense.live)
        for stage in ("tracker", "capture"):
            self.stages.request(stage, WarmUp(config, rig, modules))

    @property
    def alive(self) -> bool:
        """Whether all of them wait; reads their heartbeats, so call it regularly."""
        try:
            for report in self.stages.reports:
                while report.poll(0):
                    report.recv_bytes()
        except (EOFError, OSError):
            return False
        return not any(process_state(pid) in STOPPED for pid in self.stages.pids.values())

    def close(self) -> None:
        """End them."""
        self.stages.close(set(), wait=False)
        self.outer.close()
