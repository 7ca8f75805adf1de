"""The state of the service, derived from facts about the running pipeline. Pure: the clock is an argument."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from statistics import median

from stereo_sfm.service.messages import ServiceState

NO_IMAGE_S = 1.0  # without an image the camera counts as disconnected,
NO_IMAGE_INTERVALS = 5.0  # or so many intervals of a slow source
INTERVALS = 9  # over whose median the interval is measured: one image that was missing does not count
LOST_NS = 500_000_000  # without a pose, of the images' time: a frame or two are what happens in passing

REMEDIES = {
    ServiceState.LOST: "drive slowly back to where the camera has been, or where it sees shelves well lit",
    ServiceState.CAMERA_GONE: "check the camera's cable; it is reconnected automatically",
    ServiceState.DISK_FULL: "free disk space, or lower recording.quota_gb or recording.min_free_gb; poses continue",
}


@dataclass
class Facts:
    """What is known about the service now."""

    stopping: str = ""  # why it ends
    starting: str = "the pipeline is starting"  # until the first image
    source_error: str = ""  # why the source could not be opened
    image_s: float = 0.0  # when the newest image came, of the monotonic clock
    interval_s: float = 1.0  # usual time between two images; until it is known, that of a slow source
    lost_ns: int = 0  # for how long the tracker has had no pose, by the images' stamps
    lost_reason: str = ""
    disk_problem: str = ""
    _intervals: deque[float] = field(default_factory=lambda: deque(maxlen=INTERVALS), repr=False)
    _posed_ns: int = -1  # stamp of the newest frame with a pose

    def image(self, now_s: float) -> None:
        """An image has come; the first one of a session begins without a loss."""
        if self.starting:
            self._posed_ns = -1
        if self.image_s:
            self._intervals.append(now_s - self.image_s)
            self.interval_s = median(self._intervals)
        self.image_s, self.source_error, self.starting = now_s, "", ""

    def frame(self, stamp_ns: int, has_pose: bool, reason: str) -> None:
        """The tracker has done a frame."""
        if has_pose or not 0 <= self._posed_ns <= stamp_ns:  # another source may begin with any stamp
            self._posed_ns = stamp_ns
        self.lost_ns, self.lost_reason = stamp_ns - self._posed_ns, "" if has_pose else reason


def derive_state(facts: Facts, now_s: float) -> tuple[ServiceState, str]:
    """The state and its reason; of several problems, the most severe one for the robot."""
    if facts.stopping:
        return ServiceState.STOPPING, facts.stopping
    if facts.source_error:
        return ServiceState.CAMERA_GONE, facts.source_error
    if facts.starting:
        return ServiceState.STARTING, facts.starting
    if now_s - facts.image_s > max(NO_IMAGE_S, NO_IMAGE_INTERVALS * facts.interval_s):
        return ServiceState.CAMERA_GONE, f"no images for {now_s - facts.image_s:.0f} s"
    if facts.lost_ns > LOST_NS:
        return ServiceState.LOST, facts.lost_reason or "no pose"
    if facts.disk_problem:
        return ServiceState.DISK_FULL, facts.disk_problem
    return ServiceState.RUNNING, ""
