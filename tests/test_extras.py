"""An installation without the extras: one line that names the missing one, and only when it is used."""

from __future__ import annotations

import importlib.util
import tomllib
from pathlib import Path

import pytest

from stereo_sfm.cli import main
from stereo_sfm.drivers.live.errors import NotFound
from stereo_sfm.errors import StereoSfmError, require

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]

SERVE = ["serve", "--set", "source.spec=sim:loop", "--set"]


def test_what_is_there_passes_and_what_is_missing_is_named() -> None:
    require(("numpy",), "viewer", "a test")
    with pytest.raises(NotFound, match=r"^a test needs no_such_library: pip install 'stereo-sfm\[oak\]'$"):
        require(("numpy", "no_such_library"), "oak", "a test", NotFound)


@pytest.mark.parametrize(
    ("arguments", "library", "extra"),
    [
        (["run", "sim:loop?frames=2", "--viz", "save"], "rerun", "viewer"),
        (["viz", "{demo}"], "rerun", "viewer"),
        (["run", "t265", "--inline"], "usb", "t265"),
        (["batch", "{demo}", "-o", "out"], "ray", "batch"),
        (["run", "rosbag:drive.bag", "--inline"], "rosbags", "ros"),
        (["run", "s3://bucket/walk.mcap", "--inline"], "obstore", "fleet"),
        (["map", "versions", "s3://bucket/store"], "obstore", "fleet"),
        ([*SERVE, "recording.upload='s3://bucket/robot'"], "obstore", "fleet"),
        ([*SERVE, "page.enabled=true"], "starlette", "serve"),
        ([*SERVE, "outputs.foxglove.enabled=true"], "websockets", "serve"),
        ([*SERVE, "outputs.ros2.enabled=true"], "rclpy", "ros2"),
    ],
)
def test_missing_extra_is_one_line(
    arguments: list[str], library: str, extra: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    found = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *a: None if name == library else found(name, *a))
    monkeypatch.chdir(tmp_path)
    demo = str(ROOT / "recordings" / "demo.mcap")
    assert main([a.format(demo=demo) for a in arguments]) == StereoSfmError.exit_code
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and f"needs {library}" in lines[0] and f"stereo-sfm[{extra}" in lines[0]


def test_extras_contain_what_their_names_promise() -> None:
    extras = PROJECT["optional-dependencies"]
    core = " ".join(PROJECT["dependencies"])
    libraries = {"viewer": "rerun-sdk", "t265": "pyusb", "oak": "depthai", "batch": "ray", "ros": "rosbags"}
    for extra, library in libraries.items():
        assert any(line.startswith(library) for line in extras[extra]) and library not in core
        assert extra in extras["all"][0]
