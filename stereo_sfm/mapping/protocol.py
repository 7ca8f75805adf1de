"""The protocol of mappers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol

from stereo_sfm.types import F64, Keyframe, LoopResult, MapUpdate

if TYPE_CHECKING:
    from stereo_sfm.calib.rig import Rig
    from stereo_sfm.mapping.bundle import BundleResult
    from stereo_sfm.mapping.map import MapSnapshot
    from stereo_sfm.mapping.mapper import Job


class AnyMapper(Protocol):
    """Turns keyframes into map updates: the mapper, or the localizer in a finished map."""

    def step(self, keyframe: Keyframe, loop: LoopResult | None = None) -> MapUpdate: ...

    def finish(self, loops: Sequence[LoopResult]) -> MapUpdate | None: ...

    # -- work beside the steps: a full bundle adjustment that another process computes ---------------------------------

    @property
    def job_due(self) -> bool:
        """Whether the next step applies the result of the background job."""
        ...

    def pending_job(self) -> Job | None:
        """A job that nobody has taken yet."""
        ...

    def finish_job(self, result: BundleResult) -> None:
        """The result of the job that was taken last."""
        ...

    @property
    def rig(self) -> Rig:
        """The rig that the map is true of."""
        ...

    @property
    def calibration(self) -> tuple[Rig, F64]:
        """The rig as the run began, and the terms (8,) of its correction."""
        ...

    # -- what is kept ------------------------------------------------------------------------------------------------

    def snapshot(self) -> MapSnapshot | None:
        """The map that was made; None where none is made."""
        ...

    @property
    def found(self) -> bool:
        """Whether updates are in the frame of the saved map that the run began with."""
        ...

    def relocalize(self) -> None:
        """Search the whole saved map with the next keyframe, where that is what this mapper does."""
        ...

    def place(self) -> LoopResult | None:
        """Where the map that was made lies in the saved map that the run began with; None: nowhere."""
        ...


class WithoutJobs:
    """For a mapper that leaves nothing to other processes."""

    @property
    def job_due(self) -> bool:
        return False

    def pending_job(self) -> Job | None:
        return None

    def finish_job(self, result: BundleResult) -> None:
        raise AssertionError("no job was given")
