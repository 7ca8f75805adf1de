"""`stereo-sfm service`: what it would install, below another root and as a dry run."""

from __future__ import annotations

import configparser
import os
import pwd
import tomllib
from pathlib import Path

import pytest

from stereo_sfm.cli import main
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.service import install
from stereo_sfm.service.config import load


def test_installed_below_another_root_and_removed_again(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = ["--root", str(tmp_path)]
    assert main(["service", "install", *root, "--writable", "/data", "--user", "robot"]) == 0
    unit = configparser.ConfigParser(strict=False, interpolation=None)
    unit.optionxform = str  # pyright: ignore[reportAttributeAccessIssue]
    unit.read(tmp_path / "etc/systemd/system/stereo-sfm.service")
    service = unit["Service"]
    assert service["Type"] == "notify" and service["User"] == "robot" and service["ReadWritePaths"] == "/data"
    assert service["ExecStart"].endswith("stereo-sfm serve -c /etc/stereo-sfm/robot.toml")
    robot = tmp_path / "etc/stereo-sfm/robot.toml"
    assert load(robot).map.folder == "/var/lib/stereo-sfm/store"
    assert "03e7" in (tmp_path / "etc/udev/rules.d").iterdir().__next__().read_text()
    robot.write_text("[source]\nspec = 't265:'\n")
    assert main(["service", "install", *root]) == 0  # a changed robot.toml stays
    assert tomllib.loads(robot.read_text()) == {"source": {"spec": "t265:"}}
    assert main(["service", "uninstall", *root]) == 0
    assert robot.exists() and not (tmp_path / "etc/systemd/system/stereo-sfm.service").exists()
    assert "stay" in capsys.readouterr().out


def test_a_dry_run_prints_everything_and_changes_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    existed = Path(install.UNIT_FILE).exists()
    assert main(["service", "install", "--dry-run"]) == 0
    shown = capsys.readouterr().out
    for part in ("Type=notify", "useradd --system", "SUBSYSTEM", "[recording]", "systemctl enable stereo-sfm.service"):
        assert part in shown
    assert Path(install.UNIT_FILE).exists() == existed


def test_a_program_in_a_home_folder_is_refused(tmp_path: Path) -> None:
    """The unit would fail each second, without end."""
    install.check_reach(Path("/usr/bin/env"), "robot")
    (tmp_path / "home").mkdir(mode=0o700)
    with pytest.raises(StereoSfmError, match="the user robot may not enter"):
        install.check_reach(tmp_path / "home" / "stereo-sfm", "robot")
    install.check_reach(tmp_path / "home" / "stereo-sfm", pwd.getpwuid(os.getuid()).pw_name)  # whose home it is


def test_a_missing_installation_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(install, "UNIT_FILE", str(tmp_path / "none"))
    assert main(["service", "status"]) == 2
    assert "not installed" in capsys.readouterr().err
