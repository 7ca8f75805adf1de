"""The gate of stereo matches learns from a sequence how far its matches lie beside their epipolar curves."""

from __future__ import annotations

import numpy as np
import pytest

from stereo_sfm.calib.rig import Rig
from stereo_sfm.tracking.flow.epipolar_gate import EpipolarGate
from stereo_sfm.tracking.flow.stereo_cameras import StereoCameras
from stereo_sfm.tracking.flow.stereo_match import triangulate
from stereo_sfm.types import F64
from tests.synthetic import fisheye_rig, pinhole_rig

FIRST_PX, SIGMAS = 1 / 3, 3.0


def matches(rig: Rig, seed: int, rows_px: F64, scatter_px: float) -> tuple[F64, F64]:
    """Left and right pixels of points ahead; the right ones are lower by a plane over the image, and by noise."""
    rng = np.random.default_rng(seed)
    width, height = rig.left.size
    uv = rng.uniform([0.3 * width, 0.3 * height], [0.7 * width, 0.7 * height], (150, 2))
    bearing = rig.left.unproject(uv)
    right = rig.project_right(bearing * rng.uniform(2, 8, (150, 1)))
    lower = rows_px[0] + uv / [width, height] @ rows_px[1:] + rng.normal(0, scatter_px, 150)
    return uv, right + np.stack([np.zeros(150), lower], 1)


@pytest.mark.parametrize("rig", [pinhole_rig(), fisheye_rig()], ids=["pinhole", "fisheye"])
@pytest.mark.parametrize("rows_px", [[0.0, 0.0, 0.0], [2.5, 0.0, 0.0], [-1.0, 2.0, 1.5]])
@pytest.mark.parametrize("scatter_px", [0.1, 0.8])
def test_matches_of_a_poor_calibration_pass_and_wrong_ones_do_not(
    rig: Rig, rows_px: list[float], scatter_px: float
) -> None:
    gate = EpipolarGate(FIRST_PX, SIGMAS)
    for image in range(6):
        uv, right = matches(rig, image, np.array(rows_px), scatter_px)
        wrong = np.arange(len(uv)) % 5 == 0
        right[wrong, 1] += np.where(np.arange(len(uv))[wrong] % 2, 12.0, -12.0)
        passed = gate.passed(rig, uv, right, np.ones(len(uv), bool))
    assert passed[~wrong].mean() > 0.9
    assert not passed[wrong].any()


def test_nothing_is_learned_from_no_match() -> None:
    gate, rig = EpipolarGate(FIRST_PX, SIGMAS), pinhole_rig()
    uv, right = matches(rig, 0, np.zeros(3), 0.1)
    assert not gate.passed(rig, uv, right, np.zeros(len(uv), bool)).any()
    assert not gate.passed(rig, uv, np.full_like(right, np.nan), np.ones(len(uv), bool)).any()
    assert gate.passed(rig, uv, right, np.ones(len(uv), bool)).all()


def test_another_rig_has_another_plane() -> None:
    gate, rig = EpipolarGate(FIRST_PX, SIGMAS), pinhole_rig()
    for image in range(4):
        gate.passed(rig, *matches(rig, image, np.array([3.0, 0.0, 0.0]), 0.1), np.ones(150, bool))
    straight = matches(rig, 9, np.zeros(3), 0.1)
    gate.forget()
    assert gate.passed(rig, *straight, np.ones(150, bool)).mean() > 0.9


def test_a_poor_calibration_keeps_the_offset_of_each_match() -> None:
    """`triangulate` says how far a right pixel is from its curve: without that it lies where the point is seen."""
    rig = fisheye_rig()
    uv, right = matches(rig, 0, np.array([1.0, 2.0, -1.0]), 0.2)
    bearing, rho, _, offset = triangulate(uv, right, StereoCameras.of(rig), np.full(len(uv), 0.3))
    seen = rig.project_right(bearing / rho[:, None])
    assert np.abs(seen + offset - right).max() < 1e-6
    assert np.linalg.norm(offset, axis=1).mean() > 0.5
