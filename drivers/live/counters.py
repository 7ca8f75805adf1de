"""Numbers every live source keeps about itself. The pipeline writes them in the log and the summary."""

from __future__ import annotations

import threading

# name -> what it counts. `source.counters` holds every name of this table, 0 at the start.
COUNTERS: dict[str, str] = {
    "pairs": "stereo images handed to the consumer",
    "dropped": "frames that did not arrive, from the gaps in the camera's stamps and counters; sum of dropped_before",
    "dropped_by_host": "of these: frames thrown away here because the consumer was too slow",
    "unpaired": "single images whose other eye never came",
    "skewed": "pairs with the same counter whose eyes differ by 1 ms or more (not used)",
    "counter_mismatch": "times the eyes' frame counters began to differ by another amount (time decides then)",
    "implausible": "well-formed images refused because counter and time contradict the frames before",
    "half_frames": "image transfers that ended early or late",
    "malformed": "transfers and events that are no message of the protocol",
    "stalls": "times no image came for 500 ms",
    "disconnects": "times the camera went away or failed",
    "segments": "times streaming began; more than 1 means that the camera was restarted",
    "busy_retries": "times the camera answered busy and was asked again",
    "imu_samples": "inertial samples handed to the consumer",
    "wheel_samples": "wheel odometry samples handed to the consumer",
    "camera_errors": "error messages from the camera itself",
    "temperature_c": "last temperature of the camera's processor, degrees Celsius",
    "clock_uncertainty_us": "half the round trip of the last accepted clock reading",
}

# Those that are not 0 only when something went wrong.
TROUBLE = frozenset(COUNTERS) - {
    "pairs",
    "segments",
    "imu_samples",
    "wheel_samples",
    "temperature_c",
    "clock_uncertainty_us",
}


class Counters(dict[str, float]):
    """Counts that several threads add to. Reading is reading a dict."""

    def __init__(self) -> None:
        super().__init__(dict.fromkeys(COUNTERS, 0))
        self._lock = threading.Lock()

    def add(self, name: str, amount: float = 1) -> None:
        with self._lock:
            self[name] += amount
