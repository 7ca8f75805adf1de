"""The camera's tilt on a robot, from drives whose tilt is known."""

from __future__ import annotations

import numpy as np
import pytest

from stereo_sfm.geometry import se3
from stereo_sfm.maps.mounting import Mounting, MountingEstimate
from stereo_sfm.types import F64, Keyframe

FORWARD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
HEIGHT = 0.5


def camera(pitch_deg: float, roll_deg: float) -> F64:
    """(3, 3) from a camera that looks down and hangs down at its right to the robot's axes."""
    pitch = se3.so3_exp(np.deg2rad([-pitch_deg, 0.0, 0.0]))
    return FORWARD @ pitch @ se3.so3_exp(np.deg2rad([0.0, 0.0, roll_deg]))


def drive(turn: float, pitch: float, roll: float, floor: bool, rough: float = 1.0, count: int = 40) -> list[Keyframe]:
    """Keyframes every half metre of a drive that turns by so many radians each time. `rough`: of 1 mm, 0.03 deg."""
    rng, base_R_cam = np.random.default_rng(3), camera(pitch, roll)
    base_T_cam = se3.from_rotation_translation(base_R_cam, np.array([0.2, 0.0, HEIGHT]))
    world_T_base, out = np.eye(4), list[Keyframe]()
    first = se3.inverse(world_T_base @ base_T_cam)
    for k in range(count):
        noise = se3.exp(rough * np.concatenate([rng.normal(0, 1e-3, 3), rng.normal(0, np.deg2rad(0.03), 3)]))
        world_T_cam = world_T_base @ base_T_cam @ noise
        ahead = rng.uniform([0.7, -1.5, -HEIGHT if floor else 0.0], [4.0, 1.5, 0.0], (60, 3))
        if floor:
            ahead[:40, 2] = rng.normal(-HEIGHT, 0.01, 40)
        points = se3.transform(se3.inverse(base_T_cam), ahead + np.array([0.0, 0.0, HEIGHT]))
        nan, none = np.full((60, 2), np.nan), np.zeros((60, 32), np.uint8)
        out.append(Keyframe(k, k, k * 10**8, first @ world_T_cam, np.arange(60), nan, nan.copy(), points, none))
        world_T_base = world_T_base @ se3.exp(np.array([0.5, 0.0, 0.0, 0.0, 0.0, turn]))
    return out


def measured(keyframes: list[Keyframe]) -> Mounting:
    estimate = MountingEstimate()
    for keyframe in keyframes:
        estimate.add(keyframe)
    found = estimate.result()
    assert found is not None
    return found


@pytest.mark.parametrize(("turn", "floor"), [(0.1, False), (0.0, True), (0.1, True)])
def test_pitch_and_roll_of_a_flat_drive(turn: float, floor: bool) -> None:
    found = measured(drive(turn, 4.0, -2.0, floor))
    assert found.measured
    assert abs(found.pitch_deg - 4.0) < min(4 * found.pitch_sigma_deg, 0.2)
    assert abs(found.roll_deg + 2.0) < min(4 * found.roll_sigma_deg, 0.5)
    up = found.body_T_left[:3, :3] @ camera(4.0, -2.0).T @ [0.0, 0.0, 1.0]
    assert up[2] > np.cos(np.deg2rad(0.5))


def test_a_straight_drive_without_floor_shows_the_pitch_only() -> None:
    found = measured(drive(0.0, -3.0, 2.0, floor=False))
    assert found.measured and abs(found.pitch_deg + 3.0) < 0.2
    assert abs(found.roll_deg) < 0.5 and found.roll_sigma_deg > 2.0


def test_a_camera_in_a_hand_is_not_measured() -> None:
    found = measured(drive(0.1, 4.0, 0.0, floor=False, rough=60.0))
    assert not found.measured


def test_too_few_keyframes_say_nothing() -> None:
    estimate = MountingEstimate()
    for keyframe in drive(0.1, 4.0, 0.0, floor=False, count=5):
        estimate.add(keyframe)
    assert estimate.result() is None
