"""Files attached to a log are read back unchanged; invalid ones are one line."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest

from stereo_sfm.calib.formats.native import rig_to_text
from stereo_sfm.config import Config, dump
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.log.attached import attached_config, attached_rig, attached_truth
from stereo_sfm.log.image_log import RIG_FILE, TRUTH_FILE, truth_to_bytes
from stereo_sfm.log.provenance import CONFIG_FILE
from stereo_sfm.log.reader import LogReader
from stereo_sfm.log.recorded import read_run
from stereo_sfm.log.writer import LogWriter
from stereo_sfm.recording.describe import describe_file
from stereo_sfm.types import Trajectory
from tests.synthetic import camera_path, fisheye_rig


def log_with(path: Path, files: dict[str, str | bytes]) -> Path:
    with LogWriter(path) as writer:
        for name, data in files.items():
            writer.attach(name, data)
    return path


def test_files_come_back_to_the_bit(tmp_path: Path) -> None:
    rig, truth = fisheye_rig(), Trajectory(np.arange(5, dtype=np.int64) * 1000 + 7, camera_path(5))
    files = {RIG_FILE: rig_to_text(rig), TRUTH_FILE: truth_to_bytes(truth), CONFIG_FILE: dump(Config())}
    with LogReader(log_with(tmp_path / "a.mcap", files)) as reader:
        back, poses = attached_rig(reader), attached_truth(reader)
        assert back is not None and poses is not None
        assert rig_to_text(back) == rig_to_text(rig)
        assert (back.left_T_right == rig.left_T_right).all()
        assert (poses.stamp_ns == truth.stamp_ns).all() and (poses.poses == truth.poses).all()
        assert attached_config(reader) == Config()


def test_a_log_without_them_has_none(tmp_path: Path) -> None:
    with LogReader(log_with(tmp_path / "a.mcap", {})) as reader:
        assert attached_rig(reader) is None and attached_truth(reader) is None and attached_config(reader) is None


@pytest.mark.parametrize("data", [b"", b"\xff\xfe\x00", b"PK\x03\x04 no archive", truth_to_bytes(
    Trajectory(np.zeros(1, np.int64), np.eye(4)[None]))[:-40]])  # fmt: skip
def test_invalid_trajectories_are_left_out(data: bytes, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with LogReader(log_with(tmp_path / "a.mcap", {TRUTH_FILE: data})) as reader, caplog.at_level(logging.WARNING):
        assert attached_truth(reader) is None
    assert len(caplog.messages) == 1
    assert "a.mcap: the attached ground_truth.npz is damaged" in caplog.text


@pytest.mark.parametrize("data", [b"\xff\xfe\x00", b"[tracker\n", b"\x00"])
def test_an_invalid_configuration_is_an_error(data: bytes, tmp_path: Path) -> None:
    with (
        LogReader(log_with(tmp_path / "a.mcap", {CONFIG_FILE: data})) as reader,
        pytest.raises(StereoSfmError, match=r"a\.mcap is not the log of a run"),
    ):
        read_run(reader)


def test_a_configuration_of_another_version_is_reported(tmp_path: Path) -> None:
    path = log_with(tmp_path / "a.mcap", {CONFIG_FILE: "[tracker]\nunheard_of = 1\n"})
    with LogReader(path) as reader, pytest.raises(StereoSfmError, match="another version") as caught:
        read_run(reader)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    "text", ["", "just words", "stereo_sfm_rig: 2\n", "stereo_sfm_rig: 1\nleft: {model: pinhole}\n"]
)
def test_a_malformed_calibration_names_the_log(text: str, tmp_path: Path) -> None:
    path = log_with(tmp_path / "a.mcap", {RIG_FILE: text})
    with LogReader(path) as reader, pytest.raises(StereoSfmError) as caught:
        attached_rig(reader)
    assert str(path) in str(caught.value) and "calibration.yaml" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_info_of_a_run_with_a_damaged_calibration_shows_the_rest(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with LogWriter(path) as writer:
        writer.metadata("stereo_sfm", {"image_format": "none", "source": "elsewhere"})
        writer.attach(RIG_FILE, b"\xff\xfe\x00")
    found = describe_file(path)
    assert "the calibration is damaged" in found.problems
    assert found.metadata["source"] == "elsewhere"
