"""What every mapper can be asked."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from stereo_sfm.types import F64, RIG_TERMS, Keyframe, LoopResult, MapUpdate

if TYPE_CHECKING:
    from stereo_sfm.calib.rig import Rig
    from stereo_sfm.mapping.bundle import BundleResult
    from stereo_sfm.mapping.mapper import Job
    from stereo_sfm.mapping.snapshot import MapSnapshot


class AnyMapper(ABC):
    """Turns keyframes into map updates: the mapper, or the localizer in a finished map.

    As it stands here it makes no map, leaves no work to other processes, and knows no saved map.
    """

    found = False  # whether updates are in the frame of the saved map that the run began with

    def __init__(self, rig: Rig) -> None:
        """Args: rig, as the run begins."""
        self.rig = self._source_rig = rig  # `rig` is the one that the map is true of
        self._terms: F64 = np.zeros(RIG_TERMS)  # of its correction so far

    @property
    def calibration(self) -> tuple[Rig, F64]:
        """The rig as the run began, and the terms (8,) that make it that of the map."""
        return self._source_rig, self._terms

    @abstractmethod
    def step(self, keyframe: Keyframe, loop: LoopResult | None = None) -> MapUpdate:
        """The update that answers a keyframe. Args: loop, the closer's result for an earlier one, or none."""

    def finish(self, loops: Sequence[LoopResult]) -> MapUpdate | None:
        """The last update, after the last keyframe; None where nothing is left to do. Args: loops, those left."""
        return None

    # -- work beside the steps: a full bundle adjustment that another process computes ---------------------------------

    @property
    def job_due(self) -> bool:
        """Whether the next `step` applies the result of the background job."""
        return False

    def pending_job(self) -> Job | None:
        """A job that nobody has taken yet, returned once."""
        return None

    def finish_job(self, result: BundleResult) -> None:
        """The result of the job that was taken last; it is applied when it is due, not before."""
        raise AssertionError(f"no job was given, but there is a result: {result}")

    # -- what is kept ------------------------------------------------------------------------------------------------

    def snapshot(self) -> MapSnapshot | None:
        """The map that was made; None where none is made."""
        return None

    def relocalize(self) -> None:
        """Search the whole saved map with the next keyframe, where that is what this mapper does."""
        return

    def place(self, of: MapSnapshot | None = None) -> LoopResult | None:
        """Where the map that was made lies in the saved map that the run began with; None: nowhere.

        Args: of, that map as it is read again; with other ids it was changed meanwhile, and there is no place in it.
        """
        return None
