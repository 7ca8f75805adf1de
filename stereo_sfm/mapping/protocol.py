"""What every mapper is."""

from __future__ import annotations

from typing import Protocol

from stereo_sfm.types import Keyframe, LoopResult, MapUpdate


class AnyMapper(Protocol):
    """What answers keyframes with map updates: the mapper, or the localizer in a finished map."""

    def step(self, keyframe: Keyframe, loop: LoopResult | None = None) -> MapUpdate: ...

    def finish(self, loops: list[LoopResult]) -> MapUpdate | None: ...
