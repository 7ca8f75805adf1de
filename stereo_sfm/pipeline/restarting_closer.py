"""A loop closer that an error does not end: it is reported, and another one goes on with the same keyframes.

What another one begins with are the keyframes and loops that later results may name, by the results themselves, so
that the same input gives the same results in every wiring, with errors as without.
"""

from __future__ import annotations

import logging
import traceback
from collections.abc import Callable, Iterable, Sequence
from typing import Generic, Protocol, TypeVar

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.types import FAILED, Keyframe, LoopResult

log = logging.getLogger("stereo_sfm")
T = TypeVar("T")


class Closer(Protocol):
    """Finds loops, and can begin with what another one knew."""

    def step(self, keyframe: Keyframe) -> LoopResult: ...

    def add(self, keyframe: Keyframe) -> None: ...

    def add_loop(self, loop: LoopResult) -> None: ...


class KnownPlaces(Generic[T]):
    """The keyframes, in any form, and the loops between them that later results may name; both oldest first."""

    def __init__(self, keyframes: dict[int, T] | None = None, loops: Iterable[LoopResult] = ()) -> None:
        """Loops of other keyframes are left out."""
        self.keyframes: dict[int, T] = {} if keyframes is None else keyframes
        self.loops = [loop for loop in loops if self._joined_by(loop)]

    def add(self, result: LoopResult, keyframe: T) -> None:
        """The result of a keyframe."""
        self.keyframes[result.kf_id] = keyframe
        for gone in result.forgotten_kf_ids.tolist():
            self.keyframes.pop(gone, None)
        new = [result] if result.candidate_kf_id >= 0 else []
        if new or len(result.forgotten_kf_ids):
            self.loops = [loop for loop in (*self.loops, *new) if self._joined_by(loop)]

    def _joined_by(self, loop: LoopResult) -> bool:
        return loop.kf_id in self.keyframes and loop.candidate_kf_id in self.keyframes


class RestartingCloser:
    """One result for each keyframe, whatever happens to the closer."""

    def __init__(self, make: Callable[[], Closer]) -> None:
        """Args: make, a closer without keyframes.

        Raises:
            StereoSfmError: what `make` raises.
        """
        self._make, self._closer = make, make()
        self._known = KnownPlaces[Keyframe]()
        self._proven = False  # this closer has given a result

    def step(self, keyframe: Keyframe) -> LoopResult:
        """As the closer's; where it fails, a result without a loop whose `reason` is the error."""
        try:
            result = self._closer.step(keyframe)
            self._proven = True
        except Exception as error:
            result = LoopResult.without_loop(keyframe.kf_id, f"{FAILED}{type(error).__name__}")
            self._report(keyframe, error)
            self._restart(keyframe, self._known.loops)
            return result
        self._known.add(result, keyframe)
        return result

    def resume(self, keyframes: Sequence[Keyframe], loops: Sequence[LoopResult]) -> None:
        """Go on after another process, which ended at the last of its keyframes or after it, with what it knew."""
        if keyframes:
            self._known, self._proven = KnownPlaces({k.kf_id: k for k in keyframes[:-1]}), True
            self._restart(keyframes[-1], loops)

    @staticmethod
    def _report(keyframe: Keyframe, error: Exception) -> None:
        text = str(error) if isinstance(error, StereoSfmError) else f"{type(error).__name__}: {error}"
        log.warning("the loop closer failed at keyframe %d (%s); it starts again", keyframe.kf_id, text)
        log.info("%s", "".join(traceback.format_exception(error)).rstrip())

    def _restart(self, newest: Keyframe, loops: Sequence[LoopResult]) -> None:
        """Begin with the keyframes so far and the newest, else without it; with none where that was not the cure."""
        so_far, none = self._known.keyframes, dict[int, Keyframe]()
        with_newest = {**so_far, newest.kf_id: newest}
        for keyframes in (with_newest, so_far, none) if self._proven else (none,):
            self._closer, self._proven, self._known = self._make(), False, KnownPlaces(keyframes, loops)
            try:
                self._begin()
            except Exception as error:
                self._report(newest, error)
            else:
                return

    def _begin(self) -> None:
        loops = {loop.kf_id: loop for loop in self._known.loops}
        for kf_id, keyframe in self._known.keyframes.items():
            self._closer.add(keyframe)
            if kf_id in loops:
                self._closer.add_loop(loops[kf_id])
