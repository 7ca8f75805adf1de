"""The benchmark of real sequences: its switches exist, and its verdicts and comparisons are right."""

from __future__ import annotations

import importlib
import itertools
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import pytest

from stereo_sfm import config as configuration
from stereo_sfm.calib.choice import with_terms
from stereo_sfm.calib.rig import Rig
from stereo_sfm.drivers.sim.rigs import make_rig
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import RadTan
from stereo_sfm.types import Trajectory
from tests.synthetic import pinhole_rig

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


@pytest.fixture
def modules(monkeypatch: pytest.MonkeyPatch) -> dict[str, ModuleType]:
    monkeypatch.setattr(sys, "path", [str(BENCHMARKS), *sys.path])
    return {
        name: importlib.import_module(name)
        for name in ("_real_run", "_real_sequences", "_real_table", "_real_inject", "changed")
    }


def run(begin_s: float, ate_m: float | None, switch: str = "default", **more: Any) -> dict[str, Any]:
    fixed = {"code": "a", "sequence": "x", "error": "", "frames": 100, "lost": 0, "steps": 0, "still_m": 1.0}
    return {**fixed, "begin_s": begin_s, "switch": switch, "ate_m": ate_m, **more}


def test_what_a_switch_replaces_exists(modules: dict[str, ModuleType]) -> None:
    """A change of the package that moves a function must take its switch along."""
    for switch, replaced in modules["_real_run"].REPLACED.items():
        for name in replaced:
            module, path = name.split(":")
            owner: Any = importlib.import_module(module)
            for part in path.split("."):
                assert hasattr(owner, part), f"{switch}: {name}"
                owner = getattr(owner, part)


def test_the_settings_of_the_switches_exist(modules: dict[str, ModuleType]) -> None:
    for options in modules["_real_run"].OPTIONS.values():
        configuration.load(None, [value for option, value in itertools.pairwise(options) if option == "--set"])


def test_a_switch_that_is_clearly_better_is_told(modules: dict[str, ModuleType]) -> None:
    """By more than 5 per cent and two standard errors of the paired differences."""
    comparison, better = modules["_real_table"].comparison, modules["_real_table"].BETTER
    default = [run(k, 1.0 + 0.5 * k) for k in range(5)]
    assert better in comparison(default, [run(k, 0.9 + 0.5 * k) for k in range(5)])  # paired: the spread is common
    assert better not in comparison(default, [run(k, 0.99 + 0.5 * k) for k in range(5)])
    assert better not in comparison(default, [run(k, 2.5 - 0.3 * k) for k in range(5)])
    assert better not in comparison(default, [run(k, 1.1 + 0.5 * k) for k in range(5)])


def test_only_what_did_nothing_is_idle(modules: dict[str, ModuleType]) -> None:
    """A camera that recovers within an image, or that sensors bridge, is never lost, but was searched for."""
    del modules
    idle = importlib.import_module("real").idle
    assert idle("recovery", run(0, 1.0, not_ok=0)) and not idle("recovery", run(0, 1.0, not_ok=1, lost=0))
    assert idle("steps", run(0, 1.0, suspected=0)) and not idle("steps", run(0, 1.0, suspected=1))
    assert not idle("recovery", run(0, 1.0, not_ok=None)) and not idle("people", run(0, 1.0, not_ok=0, suspected=0))


def test_a_run_without_a_pose_is_as_bad_as_a_camera_that_stands_still(modules: dict[str, ModuleType]) -> None:
    comparison, better = modules["_real_table"].comparison, modules["_real_table"].BETTER
    default = [run(k, None, lost=100) for k in range(5)]
    said = comparison(default, [run(k, 0.1) for k in range(5)])
    assert said.count(better) == 2 and "error +90" in said and "lost +100.0" in said


def test_a_turned_right_camera_sees_what_its_calibration_would_expect(modules: dict[str, ModuleType]) -> None:
    """Points of a scene project to the warped pixels with the right camera turned, as `with_terms` turns it."""
    inject, rig = modules["_real_inject"], make_rig("distorted", (160, 100))
    assert tuple(inject.STEPS) == modules["_real_run"].STEPS
    for step, (axis, degrees) in inject.STEPS.items():
        turned = with_terms(rig, np.deg2rad(degrees) * np.eye(8)[axis])
        assert rig.right is not None
        points = rig.left_T_right[:3, 3] + 5.0 * rig.right.bearing_grid()[20:80, 30:130] @ rig.left_T_right[:3, :3].T
        before, after = (
            r.right.project(se3.transform(se3.inverse(r.left_T_right), points.reshape(-1, 3))) for r in (rig, turned)
        )
        at = after.astype(np.float32)[None]
        seen = np.stack([cv2.remap(m, at[..., 0], at[..., 1], cv2.INTER_LINEAR)[0] for m in inject.warp(rig, step)], -1)
        assert np.abs(seen - before).max() < 0.02  # OpenCV interpolates in steps of 1/32 px


