"""robot.toml: what it takes, and what it says about mistakes."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.service.config import RobotConfig, explain, load


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
