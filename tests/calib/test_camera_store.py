"""Corrected calibrations go from one run of a camera to the next, and only to it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stereo_sfm.calib import load_rig, save_rig
from stereo_sfm.calib.camera_store import CameraStore, CorrectionKeeper
from stereo_sfm.calib.choice import with_terms
from stereo_sfm.calib.formats.native import rig_to_text
from stereo_sfm.calib.rig import Rig
from stereo_sfm.cli import main
from stereo_sfm.drivers.choice import SourceChoice
from stereo_sfm.drivers.source import open_source
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.log.reader import LogReader
from stereo_sfm.log.recorded import read_run
from stereo_sfm.types import F64, CalibrationUpdate
from tests.synthetic import fisheye_rig

TERMS = np.array([0.002, -0.001, 0, 0, 0, 0, 0, 0])
SPEC = "sim:aisle?size=212x200&frames=4&effects=0"


@pytest.fixture
def rig() -> Rig:
    return replace(fisheye_rig(), serial="0000D0C0FFEE")


def applied(terms: F64) -> CalibrationUpdate:
    return CalibrationUpdate(1, 0, 0, terms, np.eye(8), 0, True, "significant", "")


def test_the_next_run_starts_with_the_correction(rig: Rig, tmp_path: Path) -> None:
    store = CameraStore(tmp_path / "cameras")
    assert store.corrected(rig) is rig
    first = CorrectionKeeper(store.folder, rig)
    for share in (0.5, 1.0):  # the last of a run replaces its earlier ones
        first.keep(applied(share * TERMS))
    second = store.corrected(rig)
    assert rig_to_text(second) == rig_to_text(with_terms(rig, TERMS))
    next_run = CorrectionKeeper(store.folder, second)
    for share in (0.3, 0.1):  # a run that started with the correction refines it
        next_run.keep(applied(share * TERMS))
    third = store.corrected(rig)
    assert rig_to_text(third) == rig_to_text(with_terms(second, 0.1 * TERMS))
    assert sorted(p.name for p in store.folder.iterdir()) == [
        "0000D0C0FFEE.original.yaml", "0000D0C0FFEE.yaml"
    ]  # fmt: skip


def test_what_the_start_check_changed_besides_is_not_kept(rig: Rig, tmp_path: Path) -> None:
    """Masks, and another left lens: with them, the file would be of another calibration."""
    mask = np.ones((rig.left.height, rig.left.width), bool)
    left = replace(rig.left, fx=1.01 * rig.left.fx)
    CorrectionKeeper(tmp_path, replace(rig, left_mask=mask), rig).keep_last([])
    assert list(tmp_path.iterdir()) == []
    for _ in range(3):
        given = CameraStore(tmp_path).corrected(rig)
        CorrectionKeeper(tmp_path, replace(given, left=left, left_mask=mask), given).keep_last([applied(0.1 * TERMS)])
    thrice = with_terms(with_terms(with_terms(rig, 0.1 * TERMS), 0.1 * TERMS), 0.1 * TERMS)
    assert rig_to_text(CameraStore(tmp_path).corrected(rig)) == rig_to_text(thrice)


def test_what_is_only_reported_or_has_no_store_is_not_kept(rig: Rig, tmp_path: Path) -> None:
    CorrectionKeeper(tmp_path, rig).keep(replace(applied(TERMS), applied=False))
    CorrectionKeeper(None, rig).keep(applied(TERMS))
    assert list(tmp_path.iterdir()) == []


def test_a_camera_that_was_calibrated_anew_is_not_corrected(
    rig: Rig, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    store = CameraStore(tmp_path)
    store.keep(rig, with_terms(rig, TERMS))
    anew = with_terms(rig, np.array([0, 0, 0.001, 0, 0, 0, 0, 0]))
    assert store.corrected(anew) is anew and "corrects another calibration" in caplog.text
    CorrectionKeeper(tmp_path, anew).keep(applied(TERMS))
    assert rig_to_text(store.corrected(anew)) == rig_to_text(with_terms(anew, TERMS))


def test_cameras_do_not_share_corrections(rig: Rig, tmp_path: Path) -> None:
    store = CameraStore(tmp_path)
    store.keep(rig, with_terms(rig, TERMS))
    other = replace(rig, serial="OTHER")
    assert store.corrected(other) is other


@pytest.mark.parametrize("serial", ["", "../up", "a/b", "a b"])
def test_a_serial_number_that_is_no_file_name(rig: Rig, serial: str, tmp_path: Path) -> None:
    with pytest.raises(StereoSfmError, match="add `serial: NAME`"):
        CameraStore(tmp_path).corrected(replace(rig, serial=serial))


def test_a_folder_that_cannot_be_written_does_not_end_a_run(
    rig: Rig, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    keeper = CorrectionKeeper(tmp_path / "file", rig)
    (tmp_path / "file").write_text("")
    keeper.keep(applied(TERMS))
    assert "the corrected calibration is not kept" in caplog.text


def test_a_source_has_the_corrected_rig_and_a_log_records_it(tmp_path: Path) -> None:
    with open_source(SPEC) as source:
        rig = replace(source.rig, serial="A1")
    CameraStore(tmp_path).keep(rig, with_terms(rig, TERMS))
    choice = SourceChoice.of(SPEC, rig, camera_store=tmp_path)
    with choice() as source:
        assert rig_to_text(source.rig) == rig_to_text(with_terms(rig, TERMS))
        assert choice.opening(source.rig).rig is source.rig
        assert len(list(source)) == 4
    with pytest.raises(StereoSfmError, match="leave out rectify"):
        SourceChoice.of(SPEC, rig, rectify="wide", camera_store=tmp_path)


@pytest.mark.slow
def test_a_second_run_of_a_camera_needs_no_correction(data_root: Path, tmp_path: Path) -> None:
    walk, cameras = str(data_root / "store_walk"), tmp_path / "cameras"
    with open_source(walk) as source:
        true = source.rig
    wrong = replace(true, serial="A1", left_T_right=true.left_T_right @ se3.exp(np.array([0, 0, 0, 0.002, 0.003, 0])))
    save_rig(wrong, tmp_path / "wrong.yaml")
    for name in "ab":
        command = ["run", walk, "--rig", str(tmp_path / "wrong.yaml"), "--camera-store", str(cameras), "-q"]
        assert main([*command, "-o", str(tmp_path / name)]) == 0
    with LogReader(tmp_path / "b" / "run.mcap") as reader:
        opening = read_run(reader).opening
    kept = load_rig(cameras / "A1.yaml")
    assert opening.rig is not None and not (tmp_path / "b" / "rig_corrected.yaml").exists()
    for found in (kept, opening.rig):
        assert np.rad2deg(np.linalg.norm(se3.log(se3.inverse(found.left_T_right) @ true.left_T_right)[3:])) < 0.01
    again = ["replay", str(tmp_path / "b"), "-o", str(tmp_path / "c"), "-q", "--check"]
    assert main(again) == 0
