"""A loop closer that an error does not end: it is reported, and another one goes on with the same keyframes.

What another one begins with are the keyframes and loops that later results may name, by the results themselves, so
that the same input gives the same results in every wiring, with errors as without.
"""

from __future__ import annotations

import logging
import traceback
from collections.abc import Callable, Sequence
from typing import Protocol

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.types import FAILED, Keyframe, LoopResult

log = logging.getLogger("stereo_sfm")


class Closer(Protocol):
    """Finds loops, and can begin with what another one knew."""

    def step(self, keyframe: Keyframe) -> LoopResult: ...

    def add(self, keyframe: Keyframe) -> None: ...

    def add_loop(self, loop: LoopResult) -> None: ...


class RestartingCloser:
    """One result for each keyframe, whatever happens to the closer."""

    def __init__(self, make: Callable[[], Closer]) -> None:
        """Args: make, a closer without keyframes.

        Raises:
            StereoSfmError: what `make` raises.
        """
        self._make, self._closer = make, make()
        self._keyframes: dict[int, Keyframe] = {}  # that later results may name, oldest first
        self._loops: list[LoopResult] = []  # between them, in order
        self._proven = False  # this closer has given a result

    def step(self, keyframe: Keyframe) -> LoopResult:
        """As the closer's; where it fails, a result without a loop whose `reason` is the error."""
        try:
            result = self._closer.step(keyframe)
            self._proven = True
        except Exception as error:
            result = LoopResult.without_loop(keyframe.kf_id, f"{FAILED}{type(error).__name__}")
            self._report(keyframe, error)
            self._restart(keyframe)
            return result
        self._keyframes[keyframe.kf_id] = keyframe
        for gone in result.forgotten_kf_ids.tolist():
            self._keyframes.pop(gone, None)
        if result.candidate_kf_id >= 0:
            self._loops = [*filter(self._known, self._loops), result]
        return result

    def resume(self, keyframes: Sequence[Keyframe], loops: Sequence[LoopResult]) -> None:
        """Go on after another process, which ended at the last of its keyframes or after it, with what it knew."""
        if keyframes:
            self._keyframes, self._loops, self._proven = {k.kf_id: k for k in keyframes[:-1]}, list(loops), True
            self._restart(keyframes[-1])

    def _known(self, loop: LoopResult) -> bool:
        return loop.kf_id in self._keyframes and loop.candidate_kf_id in self._keyframes

    @staticmethod
    def _report(keyframe: Keyframe, error: Exception) -> None:
        text = str(error) if isinstance(error, StereoSfmError) else f"{type(error).__name__}: {error}"
        log.warning("the loop closer failed at keyframe %d (%s); it starts again", keyframe.kf_id, text)
        log.info("%s", "".join(traceback.format_exception(error)).rstrip())

    def _restart(self, newest: Keyframe) -> None:
        """Begin with the keyframes so far and the newest, else without it; with none where that was not the cure."""
        with_newest, none = {**self._keyframes, newest.kf_id: newest}, dict[int, Keyframe]()
        for keyframes in (with_newest, self._keyframes, none) if self._proven else (none,):
            self._closer, self._proven, self._keyframes = self._make(), False, keyframes
            self._loops = [*filter(self._known, self._loops)]
            try:
                self._begin()
            except Exception as error:
                self._report(newest, error)
            else:
                return

    def _begin(self) -> None:
        loops = {loop.kf_id: loop for loop in self._loops}
        for kf_id, keyframe in self._keyframes.items():
            self._closer.add(keyframe)
            if kf_id in loops:
                self._closer.add_loop(loops[kf_id])
