"""Messages of the service to its outputs and callbacks. A slow receiver loses its oldest ones and delays no other."""

from __future__ import annotations

import logging
import pickle
import threading
import time
from collections.abc import Callable, Iterable
from typing import Any, TypeVar

from stereo_sfm.pipeline.channels import DroppingQueue
from stereo_sfm.service.link import LIMIT, OutputProcess
from stereo_sfm.service.messages import MapCloud, PreviewImage, ServiceMessage, Started, Status

log = logging.getLogger("stereo_sfm")
M = TypeVar("M", bound=ServiceMessage)
CALLBACKS_S = 0.5  # for the callbacks to take their last messages
REPEATED = (Started, Status, MapCloud)  # a new receiver first gets the newest of these


class Callback(DroppingQueue[Any]):
    """One callback, in a thread of its own."""

    def __init__(self, kind: type[Any], function: Callable[[Any], object]) -> None:
        self.kind, self._function = kind, function
        super().__init__(self._call, LIMIT, "callback")

    def _call(self, message: object) -> None:
        try:
            self._function(message)
        except Exception:
            log.exception("a callback of the service failed")


class Hub:
    """Distributes messages; thread-safe."""

    def __init__(self, outputs: Iterable[OutputProcess]) -> None:
        self.outputs = tuple(outputs)
        self._callbacks: list[Callback] = []
        self._newest: dict[type, Any] = {}
        self._updated: dict[str, int] = {}
        self._lock = threading.Lock()

    def on(self, kind: type[M], function: Callable[[M], object]) -> Callable[[], None]:
        """Call a function with every message of a kind; returns what ends that."""
        callback = Callback(kind, function)
        with self._lock:
            self._callbacks.append(callback)
            if kind in self._newest:
                callback.put(self._newest[kind])

        def remove() -> None:
            with self._lock:
                if callback in self._callbacks:
                    self._callbacks.remove(callback)
            callback.close()

        return remove

    @property
    def preview_hz(self) -> float:
        """Most preview images a second that a receiver wants."""
        rates = [o.preview_hz for o in self.outputs if PreviewImage in o.wants]
        return max([*rates, 10.0 if any(c.kind is PreviewImage for c in self._callbacks) else 0.0], default=0.0)

    def publish(self, message: ServiceMessage) -> None:
        """Send a message to every receiver that wants it."""
        kind = type(message)
        with self._lock:
            if kind in REPEATED:
                self._newest[kind] = message
            self._send_newest()
            if any(kind in output.wants for output in self.outputs):
                data = pickle.dumps(message, pickle.HIGHEST_PROTOCOL)
                for output in self.outputs:
                    output.offer(kind, data)
            for callback in self._callbacks:
                if callback.kind is kind:
                    callback.put(message)

    def _send_newest(self) -> None:
        """An output that has just opened first gets the newest state."""
        for output in self.outputs:
            if output.wants and self._updated.get(output.name) != output.starts:
                self._updated[output.name] = output.starts
                for kind, message in self._newest.items():
                    output.offer(kind, pickle.dumps(message, pickle.HIGHEST_PROTOCOL))

    def close(self) -> None:
        """Close every output at the same time, and end the callbacks once they have had every message."""
        for callback in self._callbacks:
            callback.close()
        closing = [threading.Thread(target=output.close) for output in self.outputs]
        for thread in closing:
            thread.start()
        for thread in closing:
            thread.join()
        until = time.monotonic() + CALLBACKS_S
        for callback in self._callbacks:
            callback.join(max(until - time.monotonic(), 0.0))
