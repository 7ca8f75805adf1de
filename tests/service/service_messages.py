"""Messages and a service for the tests of the outputs."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.geometry import se3
from stereo_sfm.messages import Health
from stereo_sfm.service.messages import (
    HealthReport,
    MapCloud,
    PoseUpdate,
    PreviewImage,
    ServiceState,
    Started,
    Status,
)
from stereo_sfm.service.publisher import Reply, checked
from stereo_sfm.types import F64, LiveDepth
from tests.synthetic import pinhole_rig

NAN6 = np.full(6, np.nan)


def started(rig: Rig | None = None) -> Started:
    return Started(1, "sim:loop", rig or pinhole_rig(), True)


def pose_update(frame_id: int = 0, odom_T_body: F64 | None = None, **others: Any) -> PoseUpdate:
    values: dict[str, Any] = {
        "frame_id": frame_id,
        "stamp_ns": 10**9 + frame_id * 33_333_333,
        "unix_ns": 1_700_000_000 * 10**9 + frame_id * 33_333_333,
        "captured_s": time.monotonic(),
        "state": "OK",
        "reason": "",
        "map_T_odom": np.eye(4),
        "odom_T_body": np.eye(4) if odom_T_body is None else odom_T_body,
        "covariance": np.diag([1e-4, 2e-4, 3e-4, 1e-6, 2e-6, 3e-6]),
        "twist": np.array([0.0, 0.0, 0.5, 0.0, -0.1, 0.0]),
        "twist_covariance": np.eye(6) * 1e-4,
        "map_version": 3,
        "session": 1,
        "localized": False,
        "tracked": True,
        "down": np.zeros(3),
    }
    return PoseUpdate(**(values | others))


def live_depth(frame_id: int = 0) -> LiveDepth:
    depth = np.arange(24, dtype=np.uint16).reshape(4, 6) * 100
    points = np.array([[0.5, 0.2, 2.0], [-0.5, 0.1, 3.0]], np.float32)
    stamp = 10**9 + frame_id * 33_333_333
    return LiveDepth(frame_id, stamp, depth, np.array([5.0, 5.0, 2.5, 1.5]), points)


def status(state: ServiceState = ServiceState.RUNNING, **others: Any) -> Status:
    return Status(state, **others)


def cloud(points: int = 500, keyframes: int = 5) -> MapCloud:
    rng = np.random.default_rng(5)
    xyz = (rng.uniform(-1, 1, (points, 3)) * (4, 1, 8)).astype(np.float32)
    map_T_kf = np.stack([se3.from_rotation_translation(np.eye(3), np.array([0.0, 0, i])) for i in range(keyframes)])
    return MapCloud(10**9, 2, 1, False, np.arange(points), xyz, np.arange(keyframes), map_T_kf)


def picture(frame_id: int = 0, size: tuple[int, int] = (320, 240)) -> PreviewImage:
    rng = np.random.default_rng(frame_id)
    left = np.add.outer(np.arange(size[1]), np.arange(size[0])).astype(np.uint8)
    uv = rng.uniform((0, 0), size, (40, 2))
    age = rng.integers(0, 40, 40).astype(np.int32)
    return PreviewImage(frame_id, 10**9 + frame_id * 33_333_333, left, left.copy(), uv, age, rng.random(40) > 0.2)


def health(**others: Any) -> HealthReport:
    values: dict[str, Any] = {
        "unix_ns": 1_700_000_000 * 10**9,
        "stages": {"tracker": Health("tracker", 40, 30.0, 1, 9.0, 14.0, 20.0, 0)},
        "rate_hz": 29.9,
        "latency_ms": (14.0, 21.5),
        "dropped": {"ring": 3, "sensor": 0},
        "counters": {"temperature_c": 51.0},
        "disk_free": 42 * 10**9,
        "recording_bytes": 3 * 10**9,
        "rss": {"tracker": 250 * 10**6},
        "restarts": 0,
        "row_error_px": 0.12,
    }
    return HealthReport(**(values | others))


@dataclass
class FakeService:
    """Answers commands as told and remembers them."""

    replies: dict[str, Reply] = field(default_factory=dict[str, Reply])
    calls: list[tuple[str, dict[str, Any]]] = field(default_factory=list[tuple[str, dict[str, Any]]])

    def call(self, name: str, timeout_s: float = 5.0, /, **arguments: Any) -> Reply:
        self.calls.append((name, checked(name, arguments)))
        return self.replies.get(name, Reply(True, f"{name} done"))
