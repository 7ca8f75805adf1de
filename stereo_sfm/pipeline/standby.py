"""Stages that are started before they are needed: a service that loses its pipeline has poses again sooner.

Each waits for its set-up, capture for the source that it opens; the tracker has loaded its code.
"""

from __future__ import annotations

from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import Config
from stereo_sfm.pipeline.child import WarmUp
from stereo_sfm.pipeline.stage_graph import start_stages
from stereo_sfm.pipeline.stage_processes import StageProcesses


class Standby:
    """The processes of a run that has not begun."""

    def __init__(self, config: Config, rig: Rig) -> None:
        """Start them. Args: config, rig: of the run that goes on meanwhile, and probably of the next one."""
        self.stages = StageProcesses(config.pipeline.threads)
        self.outer = start_stages(self.stages, None, None, None, config.dense.live)
        self.stages.request("tracker", WarmUp(config, rig))

    @property
    def alive(self) -> bool:
        """Whether all of them wait; reads their heartbeats, so call it regularly."""
        try:
            for report in self.stages.reports:
                while report.poll(0):
                    report.recv_bytes()
        except (EOFError, OSError):
            return False
        return True

    def close(self) -> None:
        """End them."""
        self.stages.close(set())
        self.outer.close()