def test_a_step_is_found_by_its_amount(modules: dict[str, ModuleType]) -> None:
    late = modules["_real_inject"].found_after_s

    def told(*changes: tuple[float, str, float]) -> list[dict[str, Any]]:
        return [{"seconds": s, "why": w, "terms": [0, y, 0, 0, 0, 0, 0, 0], "applied": True} for s, w, y in changes]

    before = (2.0, "significant", 0.2)
    assert late("step 0.3 y", told(before, (11.0, "step", 0.45)), 10.0) == 1.0
    assert late("step 0.3 y", told(before, (11.0, "step", 0.3)), 10.0) is None  # by 0.1
    assert late("step 0.3 y", told(before, (9.0, "step", 0.5)), 10.0) is None  # earlier
    assert late("step 0.3 y", told(before, (11.0, "refined", 0.5)), 10.0) is None


def test_a_verdict_counts_the_starts_that_hold(modules: dict[str, ModuleType]) -> None:
    table, sequences = modules["_real_table"], modules["_real_sequences"]
    limits = sequences.Limits(ate_m=0.5, lost=2, moves_more=True)
    sequence = sequences.Sequence("x", "x", limits)
    runs = [run(0, 0.4), run(1, 0.6), run(2, 0.4, lost=3), run(3, None, error="IndexError"), run(4, 0.4, steps=1)]
    said = table.verdict_of(sequence, runs, "default", runs)
    assert said.split(", ") == [
        "**NO** runs 4/5",
        "**NO** ≤ 0.500 m 3/5",
        "**NO** lost ≤ 2 4/5",
        "**NO** better than standing still 4/5",
        "**NO** no step 4/5",
    ]


def test_a_report_has_a_row_for_each_switch_and_compares_versions(modules: dict[str, ModuleType]) -> None:
    table, sequences = modules["_real_table"], modules["_real_sequences"]
    sequence = sequences.Sequence("x", "x", best_cpp="1 m")
    runs = [run(k, 1.0, switch) for k in range(3) for switch in ("default", "loops")]
    runs += [run(k, 0.5, code="b") for k in range(3)]
    text = table.markdown([sequence], ["a", "b"], ["new", "old"], runs)
    rows = [line for line in text.splitlines() if line.startswith("| x |")]
    assert [row.split("|")[2].strip() for row in rows] == [
        "default",
        "loops",
        "best C++",
        "default",
        "best C++",
        "default",
    ]
    assert "WORSE THAN BEFORE" in rows[-1] and table.BETTER not in text
    assert len({row.count("|") for row in rows[:-1]}) == 1


@pytest.mark.parametrize("upside_down", [False, True])
def test_a_flipped_rig_sees_the_flipped_images(modules: dict[str, ModuleType], upside_down: bool) -> None:
    """Also with lenses that are decentered; and the truth moves to the new left camera."""
    camera = pinhole_rig().left
    lens = RadTan(camera.width, camera.height, camera.fx, camera.fy, 310.0, 190.0, (-0.2, 0.05, 2e-3, -1e-3))
    away = se3.exp(np.array([0.1, 0.004, -0.01, 0.01, 0.02, -0.01]))
    rig = Rig(lens, replace(lens, cx=330.0), away)
    flipped = modules["changed"].flipped_rig(rig, upside_down)
    points = np.random.default_rng(0).uniform((-1, -1, 2), (1, 1, 6), (50, 3))
    turn = np.diag([-1.0, -1.0 if upside_down else 1.0, 1.0])
    old_left, old_right = rig.left.project(points), rig.project_right(points)
    in_new = (points - away[:3, 3]) @ away[:3, :3] @ turn
    sign = np.array([-1.0, -1.0 if upside_down else 1.0])
    edge = np.array([camera.width - 1.0, camera.height - 1.0]) * (sign < 0)
    assert flipped.left.project(in_new) == pytest.approx(edge + sign * old_right, abs=1e-6)
    assert flipped.project_right(in_new) == pytest.approx(edge + sign * old_left, abs=1e-6)
    truth = Trajectory(np.zeros(1, np.int64), se3.exp(np.array([0.3, 1.0, -2.0, 0.1, -0.4, 0.2]))[None])
    new = modules["changed"].flipped_truth(truth, rig, upside_down)
    world = points @ truth.poses[0, :3, :3].T + truth.poses[0, :3, 3]
    seen = in_new @ new.poses[0, :3, :3].T + new.poses[0, :3, 3]
    assert seen == pytest.approx(world if upside_down else world @ turn, abs=1e-9)


def test_a_halved_camera_sees_the_halved_image(modules: dict[str, ModuleType]) -> None:
    """A spot of light of odd images lies where the halved camera projects it."""
    lens = RadTan(201, 121, 150.0, 151.0, 99.0, 62.0, (-0.2, 0.05, 2e-3, -1e-3))
    point = np.array([0.21, -0.17, 1.3])
    at = lens.project(point)
    v, u = np.mgrid[: lens.height, : lens.width]
    spot = 250 * np.exp(-((u - at[0]) ** 2 + (v - at[1]) ** 2) / 18.0)
    half = modules["changed"].halved_image(spot.astype(np.uint8)).astype(float)
    camera = modules["changed"].halved(lens)
    assert half.shape == (camera.height, camera.width) == (60, 100)
    v, u = np.mgrid[: camera.height, : camera.width]
    centre = np.array([(u * half).sum(), (v * half).sum()]) / half.sum()
    assert camera.project(point) == pytest.approx(centre, abs=0.02)
