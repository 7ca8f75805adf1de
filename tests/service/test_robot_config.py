"""robot.toml: what it takes, and what it says about mistakes."""

from __future__ import annotations

import re
import tomllib
from operator import attrgetter
from pathlib import Path

import pytest

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.service.config import RobotConfig, explain, load
from stereo_sfm.settings import walk


def test_the_explained_configuration_is_the_default() -> None:
    assert load() == RobotConfig()
    file = Path("robot.toml")
    assert tomllib.loads(explain(RobotConfig()))["outputs"]["pose_socket"]["enabled"] is False, file


def test_paths_are_relative_to_the_file(tmp_path: Path) -> None:
    file = tmp_path / "robot.toml"
    file.write_text('[source]\nspec = "sim:loop"\nrig = "rig.yaml"\n[map]\nfolder = "/maps/store"\n')
    config = load(file, ["recording.segment_min=2"])
    assert config.source.rig == str(tmp_path / "rig.yaml") and config.map.folder == "/maps/store"
    assert config.recording.folder == str(tmp_path / "recordings") and config.recording.segment_min == 2.0


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("[sorce]\nspec = ''", "there is no sorce, did you mean source"),
        ("[map]\nmode = 'extnd'", "did you mean extend"),
        ("[recording]\nquota_gb = -1", "must be from 0.01"),
        ("[page]\nport = 'x'", "page.port is 'x': it must be a whole number"),
        ("[page]\nenabled = 'yes'", "page.enabled is 'yes': it must be true or false"),
        ("[map]\nsave_every_min = []", "map.save_every_min is .*: it must be a number"),
        ("[source", "Expected"),
    ],
)
def test_a_mistake_is_one_line(tmp_path: Path, text: str, why: str) -> None:
    file = tmp_path / "robot.toml"
    file.write_text(text)
    with pytest.raises(StereoSfmError, match=why) as caught:
        load(file)
    assert "\n" not in str(caught.value)


def test_a_missing_source_is_reported() -> None:
    with pytest.raises(StereoSfmError, match="names no source"):
        RobotConfig().opener()


def test_every_path_of_a_file_is_relative_to_it(tmp_path: Path) -> None:
    """Also the settings that come after this test: whatever `settings.path` makes."""
    file = tmp_path / "robot.toml"
    names = [name for name, field, _ in walk(RobotConfig()) if "path" in field.metadata]
    assert {"page.surface", "outputs.pose_socket.address", "security.tls_key", "source.rig"} < set(names)
    for name in names:
        section, _, key = name.rpartition(".")
        file.write_text(f'[{section}]\n{key} = "a/b"\n')
        assert attrgetter(name)(load(file)) == str(tmp_path / "a" / "b"), name
        file.write_text(f'[{section}]\n{key} = "/a/b"\n')
        assert attrgetter(name)(load(file)) == "/a/b", name
    assert load(file).outputs.pose_socket.address == "tcp://127.0.0.1:7000" and load(file).page.surface == ""


def test_the_source_of_a_file_is_relative_to_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for place in ("robot/pairs", "robot/loop", "robot/t265", "elsewhere/pairs"):
        (tmp_path / place).mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "elsewhere")
    file, there = tmp_path / "robot" / "robot.toml", tmp_path / "robot" / "pairs"
    for given, wanted in {
        "pairs": there, "pairs?fps=10": f"{there}?fps=10", "images:pairs?fps=10": f"images:{there}?fps=10",
        "nothing": "nothing", "sim:loop": "sim:loop", "t265:": "t265:", "t265": "t265", "": "", "uvc:0,2": "uvc:0,2",
        str(there): there, "kitti:": "kitti:",
    }.items():  # fmt: skip
        file.write_text(f'[source]\nspec = "{given}"\n')
        assert load(file).source.spec == str(wanted), given
        assert load(file, [f"source.spec={given}"]).source.spec == given


@pytest.mark.parametrize(
    ("address", "why"),
    [
        ("127.0.0.1:7000", "did you mean tcp://127.0.0.1:7000?"),
        ("localhost:7000", "did you mean tcp://localhost:7000?"),
        ("[::1]:7000", "did you mean tcp://[::1]:7000?"),
        ("7000", "did you mean tcp://127.0.0.1:7000?"),
        (":7000", "did you mean tcp://127.0.0.1:7000?"),
        ("pose.sock", "a path such as ./pose.sock"),
        ("udp://127.0.0.1:7000", "give tcp://127.0.0.1:7000"),
        ("", "give tcp://127.0.0.1:7000"),
    ],
)
def test_an_address_without_its_scheme_is_no_local_socket(address: str, why: str, tmp_path: Path) -> None:
    text = [f"outputs.pose_socket.address={address}", "outputs.pose_socket.enabled=true"]
    for file in (None, tmp_path / "robot.toml"):
        if file is not None:
            file.touch()
        with pytest.raises(StereoSfmError, match=re.escape(why)):
            load(file, text)
    assert load(None, text[:1]).outputs.pose_socket.address == address


@pytest.mark.parametrize("value", ["2026-11-22", "7", "true", "a b", "[x]", "it's", 'the "x"', "1e3", "", "/maps/\\x"])
def test_a_text_may_look_like_another_value(value: str) -> None:
    assert load(None, [f"map.robot={value}"]).map.robot == value
    assert load(None, [f'map.robot="{value}"' if '"' not in value and "\\" not in value else f"map.robot='{value}'"
                       ]).map.robot == value  # fmt: skip


def test_a_missing_file_names_the_command_of_its_kind(tmp_path: Path) -> None:
    with pytest.raises(StereoSfmError, match=r"no configuration file at .*'stereo-sfm serve --print-config'"):
        load(tmp_path / "robots.toml")
