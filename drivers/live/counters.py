"""Counters of live sources, written to the log and the summary."""

from __future__ import annotations

import threading

# name -> what it counts. `source.counters` holds every name of this table, 0 at the start.
COUNTERS: dict[str, str] = {
    "pairs": "stereo images handed to the consumer",
    "dropped": "frames that did not arrive, by gaps in the camera's stamps and counters; sum of dropped_before",
    "dropped_by_host": "of these: frames discarded on the host because the consumer was too slow",
    "unpaired": "images of one camera without the other camera's image",
    "skewed": "pairs with the same counter whose stamps differ by 1 ms or more (not used)",
    "counter_mismatch": "changes of the offset between the cameras' frame counters (stamps decide then)",
    "implausible": "well-formed images rejected because counter and stamp contradict earlier frames",
    "half_frames": "image transfers that ended early or late",
    "malformed": "transfers and events that are not messages of the protocol",
    "stalls": "times without an image for 500 ms, and for four periods of the camera",
    "disconnects": "times the camera disconnected or failed",
    "segments": "starts of streaming; more than 1 if the camera was restarted",
    "busy_retries": "commands repeated because the camera was busy",
    "imu_samples": "inertial samples handed to the consumer",
    "wheel_samples": "wheel odometry samples handed to the consumer",
    "camera_errors": "error messages from the camera itself",
    "temperature_c": "last temperature of the camera's processor, degrees Celsius",
    "clock_uncertainty_us": "half the round trip of the last accepted clock reading",
}

# Those that are nonzero only after a problem.
LOSSES = frozenset(COUNTERS) - {
    "pairs",
    "segments",
    "imu_samples",
    "wheel_samples",
    "temperature_c",
    "clock_uncertainty_us",
}


class Counters(dict[str, float]):
    """Thread-safe counters, readable as a dict."""

    def __init__(self) -> None:
        super().__init__(dict.fromkeys(COUNTERS, 0))
        self._lock = threading.Lock()

    def add(self, name: str, amount: float = 1) -> None:
        with self._lock:
            self[name] += amount
