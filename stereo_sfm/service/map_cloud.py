"""The map as a cloud for the outputs, put together in a thread of its own."""

from __future__ import annotations

import contextlib
import queue
import threading
import time
from collections.abc import Callable

import numpy as np

from stereo_sfm.service.messages import MapCloud
from stereo_sfm.types import F32, F64, I64, Keyframe, MapUpdate

EVERY_S = 2.0  # shortest interval between two clouds


class MapCloudBuilder:
    """Takes a session's map updates and sends the map, at most every `EVERY_S`; forgets what the mapper removed."""

    def __init__(self, session: int, send: Callable[[MapCloud], None]) -> None:
        self._session, self._send = session, send
        self._poses: dict[int, F64] = {}
        self._ids: I64 = np.zeros(0, np.int64)
        self._points: F32 = np.zeros((0, 3), np.float32)
        self._localized_from: int | None = None
        self._queue: queue.SimpleQueue[MapUpdate | Keyframe | None] = queue.SimpleQueue()
        self._closing = False
        self._thread = threading.Thread(target=self._work, name="map follower", daemon=True)
        self._thread.start()

    def put(self, message: MapUpdate | Keyframe) -> None:
        """A message of the session, in order."""
        self._queue.put(message)

    def localized(self, version: int) -> None:
        """From this version on the map is in the frame of the saved one."""
        self._localized_from = version

    def close(self) -> None:
        """End the thread, without the updates that wait: the next session begins at once."""
        self._closing = True
        self._queue.put(None)
        self._thread.join()

    def _work(self) -> None:
        next_s, stamp_ns, unsent = 0.0, 0, -1  # version that was not sent yet
        while not self._closing:
            with contextlib.suppress(queue.Empty):
                message = self._queue.get(timeout=None if unsent < 0 else max(next_s - time.monotonic(), 0.0))
                if message is None:
                    return
                if isinstance(message, Keyframe):
                    stamp_ns = message.stamp_ns
                else:
                    self.apply(message)
                    unsent = message.version
            if unsent >= 0 and time.monotonic() >= next_s and self._queue.empty() and not self._closing:
                next_s = time.monotonic() + EVERY_S
                self._send(self.cloud(stamp_ns, unsent))
                unsent = -1

    def apply(self, update: MapUpdate) -> None:
        """Follow one update."""
        poses = update.map_T_kf.copy()
        for kf_id, map_T_kf in zip(update.kf_ids.tolist(), poses, strict=True):
            self._poses[kf_id] = map_T_kf.copy()  # a copy each: none keeps the others of its update in memory
        for kf_id in update.culled_kf_ids.tolist():
            self._poses.pop(kf_id, None)
        gone = np.concatenate([update.culled_point_ids, update.fused_point_ids[:, 0], update.point_ids])
        keep = ~np.isin(self._ids, gone)
        ids = np.concatenate([self._ids[keep], update.point_ids])
        points = np.concatenate([self._points[keep], update.points_map.astype(np.float32)])
        order = np.argsort(ids, kind="stable")
        self._ids, self._points = ids[order], points[order]

    def cloud(self, stamp_ns: int, version: int) -> MapCloud:
        """The map now."""
        kf_ids = np.array(sorted(self._poses), np.int64)
        poses = np.array([self._poses[k] for k in kf_ids.tolist()]).reshape(-1, 4, 4)
        saved = self._localized_from is not None and version >= self._localized_from
        return MapCloud(stamp_ns, version, self._session, saved, self._ids.copy(), self._points.copy(), kf_ids, poses)
