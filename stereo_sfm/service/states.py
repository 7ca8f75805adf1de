"""The state of the service, derived from facts about the running pipeline. Pure: the clock is an argument."""

from __future__ import annotations

from dataclasses import dataclass

from stereo_sfm.service.messages import ServiceState

NO_IMAGE_S = 1.0  # without an image the camera counts as disconnected
LOST_S = 0.5  # without a pose tracking counts as lost

REMEDIES = {
    ServiceState.LOST: "drive slowly back to where the camera has been, or where it sees shelves well lit",
    ServiceState.CAMERA_GONE: "check the camera's cable; it is reconnected automatically",
    ServiceState.DISK_FULL: "free space on the disk, or lower recording.quota_gb; poses continue",
}


@dataclass
class Facts:
    """What is known about the service now; times are of the monotonic clock."""

    stopping: str = ""  # why it ends
    starting: str = "the pipeline is starting"  # until the first image
    source_error: str = ""  # why the source could not be opened
    image_s: float = 0.0  # the newest image
    pose_s: float = 0.0  # the newest image with a pose
    lost_reason: str = ""
    disk_problem: str = ""


def derive_state(facts: Facts, now_s: float) -> tuple[ServiceState, str]:
    """The state and its reason; of several problems, the most severe one for the robot."""
    if facts.stopping:
        return ServiceState.STOPPING, facts.stopping
    if facts.source_error:
        return ServiceState.CAMERA_GONE, facts.source_error
    if facts.starting:
        return ServiceState.STARTING, facts.starting
    if now_s - facts.image_s > NO_IMAGE_S:
        return ServiceState.CAMERA_GONE, f"no image for {now_s - facts.image_s:.0f} s"
    if now_s - facts.pose_s > LOST_S:
        return ServiceState.LOST, facts.lost_reason or "no pose"
    if facts.disk_problem:
        return ServiceState.DISK_FULL, facts.disk_problem
    return ServiceState.RUNNING, ""
