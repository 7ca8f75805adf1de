"""The outputs of the service, one module each: whatever has `make(config) -> Publisher`."""

from __future__ import annotations

# name of the output and its section in robot.toml -> where its publisher is made; imported in the output's own process.
# Each pose is sent in this order: machines before people.
OUTPUTS: dict[str, str] = {
    "pose_socket": "stereo_sfm.service.outputs.pose_socket:make",
    "ros2": "stereo_sfm.service.outputs.ros2:make",
    "foxglove": "stereo_sfm.service.outputs.foxglove_server:make",
    "page": "stereo_sfm.service.page.server:make",
}
