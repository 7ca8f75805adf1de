"""check-calib: exact tracks with a known fault, rendered and real recordings, verdicts and exit codes."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calib import load_rig, save_rig
from calib.check import CheckReport, check
from calib.consistency import DIRECTION, FOCAL, FOCAL_RIGHT, ROTATION, SKEW, estimate
from calib.matches import Matches
from calib.rectification import rectify
from calib.rig import Rig
from calib.tracks import Window, collect
from drivers.source import open_source
from stereo_sfm.cli import main
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Camera
from tests.synthetic import fisheye_rig, pinhole_rig


def turned(rig: Rig, degrees: tuple[float, float, float]) -> Rig:
    return replace(rig, left_T_right=rig.left_T_right @ se3.exp(np.array([0, 0, 0, *np.deg2rad(degrees)])))


def scaled(camera: Camera | None, factor: float) -> Camera:
    assert camera is not None
    return replace(camera, fx=camera.fx * factor, fy=camera.fy * factor)


def windows(rig: Rig, seed: int = 0, noise: float = 0.1, skew_s: float = 0.0, count: int = 4) -> list[Window]:
    """Tracks of a moving rig before a wall of points at many depths, a few of them wrong."""
    rng = np.random.default_rng(seed)
    out: list[Window] = []
    assert rig.right is not None
    for _ in range(count):
        points = rng.uniform([-4, -3, 1.0], [4, 3, 12], (400, 3))
        twist = np.concatenate([rng.uniform(-0.25, 0.25, 3), rng.uniform(-0.15, 0.15, 3)])
        speed = rng.uniform(-1, 1, 6) * [0.5, 0.5, 0.5, 0.6, 0.6, 0.6]
        left, right, velocity = np.empty((2, 400, 2)), np.empty((2, 400, 2)), np.empty((2, 400, 2))
        for f, move in enumerate((np.eye(4), se3.exp(twist))):
            p = se3.transform(move, points)
            q = se3.transform(se3.inverse(rig.left_T_right), p)
            after = se3.transform(se3.inverse(rig.left_T_right) @ se3.exp(1e-4 * speed), p)
            velocity[f] = (rig.right.project(after) - rig.right.project(q)) / 1e-4
            left[f] = rig.left.project(p)
            right[f] = rig.right.project(q) + skew_s * velocity[f]
        left += noise * rng.standard_normal(left.shape)
        right += noise * rng.standard_normal(right.shape)
        right[:, :12] += rng.uniform(-8, 8, (2, 12, 2))
        seen = rig.left.inside(left[0]) & rig.right.inside(right[0])
        gone = ~(rig.left.inside(left[1]) & rig.right.inside(right[1]))
        left[1, gone], right[1, gone] = np.nan, np.nan
        out.append(Window(left[:, seen], right[:, seen], velocity[:, seen], Matches(left[0, seen], right[0, seen])))
    return out


@pytest.mark.parametrize("rig", [fisheye_rig(), pinhole_rig()], ids=["fisheye", "pinhole"])
def test_a_true_rig_needs_no_correction(rig: Rig) -> None:
    correction = estimate(rig, windows(rig))
    assert np.abs(np.rad2deg(correction.vector[ROTATION])).max() < 0.05
    assert abs(correction.vector[FOCAL_RIGHT]) < 0.002 and abs(correction.vector[SKEW]) < 5e-4
    assert abs(correction.vector[FOCAL]) < 4 * np.sqrt(correction.loose_covariance[FOCAL, FOCAL])
    assert np.abs(np.rad2deg(correction.vector[DIRECTION])).max() < 0.5
    assert correction.noise_px == pytest.approx(0.1, abs=0.06)


@pytest.mark.parametrize("rig", [fisheye_rig(), pinhole_rig()], ids=["fisheye", "pinhole"])
@pytest.mark.parametrize("degrees", [(0.2, 0, 0), (0, 0.2, 0), (0, 0, 0.2), (-0.2, 0, 0), (0, -0.2, 0), (0, 0, -0.2)])
def test_a_turned_eye_is_measured(rig: Rig, degrees: tuple[float, float, float]) -> None:
    correction = estimate(turned(rig, degrees), windows(rig))
    np.testing.assert_allclose(np.rad2deg(correction.vector[ROTATION]), -np.array(degrees), atol=0.06)
    mended = correction.apply(turned(rig, degrees))
    left = np.rad2deg(se3.log(se3.inverse(mended.left_T_right) @ rig.left_T_right)[3:])
    assert np.abs(left).max() < 0.06


@pytest.mark.parametrize("rig", [fisheye_rig(), pinhole_rig()], ids=["fisheye", "pinhole"])
def test_focal_errors_are_measured(rig: Rig) -> None:
    seen = windows(rig)
    one = estimate(replace(rig, right=scaled(rig.right, 1.02)), seen)
    assert 100 * one.vector[FOCAL_RIGHT] == pytest.approx(-1.98, abs=0.3)
    both = estimate(replace(rig, left=scaled(rig.left, 0.98), right=scaled(rig.right, 0.98)), seen)
    assert 100 * both.vector[FOCAL] == pytest.approx(2.02, abs=0.6)


def test_time_skew_is_measured() -> None:
    rig = fisheye_rig()
    correction = estimate(rig, windows(rig, skew_s=0.004))
    assert 1e3 * correction.vector[SKEW] == pytest.approx(4.0, abs=0.5)


def judge(folder: Path, change: str = "", frames: int = 60) -> CheckReport:
    with open_source(folder) as source:
        images = [image for image, _ in zip(source, range(frames), strict=False)]
        rig = source.rig
    if change == "rotation":
        rig = turned(rig, (0.2, 0, 0))
    if change == "focal":
        rig = replace(rig, right=scaled(rig.right, 1.02))
    rectification = rectify(rig, "epipolar")
    return check(rig, rectification, collect(images, rectification, 4))


SLOW = [pytest.param(f, marks=pytest.mark.slow) for f in ("euroc_mh01", "t265_office", "kitti/sequences/00")]


@pytest.mark.parametrize("folder", ["tum_vi_room1", *SLOW])
def test_real_recordings(data_root: Path, folder: str) -> None:
    assert judge(data_root / folder).verdict in ("PASS", "WARN")
    assert judge(data_root / folder, "rotation").verdict == "FAIL"
    assert judge(data_root / folder, "focal").verdict == "FAIL"


def test_command_verdict_exit_code_and_correction(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = "sim:aisle?frames=4&camera=distorted&size=640x400"
    assert main(["check-calib", source]) == 0
    text = capsys.readouterr().out
    assert "verdict: PASS" in text and "row error by image region" in text
    with open_source(source) as opened:
        save_rig(turned(opened.rig, (0.2, 0, 0)), tmp_path / "wrong.yaml")
    mended = tmp_path / "mended.yaml"
    assert main(["check-calib", source, "--rig", str(tmp_path / "wrong.yaml"), "--correct", str(mended), "--json"]) == 3
    result = json.loads(capsys.readouterr().out)
    assert result["verdict"] == "FAIL"
    assert {f["name"]: f["verdict"] for f in result["findings"]}["rotation between the eyes"] == "FAIL"
    assert load_rig(mended).baseline == pytest.approx(0.075, rel=0.01)


def test_too_little_to_judge_and_wrong_units() -> None:
    rig = fisheye_rig()
    rectification = rectify(rig, "epipolar")
    with pytest.raises(StereoSfmError, match="only 0 stereo matches"):
        check(rig, rectification, [])
    huge = replace(rig, left_T_right=se3.exp(np.array([6.4, 0, 0, 0, 0, 0])))  # centimetres taken for metres
    report = check(huge, rectify(huge, "epipolar"), windows(rig))
    assert "not a length in metres" in " ".join(f.text for f in report.findings) and report.verdict == "FAIL"
