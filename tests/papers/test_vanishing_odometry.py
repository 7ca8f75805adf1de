"""Rotation from vanishing points on rendered aisles, pinhole and fisheye, and the compass's refusals."""

from __future__ import annotations

import itertools

import cv2
import numpy as np
import pytest

from stereo_sfm.config import OdometryConfig
from stereo_sfm.drivers.source import open_source
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import KannalaBrandt
from stereo_sfm.geometry.lines import LineDetector
from stereo_sfm.geometry.robust import Degenerate
from stereo_sfm.geometry.vanishing import estimate, nearest_turn
from stereo_sfm.papers.motion_estimator import FramePair
from stereo_sfm.papers.odometry.vp_r import VpR
from stereo_sfm.types import F64, U8
from tests.papers.synthetic_views import frame_pair


def orientations(spec: str) -> tuple[list[F64], list[F64], list[F64]]:
    """Measured cam_R_axes, true cam_R_world and covariances along a sequence."""
    measured: list[F64] = []
    truth: list[F64] = []
    covariances: list[F64] = []
    with open_source(spec) as source:
        assert source.ground_truth is not None
        lines = LineDetector(source.rig.left)
        for image in source:
            row = int(np.searchsorted(source.ground_truth.stamp_ns, image.stamp_ns))
            rng, expected = np.random.default_rng(image.frame_id), measured[-1] if measured else None
            found = estimate(lines.detect(image.left), rng, expected=expected)
            measured.append(found.cam_R_axes)
            covariances.append(found.covariance)
            truth.append(source.ground_truth.poses[row, :3, :3].T)
    return measured, truth, covariances


def angles_deg(first: list[F64], second: list[F64]) -> F64:
    a, b = np.array(first), np.array(second)
    return np.degrees(np.linalg.norm(se3.so3_log(np.swapaxes(a, 1, 2) @ b), axis=1))


@pytest.mark.parametrize(
    ("spec", "degrees"),
    [
        ("sim:aisle?camera=pinhole&frames=8", 0.15),
        ("sim:aisle?camera=fisheye&frames=3", 0.1),
        pytest.param("sim:aisle?camera=pinhole&frames=40", 0.1, marks=pytest.mark.slow),
        pytest.param("sim:aisle?camera=fisheye&frames=20", 0.1, marks=pytest.mark.slow),
    ],
)
def test_rotation_between_frames_of_an_aisle(spec: str, degrees: float) -> None:
    measured, truth, _ = orientations(spec)
    relative = [b @ a.T for a, b in itertools.pairwise(measured)]
    true_relative = [b @ a.T for a, b in itertools.pairwise(truth)]
    assert np.median(angles_deg(relative, true_relative)) < degrees
    absolute = [nearest_turn(m, t) for m, t in zip(measured, truth, strict=True)]
    assert np.median(angles_deg(absolute, truth)) < 0.15  # the store's shelves stand along the world's axes


def picture_of_nothing(size: tuple[int, int]) -> U8:
    noise = np.random.default_rng(0).integers(0, 255, (size[1] // 8, size[0] // 8)).astype(np.uint8)
    smooth = cv2.GaussianBlur(cv2.resize(noise, size, interpolation=cv2.INTER_CUBIC), (0, 0), 3)
    return np.asarray(smooth, np.uint8)


def test_a_scene_without_structure_is_declined() -> None:
    camera = KannalaBrandt(424, 400, 142.0, 142.0, 212.0, 200.0, (-0.004, 0.038, -0.036, 0.006))
    image = picture_of_nothing(camera.size)
    with pytest.raises(Degenerate, match=r"weak_structure|too_few_lines"):
        estimate(LineDetector(camera).detect(image), np.random.default_rng(0))
    pair = frame_pair(np.eye(4))
    blank = FramePair(**{**vars(pair), "image_last": image, "image_now": image})
    with pytest.raises(Degenerate, match=r"weak_structure|too_few_lines"):
        VpR(OdometryConfig(method="vp-r"), camera)(blank, np.random.default_rng(0))
