"""Messages of the service to its outputs and callbacks. Whoever is slow loses the oldest; nobody waits for anybody."""

from __future__ import annotations

import logging
import pickle
import threading
from collections import deque
from collections.abc import Callable, Iterable
from typing import Any, TypeVar

from stereo_sfm.service.link import LIMIT, OutputProcess
from stereo_sfm.service.messages import MapCloud, Picture, ServiceMessage, Started, Status

log = logging.getLogger("stereo_sfm")
M = TypeVar("M", bound=ServiceMessage)
REPEATED = (Started, Status, MapCloud)  # whoever comes later gets the newest of these first


class Callback:
    """One callback, in a thread of its own."""

    def __init__(self, kind: type[Any], function: Callable[[Any], object]) -> None:
        self.kind, self._function = kind, function
        self._waiting: deque[object] = deque(maxlen=LIMIT)
        self._more, self._over = threading.Semaphore(0), False
        threading.Thread(target=self._work, name="callback", daemon=True).start()

    def put(self, message: object) -> None:
        """Queue a message; never blocks."""
        self._waiting.append(message)
        self._more.release()

    def close(self) -> None:
        """No further messages; those that wait are still handled."""
        self._over = True
        self._more.release()

    def _work(self) -> None:
        while True:
            self._more.acquire()
            if self._waiting:
                try:
                    self._function(self._waiting.popleft())
                except Exception:
                    log.exception("a callback of the service failed")
            elif self._over:
                return


class Hub:
    """Distributes messages; thread-safe."""

    def __init__(self, outputs: Iterable[OutputProcess]) -> None:
        self.outputs = tuple(outputs)
        self._callbacks: list[Callback] = []
        self._newest: dict[type, Any] = {}
        self._greeted: dict[str, int] = {}
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

    def newest(self, kind: type[M]) -> M | None:
        """The newest message of a repeated kind."""
        return self._newest.get(kind)

    def wants(self, kind: type[ServiceMessage]) -> bool:
        """Whether anybody wants a kind of message."""
        return any(kind in o.wants for o in self.outputs) or any(c.kind is kind for c in self._callbacks)

    @property
    def picture_hz(self) -> float:
        """Most pictures a second that anybody wants."""
        rates = [o.picture_hz for o in self.outputs if Picture in o.wants]
        return max([*rates, 10.0 if any(c.kind is Picture for c in self._callbacks) else 0.0], default=0.0)

    def publish(self, message: ServiceMessage) -> None:
        """Send a message to everybody who wants it."""
        kind = type(message)
        with self._lock:
            if kind in REPEATED:
                self._newest[kind] = message
            self._greet()
            if any(kind in output.wants for output in self.outputs):
                data = pickle.dumps(message, pickle.HIGHEST_PROTOCOL)
                for output in self.outputs:
                    output.offer(kind, data)
            for callback in self._callbacks:
                if callback.kind is kind:
                    callback.put(message)

    def _greet(self) -> None:
        """An output that has just opened gets the newest state first."""
        for output in self.outputs:
            if output.wants and self._greeted.get(output.name) != output.starts:
                self._greeted[output.name] = output.starts
                for kind, message in self._newest.items():
                    output.offer(kind, pickle.dumps(message, pickle.HIGHEST_PROTOCOL))

    def close(self) -> None:
        """Close every output at the same time, and end the callbacks."""
        closing = [threading.Thread(target=output.close) for output in self.outputs]
        for thread in closing:
            thread.start()
        for thread in closing:
            thread.join()
        for callback in self._callbacks:
            callback.close()
