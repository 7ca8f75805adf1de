"""check-calib: exact tracks with a known fault, rendered and real recordings, verdicts and exit codes."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from stereo_sfm.calib import load_rig, save_rig, start, sticking
from stereo_sfm.calib.amount import FOCAL_BOTH, FOCAL_RATIO, TURN
from stereo_sfm.calib.check import CheckReport, Finding, check
from stereo_sfm.calib.choice import choose
from stereo_sfm.calib.consistency import Correction, estimate
from stereo_sfm.calib.matches import Matches
from stereo_sfm.calib.rectification import rectify
from stereo_sfm.calib.rig import Rig
from stereo_sfm.calib.scene_model import DIRECTION, SKEW
from stereo_sfm.calib.start import StartFinding
from stereo_sfm.calib.tracks import MAX_FRAMES, Window, collect, corners_for
from stereo_sfm.cli import main
from stereo_sfm.demo import demo_recording
from stereo_sfm.drivers.source import open_source
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Camera
from stereo_sfm.types import StereoImage
from tests.synthetic import fisheye_rig, pinhole_rig, turned


def scaled(camera: Camera | None, factor: float) -> Camera:
    assert camera is not None
    return replace(camera, fx=camera.fx * factor, fy=camera.fy * factor)


def magnified(rig: Rig, left: float, right: float) -> Rig:
    return replace(rig, left=scaled(rig.left, left), right=scaled(rig.right, right))


def windows(rig: Rig, skew_s: float = 0.0, motion: float = 1.0, count: int = 2) -> list[Window]:
    """Tracks of a moving rig before points at many depths: 0.1 px of noise, a few of them wrong, three moments."""
    rng = np.random.default_rng(0)
    out: list[Window] = []
    assert rig.right is not None
    for _ in range(count):
        points = rng.uniform([-4, -3, 1.0], [4, 3, 12], (250, 3))
        twist = motion * np.concatenate([rng.uniform(-0.25, 0.25, 3), rng.uniform(-0.15, 0.15, 3)])
        speed = motion * rng.uniform(-1, 1, 6) * [0.5, 0.5, 0.5, 0.6, 0.6, 0.6]
        left, right, velocity = np.empty((3, 250, 2)), np.empty((3, 250, 2)), np.empty((3, 250, 2))
        for f in range(3):
            p = se3.transform(se3.exp(f * twist), points)
            q = se3.transform(se3.inverse(rig.left_T_right), p)
            after = se3.transform(se3.inverse(rig.left_T_right) @ se3.exp(1e-4 * speed), p)
            velocity[f] = (rig.right.project(after) - rig.right.project(q)) / 1e-4
            left[f] = rig.left.project(p)
            right[f] = rig.right.project(q) + skew_s * velocity[f]
        left += 0.1 * rng.standard_normal(left.shape)
        right += 0.1 * rng.standard_normal(right.shape)
        right[:, :10] += rng.uniform(-8, 8, (3, 10, 2))
        seen = rig.left.inside(left[0]) & rig.right.inside(right[0])
        gone = ~(rig.left.inside(left) & rig.right.inside(right))
        left[gone], right[gone] = np.nan, np.nan
        out.append(Window(left[:, seen], right[:, seen], velocity[:, seen], Matches(left[0, seen], right[0, seen])))
    return out


FEW = "sim:aisle?frames=3&camera=distorted&size=480x300"
RIGS = {"fisheye": fisheye_rig(), "pinhole": pinhole_rig()}
SEEN = {name: windows(rig) for name, rig in RIGS.items()}


@pytest.mark.parametrize("name", RIGS)
def test_a_true_rig_needs_no_correction(name: str) -> None:
    correction = estimate(RIGS[name], SEEN[name])
    assert np.abs(np.rad2deg(correction.amount[TURN])).max() < 0.02
    assert abs(correction.amount[FOCAL_RATIO]) < 0.001 and abs(correction.vector[SKEW]) < 5e-4
    assert abs(correction.amount[FOCAL_BOTH]) < 0.004 and correction.shows_focal
    assert np.abs(np.rad2deg(correction.vector[DIRECTION])).max() < 0.5
    assert correction.noise_px == pytest.approx(0.1, abs=0.03)


@pytest.mark.parametrize("name", RIGS)
@pytest.mark.parametrize("degrees", [(0.2, 0, 0), (0, 0.2, 0), (0, -0.2, 0), (0, 0, -0.2)])
def test_a_turned_camera_is_measured(name: str, degrees: tuple[float, float, float]) -> None:
    wrong = turned(RIGS[name], degrees)
    correction = estimate(wrong, SEEN[name])
    np.testing.assert_allclose(np.rad2deg(correction.amount[TURN]), -np.array(degrees), atol=0.02)
    mended = choose(correction.whole, correction.halves).apply(wrong)
    left = np.rad2deg(se3.log(se3.inverse(mended.left_T_right) @ RIGS[name].left_T_right)[3:])
    assert np.abs(left).max() < 0.02


@pytest.mark.parametrize("name", RIGS)
def test_focal_errors_are_measured(name: str) -> None:
    rig = RIGS[name]
    one = estimate(magnified(rig, 1, 1.02), SEEN[name])
    assert 100 * one.amount[FOCAL_RATIO] == pytest.approx(-1.98, abs=0.1)
    both = estimate(magnified(rig, 0.98, 0.98), SEEN[name])
    assert 100 * both.amount[FOCAL_BOTH] == pytest.approx(2.02, abs=0.4)


def test_the_same_input_gives_the_same_bits() -> None:
    first, again = (estimate(RIGS["pinhole"], SEEN["pinhole"][:1]) for _ in range(2))
    assert np.array_equal(first.vector, again.vector) and np.array_equal(first.amount, again.amount)


def test_a_still_camera_does_not_show_the_focal_length_of_both_cameras() -> None:
    still = windows(RIGS["pinhole"], motion=0.001, count=1)
    for factor in (1.0, 1.02, 0.98):
        rig = magnified(RIGS["pinhole"], factor, factor)
        report = check(rig, rectify(rig), still)
        both = finding(report, "focal length, both cameras")
        assert not both.judged and both.level == 0 and "move the camera" in both.text
    one = magnified(RIGS["pinhole"], 1.02, 1)
    assert finding(check(one, rectify(one), still), "focal length, right relative to left").level == 2


def test_one_window_does_not_show_the_focal_length_of_both_cameras() -> None:
    rig = magnified(RIGS["pinhole"], 0.98, 0.98)
    both = [finding(check(rig, rectify(rig), SEEN["pinhole"][:n]), "focal length, both cameras") for n in (1, 2)]
    assert [(f.judged, f.level) for f in both] == [(False, 0), (True, 2)]


def finding(report: CheckReport, name: str) -> Finding:
    return next(f for f in report.findings if f.name == name)


def test_time_skew_is_measured() -> None:
    correction: Correction = estimate(RIGS["fisheye"], windows(RIGS["fisheye"], skew_s=0.004))
    assert 1e3 * correction.vector[SKEW] == pytest.approx(4.0, abs=0.5)


def judge(rig: Rig, images: list[StereoImage]) -> CheckReport:
    rectification = rectify(rig, "epipolar")
    gap = max(0, len(images) // 10 - MAX_FRAMES)
    return check(rig, rectification, collect(images, rectification, 10, gap, corners_for(len(images), 10)))


SLOW = [pytest.param(f, marks=pytest.mark.slow) for f in ("euroc_mh01", "t265_office", "kitti", "store_walk")]


@pytest.mark.parametrize("folder", ["tum_vi_room1", *SLOW])
def test_real_recordings(data_root: Path, folder: str) -> None:
    """benchmarks/check_calib.py tries every axis and both cameras."""
    with open_source(data_root / folder) as source:
        images, rig = list(source), source.rig
    assert judge(rig, images).verdict == "PASS"
    for degrees in ((0, 0.2, 0), (0, -0.2, 0)):
        assert judge(turned(rig, degrees), images).verdict == "FAIL"
    assert judge(magnified(rig, 1, 1.02), images).verdict == "FAIL"
    if folder in ("euroc_mh01", "kitti"):  # the others hardly move
        for factor in (1.02, 0.98):
            assert finding(judge(magnified(rig, factor, factor), images), "focal length, both cameras").level == 2


def test_command_verdict_exit_code_and_correction(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = FEW
    assert main(["check-calib", source]) == 0
    text = capsys.readouterr().out
    assert "verdict: PASS" in text and "row error by image region" in text
    with open_source(source) as opened:
        save_rig(turned(opened.rig, (0.2, 0, 0)), tmp_path / "wrong.yaml")
    mended = tmp_path / "mended.yaml"
    assert main(["check-calib", source, "--rig", str(tmp_path / "wrong.yaml"), "--correct", str(mended), "--json"]) == 3
    result = json.loads(capsys.readouterr().out)
    assert result["verdict"] == "FAIL"
    findings = {f["name"]: f for f in result["findings"]}
    rotation = findings["rotation between the cameras"]
    assert rotation["verdict"] == "FAIL" and rotation["value"][0] == pytest.approx(-0.2, abs=0.03)
    assert findings["focal length, both cameras"]["judged"] is False  # three frames
    assert findings["focal length, both cameras"]["verdict"] is None
    assert load_rig(mended).baseline == pytest.approx(0.075, rel=0.01)


def saying(finding: StartFinding) -> Callable[[Rig, Iterator[StereoImage], object], StartFinding]:
    """A start check that finds this in the first image."""

    def check_start(_rig: Rig, images: Iterator[StereoImage], _other: object) -> StartFinding:
        next(images)
        return finding

    return check_start


def in_first_images(capsys: pytest.CaptureFixture[str], command: list[str]) -> tuple[int, str]:
    """Exit code of a command, and its verdict on the first images."""
    code = main([*command, "--json", "--search", "14"])
    findings = json.loads(capsys.readouterr().out)["findings"]
    return code, next(f["verdict"] for f in findings if f["name"] == "first images")


def test_what_sticks_to_the_images_is_no_wrong_calibration(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def found(finding: StartFinding, rig: Rig, _: object) -> StartFinding:
        mask = np.ones((rig.left.height, rig.left.width), bool)
        return replace(finding, text="dirt", shown=True, masked=replace(rig, left_mask=mask))

    monkeypatch.setattr(sticking, "with_sticking", found)
    assert in_first_images(capsys, ["check-calib", FEW]) == (0, "WARN")
    monkeypatch.setattr(start, "check_start", saying(StartFinding("swapped", shown=True)))
    assert in_first_images(capsys, ["check-calib", FEW]) == (3, "FAIL")


def test_a_live_cameras_wrong_calibration_is_checked(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with open_source(FEW) as opened:
        other = turned(opened.rig, (1.5, 0, 0))
    monkeypatch.setattr(start, "check_start", saying(StartFinding("turned", other, shown=True)))
    assert in_first_images(capsys, ["check-calib", f"{FEW}&realtime=true"]) == (3, "FAIL")


def test_swapped_cameras_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("left", "right"):
        (tmp_path / name).mkdir()
    with open_source(demo_recording()) as source:
        save_rig(source.rig, tmp_path / "rig.yaml")
        for number, image in zip(range(12), source, strict=False):
            assert image.right is not None
            cv2.imwrite(str(tmp_path / "left" / f"{number:03d}.png"), image.right)
            cv2.imwrite(str(tmp_path / "right" / f"{number:03d}.png"), image.left)
    code = main(["check-calib", f"images:{tmp_path}?fps=15"])
    told = "".join(capsys.readouterr())
    assert code in (2, 3) and "left and right are swapped" in told and "calibrate again" not in told


def test_too_little_to_judge_and_wrong_units() -> None:
    rig = fisheye_rig()
    rectification = rectify(rig, "epipolar")
    with pytest.raises(StereoSfmError, match="only 0 stereo matches"):
        check(rig, rectification, [])
    huge = replace(rig, left_T_right=se3.exp(np.array([6.4, 0, 0, 0, 0, 0])))  # centimetres taken for metres
    report = check(huge, rectify(huge, "epipolar"), SEEN["fisheye"])
    assert "not a length in metres" in " ".join(f.text for f in report.findings) and report.verdict == "FAIL"
