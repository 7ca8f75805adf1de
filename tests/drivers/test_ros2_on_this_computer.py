"""A ROS that is to stay on this computer has no port for others: without ROS, by what its libraries find."""

from __future__ import annotations

import os
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

import stereo_sfm
from stereo_sfm.drivers.ros2.source import Ros2Source
from stereo_sfm.drivers.ros2.this_computer import PROFILE, PROFILES, keep_here
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.service.outputs.ros2 import Ros2Output
from stereo_sfm.service.outputs.settings import Ros2Config

RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"


@pytest.mark.parametrize(
    "asked", [{RANGE: "LOCALHOST"}, {RANGE: "localhost"}, {RANGE: "OFF"}, {"ROS_LOCALHOST_ONLY": "1"}]
)
def test_what_stays_here_listens_here(asked: dict[str, str]) -> None:
    for before in ({}, {PROFILES[0]: "packaging/none.xml"}, {PROFILES[1]: ""}):
        environment = {**asked, **before}
        keep_here(environment)
        assert environment == {**asked, **dict.fromkeys(PROFILES, str(PROFILE))}


def test_what_others_may_find_and_profiles_of_the_user_stay(tmp_path: Path) -> None:
    own = tmp_path / "own.xml"
    own.touch()
    for before in ({}, {RANGE: "SUBNET"}, {"ROS_LOCALHOST_ONLY": "0"}, {RANGE: "LOCALHOST", PROFILES[0]: str(own)}):
        environment = dict(before)
        keep_here(environment)
        assert environment == before


def test_the_profile_is_in_the_package_and_listens_here() -> None:
    assert Path(stereo_sfm.__file__).resolve().parent in PROFILE.parents and PROFILE.is_absolute()
    addresses = [one.text for one in ElementTree.parse(PROFILE).iter() if one.tag.endswith("}address")]
    assert addresses == ["127.0.0.1"]


@pytest.mark.parametrize("side", ["output", "source"])
def test_every_node_of_ours_has_it(side: str, monkeypatch: pytest.MonkeyPatch) -> None:
    rclpy, found = ModuleType("rclpy"), list[str]()

    def begun(*_: Any, **__: Any) -> None:
        found.append(os.environ[PROFILES[0]])
        raise RuntimeError("no ROS here")

    for name, value in {"ok": begun, "init": begun, "Context": object}.items():
        setattr(rclpy, name, value)
    for name in ("MultiThreadedExecutor", "SingleThreadedExecutor", "SignalHandlerOptions"):
        setattr(rclpy, name, ModuleType("NO"))
    vars(rclpy)["SignalHandlerOptions"].NO = 0
    for name in ("rclpy", "rclpy.executors", "rclpy.signals"):
        monkeypatch.setitem(sys.modules, name, rclpy)
    for name, value in {**dict.fromkeys(PROFILES, ""), RANGE: "LOCALHOST"}.items():
        monkeypatch.setenv(name, value)
    service: Any = None
    source, output = object.__new__(Ros2Source), Ros2Output(Ros2Config())
    opened = {"output": lambda: output.open(service), "source": lambda: source._open_node("node")}  # pyright: ignore[reportPrivateUsage]
    with pytest.raises((StereoSfmError, RuntimeError), match="no ROS here"):
        opened[side]()
    assert found == [str(PROFILE)]
