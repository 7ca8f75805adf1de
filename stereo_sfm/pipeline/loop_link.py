"""Main's link to the loop closer's process: keyframes go to it, and its results to the mapper.

A process that ends early is followed by another one, which goes on with the keyframes and loops that later results may
name, as a closer does that follows one that failed (`pipeline.restarting_closer`). The keyframe at which it ended gets
a result without a loop, so the mapper gets one for each, whatever happens. Main keeps for it what the closer knows:
some 30 kB a keyframe.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection

from stereo_sfm.pipeline.channels import End, Outbox
from stereo_sfm.pipeline.restarting_closer import KnownPlaces
from stereo_sfm.types import FAILED, Keyframe, LoopResult

ANY_NUMBER = 0  # of messages that wait: main never waits for a stage


@dataclass(frozen=True)
class Known:
    """What a closer goes on with, oldest first."""

    keyframes: tuple[bytes, ...]  # pickled
    loops: tuple[LoopResult, ...]  # between them


class LoopLink:
    """One `add` for each keyframe, one `answered` for each result."""

    def __init__(self, begin: Callable[[], Connection], to_mapper: Connection) -> None:
        """Args: begin, starts a process and returns the pipe for its keyframes. to_mapper: for results."""
        self._begin, self._to_loop = begin, Outbox(begin(), ANY_NUMBER)
        self._to_mapper = Outbox(to_mapper, ANY_NUMBER)
        self.closing = True  # else the process gets no keyframes
        self._waiting: dict[int, bytes] = {}  # pickled keyframes without a result, by id
        self._known = KnownPlaces[bytes]()
        self._ready = self._over = self._gone = False
        self._proven = True  # this process, or the first one, has given a result

    def ready(self) -> None:
        """The process has loaded what it needs: one that ends now ended by its work, and another one may follow."""
        self._ready = True

    @property
    def replaceable(self) -> bool:
        """Whether the run goes on without this process: it could begin, or one before it could."""
        return self._ready or not self._proven

    def add(self, keyframe: Keyframe, data: bytes) -> list[LoopResult]:
        """A keyframe and the same, pickled. Returns its result where no process is left."""
        if not self.closing:
            return []
        self._waiting[keyframe.kf_id] = data
        if self._gone:
            return self._without_loop("no process", 1)
        self._to_loop.send(data)
        return []

    def answered(self, result: LoopResult, data: bytes) -> None:
        """A result and the same, pickled."""
        self._to_mapper.send(data)
        self._known.add(result, self._waiting.pop(result.kf_id))
        self._proven |= not result.failed

    def end(self) -> None:
        """No more keyframes follow."""
        self._over = True
        self._to_loop.send(End("tracker"))

    def died(self, why: str) -> list[LoopResult]:
        """The process has ended early. Returns the result of the keyframe at which it did, if it had one."""
        if not self._ready:
            self._gone = True
        return self._without_loop(why, len(self._waiting) if self._gone else 1)

    def follow(self) -> bool:
        """Start another process after one that died; False: it could not even begin, or nothing is left to do."""
        if self._gone or (self._over and not self._waiting):
            return False
        if not self._proven:  # what the last one began with was not the cure
            self._known = KnownPlaces()
        self._ready = self._proven = False
        self._to_loop.close()
        self._to_loop = Outbox(self._begin(), ANY_NUMBER)
        self._to_loop.send(Known(tuple(self._known.keyframes.values()), tuple(self._known.loops)))
        for data in self._waiting.values():
            self._to_loop.send(data)
        if self._over:
            self.end()
        return True

    def _without_loop(self, why: str, most: int) -> list[LoopResult]:
        return [LoopResult.without_loop(k, f"{FAILED}{why}") for k in list(self._waiting)[:most]]

    def close(self) -> None:
        """Close the pipes, whose readers have ended."""
        self._to_loop.close()
        self._to_mapper.close()
