"""What the service opens to others, for `serve --print-ports`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from stereo_sfm.service.outputs.access import is_loopback

if TYPE_CHECKING:
    from stereo_sfm.service.config import RobotConfig

_NONE = "nothing listens: no output and no page is enabled"


def ports(config: RobotConfig) -> list[str]:
    """One line for each output that is enabled: address, protocol, who can reach it and what they need."""
    outputs, page = config.outputs, config.page
    rows: list[str] = []
    if page.enabled:
        scheme = "https" if config.security.tls_cert and not is_loopback(page.address) else "http"
        rows.append(f"page         {scheme}://{page.address}:{page.port}  {_who(page.address)}")
    if outputs.pose_socket.enabled:
        address = outputs.pose_socket.address
        host = address.removeprefix("tcp://").rpartition(":")[0].strip("[]")
        who = _who(host) if address.startswith("tcp://") else "this computer, user and group of the service"
        rows.append(f"pose socket  {address}  {who}")
    if outputs.foxglove.enabled:
        rows.append(f"foxglove     ws://{outputs.foxglove.address}:{outputs.foxglove.port}  this computer only")
    if outputs.ros2.enabled:
        rows.append("ros2         DDS, by ROS_DOMAIN_ID and ROS_LOCALHOST_ONLY  no token: ROS 2 has none")
    return rows or [_NONE]


def _who(address: str) -> str:
    return "this computer only" if is_loopback(address) else f"anyone who can reach {address} and has the token"
