"""What the service opens to others, for `serve --print-ports`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from stereo_sfm.drivers.ros2.this_computer import PROFILE
from stereo_sfm.service.outputs.access import is_loopback, token_file

if TYPE_CHECKING:
    from stereo_sfm.service.config import RobotConfig
    from stereo_sfm.service.outputs.settings import FoxgloveConfig, PageConfig, SecurityConfig

_DDS = (
    "ros2         DDS on every network, by ROS_DOMAIN_ID; no token: whoever is in the domain may call the services.",
    "             On this computer only: ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST. ROS_LOCALHOST_ONLY=1 hides it, too.",
    "             Fast DDS in the output listens on this computer alone then. Other nodes need for that",
    f"             FASTRTPS_DEFAULT_PROFILES_FILE={PROFILE}, or with Cyclone DDS in CYCLONEDDS_URI",
    '             <General><Interfaces><NetworkInterface name="lo"/></Interfaces></General>',
)
_NONE = "nothing listens: no output and no page is enabled"


def ports(config: RobotConfig) -> list[str]:
    """One line for each output that is enabled: address, protocol, who can reach it and what they need."""
    outputs, page, security = config.outputs, config.page, config.security
    rows: list[str] = []
    if page.enabled:
        rows.append(f"page         {_address('http', page, security)}  {_who(page.address, security)}")
    if outputs.pose_socket.enabled:
        address = outputs.pose_socket.address
        host = address.removeprefix("tcp://").rpartition(":")[0].strip("[]")
        is_port = address.startswith("tcp://")
        who = _who(host, security) if is_port else "user and group of the service on this computer; no token"
        rows.append(f"pose socket  {address}  {who}")
    if outputs.foxglove.enabled:
        foxglove = outputs.foxglove
        rows.append(f"foxglove     {_address('ws', foxglove, security)}  {_who(foxglove.address, security)}")
    if outputs.ros2.enabled:
        rows += _DDS
    return rows or [_NONE]


def _address(scheme: str, section: PageConfig | FoxgloveConfig, security: SecurityConfig) -> str:
    encrypted = bool(security.tls_cert) and security.auth == "token" and not is_loopback(section.address)
    return f"{scheme}{'s' if encrypted else ''}://{section.address}:{section.port}"


def _who(address: str, security: SecurityConfig) -> str:
    needs = "" if security.auth == "none" else f" with the token in {token_file(security)}"
    return f"anyone on this computer{needs}" if is_loopback(address) else f"anyone who can reach {address}{needs}"
