"""Where ROS is to stay on this computer, Fast DDS listens here alone: by itself it listens on every network."""

from __future__ import annotations

import os
from collections.abc import MutableMapping
from pathlib import Path

import stereo_sfm

PROFILE = Path(stereo_sfm.__file__).resolve().parent / "data" / "this_computer.xml"
PROFILES = "FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE"  # to Fast DDS 2, and from 3 on


def keep_here(environment: MutableMapping[str, str] = os.environ) -> None:
    """Call it before a process uses ROS. Profiles of the user's own, and a ROS that others may find, stay as they are.

    Args: environment, of this process.
    """
    discovery = environment.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "").upper()
    here = discovery in ("LOCALHOST", "OFF") or environment.get("ROS_LOCALHOST_ONLY") == "1"
    own = any(Path(environment.get(name, "")).is_file() for name in PROFILES)  # Fast DDS says nothing of a missing one
    if here and not own:
        environment.update(dict.fromkeys(PROFILES, str(PROFILE)))
