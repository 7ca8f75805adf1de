"""Rolling shutter: exact scenes, and the tracker on a rendered sequence."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import load
from stereo_sfm.drivers.source import open_source
from stereo_sfm.eval.evaluate import evaluate
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import KannalaBrandt, Pinhole
from stereo_sfm.tracking.flow import pose_solver
from stereo_sfm.tracking.flow.place_corners import PlaceCorners
from stereo_sfm.tracking.flow.readout import ReadoutSearch
from stereo_sfm.tracking.flow.rolling_shutter import RollingShutter
from stereo_sfm.tracking.flow.stereo_cameras import StereoCameras
from stereo_sfm.tracking.flow.tracker import Tracker
from stereo_sfm.types import F64, Corners, StereoImage, TrackState, Trajectory

LEFT_T_RIGHT = se3.exp(np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.0]))
CAMERAS = [
    Pinhole(640, 480, 400, 401, 320, 240),
    KannalaBrandt(848, 800, 286.2, 287.5, 419.5, 387.0, (-0.004348, 0.037126, -0.035539, 0.005773)),
]
VELOCITY = np.array([0.4, -0.2, 0.6, 0.5, -0.8, 0.3])  # m/s and rad/s: a hand in a hurry
SCALES = np.array([20.0, 10.0, 5.0, 3.0, 2.0, 2.0, 2.0, 2.0])


def rig(camera: Pinhole | KannalaBrandt, readout_s: float = 0.03) -> Rig:
    return Rig(camera, camera, LEFT_T_RIGHT, readout_s=readout_s)


def scene(camera: Pinhole | KannalaBrandt, seed: int) -> tuple[F64, F64, F64, F64]:
    """Pose at the stamp, points in the odometry frame, pixels of both cameras with a rolling shutter.

    Each row is put where the pixel of its own pose lies, by iteration to the last bit.
    """
    rng = np.random.default_rng(seed)
    pose = se3.exp(rng.normal(size=6) * [0.05, 0.05, 0.05, 0.03, 0.03, 0.03])
    uv = rng.uniform([80, 80], [camera.width - 80, camera.height - 80], (200, 2))
    points_cam = camera.unproject(uv) * rng.uniform(1, 8, (200, 1))
    points = se3.transform(pose, points_cam)
    pixels: list[F64] = []
    for left_T_cam in (np.eye(4), LEFT_T_RIGHT):
        seen = uv.copy()
        for _ in range(30):
            seconds = (seen[:, 1] / (camera.height - 1) - 0.5) * 0.03
            poses = [pose @ se3.exp(VELOCITY * s) @ left_T_cam for s in seconds]
            seen = np.array(
                [camera.project(se3.transform(se3.inverse(t), p[None]))[0] for t, p in zip(poses, points, strict=True)]
            )
        pixels.append(seen)
    return pose, points, pixels[0], pixels[1]


def solve(shutter: RollingShutter, points: F64, uv: F64, uv_right: F64, start: F64, sigma: float) -> tuple[F64, F64]:
    """Pose and velocity, the last frame 0.1 s before and a tenth slower than it is while the rows are read."""
    camera = CAMERAS[0]
    distance, n = np.linalg.norm(points, axis=1), len(points)
    cameras = StereoCameras.of(rig(camera))
    seen = pose_solver.SeenPoints(
        np.zeros((n, 3)), points / distance[:, None], 1 / distance, np.full(n, 1e-12), uv, uv_right,
        shutter.row_seconds(uv),
    )  # fmt: skip
    pose, velocity, _, _ = pose_solver.optimise_pose(
        start, 0.9 * VELOCITY * 0.1, 0.1, np.full(6, sigma), seen, cameras, 0.1, SCALES, np.eye(4), np.full(6, np.inf)
    )
    return pose, velocity


def test_pose_and_velocity_of_exact_rows() -> None:
    """Both cameras of an ideal pair have a point on one row, so nothing is approximated."""
    pose, points, uv, uv_right = scene(CAMERAS[0], 0)
    found, velocity = solve(RollingShutter(rig(CAMERAS[0])), points, uv, uv_right, pose, 10.0)
    assert np.abs(found - pose).max() < 1e-5
    assert np.abs(velocity - VELOCITY).max() < 2e-3
    blind, _ = solve(RollingShutter(rig(CAMERAS[0], 0.0)), points, uv, uv_right, pose, 10.0)
    assert np.abs(blind - pose).max() > 1e-3  # what rows do to a solver that does not know them


def test_a_steady_motion_constrains_the_velocity() -> None:
    pose, points, uv, uv_right = scene(CAMERAS[0], 1)
    _, velocity = solve(RollingShutter(rig(CAMERAS[0])), points, uv, uv_right, pose, 1e-6)
    assert np.abs(velocity - 0.9 * VELOCITY).max() < 0.05  # no rows can pull it away from the mean since the last frame


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda c: c.model)
def test_pixels_at_the_stamp_and_back(camera: Pinhole | KannalaBrandt) -> None:
    pose, points, uv, _ = scene(camera, 2)
    shutter = RollingShutter(rig(camera))
    points_cam = se3.transform(se3.inverse(pose), points)
    at_stamp, _ = shutter.at_stamp(uv, uv, points_cam, VELOCITY)
    assert np.abs(at_stamp - camera.project(points_cam)).max() < 1e-6
    assert np.linalg.norm(at_stamp - uv, axis=1).max() > 3.0
    assert np.abs(shutter.project(pose, VELOCITY, points, uv) - uv).max() < 0.02
    origin, direction = shutter.rays(pose, VELOCITY, uv, camera.unproject(uv))
    along = ((points - origin) * direction).sum(1, keepdims=True)
    assert np.abs(origin + along * direction - points).max() < 1e-6  # the ray of the row's own pose meets the point


def test_corners_are_moved_with_their_points() -> None:
    camera = CAMERAS[0]
    pose, points, uv, uv_right = scene(camera, 3)
    shutter = RollingShutter(rig(camera))
    origin, _ = shutter.rays(pose, VELOCITY, uv, camera.unproject(uv))
    bearing = camera.unproject(uv)
    seen = bearing * np.linalg.norm(points - origin, axis=1, keepdims=True)
    corners = Corners(
        uv.astype(np.float32), uv_right.astype(np.float32), seen.astype(np.float32), np.zeros((len(uv), 32), np.uint8)
    )
    moved = shutter.corners_at_stamp(corners, VELOCITY)
    points_cam = se3.transform(se3.inverse(pose), points)
    assert np.abs(moved.points_cam - points_cam).max() < 1e-5
    assert np.abs(moved.uv_left - camera.project(points_cam)).max() < 1e-3
    right = camera.project(se3.transform(se3.inverse(LEFT_T_RIGHT), points_cam))
    assert np.abs(moved.uv_right - right).max() < 1e-3


def test_a_global_shutter_changes_nothing() -> None:
    shutter = RollingShutter(rig(CAMERAS[0], 0.0))
    uv = np.array([[10.0, 20.0], [300.0, 470.0]])
    assert shutter.row_seconds(uv).shape == (0,)
    assert shutter.at_stamp(uv, uv, np.ones((2, 3)), VELOCITY)[0] is uv
    corners = Corners.none()
    assert shutter.corners_at_stamp(corners, VELOCITY) is corners


def test_the_velocity_is_constrained_by_the_steadiness_of_the_motion() -> None:
    steady, shaken = RollingShutter(rig(CAMERAS[0])), RollingShutter(rig(CAMERAS[0]))
    for k in range(200):
        steady.learn(VELOCITY, 1 / 30)
        shaken.learn(VELOCITY * (1.3 if k % 2 else 0.7), 1 / 30)
    assert steady.velocity_sigma().max() < 0.007
    change = np.sqrt((0.6 * VELOCITY).reshape(2, 3) ** 2 @ np.ones(3) / 3)
    assert shaken.velocity_sigma()[[0, 3]] == pytest.approx(0.5 * change + 0.005, rel=0.05)


def test_nearly_equal_stamps_do_not_disturb() -> None:
    shutter = RollingShutter(rig(CAMERAS[0]))
    shutter.learn(VELOCITY, 1 / 30)
    before = shutter.velocity_sigma()
    shutter.learn(1e4 * VELOCITY, 1e-7)
    assert np.array_equal(shutter.velocity_sigma(), before)


def test_equal_stamps_of_the_first_images_tell_no_velocity() -> None:
    with open_source("sim:aisle?camera=pinhole&size=320x200&frames=4&readout=0.025") as source:
        images, tracker = list(source), Tracker(load().tracker, source.rig)
    images[1] = dataclasses.replace(images[1], stamp_ns=images[0].stamp_ns)
    frames = [tracker.step(image)[0] for image in images]
    assert [f.state for f in frames] == [TrackState.INITIALIZING, *[TrackState.OK] * 3]
    assert all(np.isfinite(f.odom_T_cam).all() for f in frames)


def ate_mm(rig: Rig, images: list[StereoImage], truth: Trajectory, readout: ReadoutSearch | None = None) -> float:
    tracker = Tracker(load().tracker, rig, readout=readout)
    frames = [f for image in images if (f := tracker.step(image)[0]).state == TrackState.OK]
    assert len(frames) >= len(images) - 1
    poses = np.array([f.odom_T_cam for f in frames])
    return evaluate(Trajectory(np.array([f.stamp_ns for f in frames]), poses), truth).ape_m.rmse * 1e3


@pytest.mark.parametrize("seeds", [1, pytest.param(3, marks=pytest.mark.slow)])
@pytest.mark.parametrize("readout", [0.025, -0.025])
def test_a_rendered_sequence_with_a_rolling_shutter(readout: float, seeds: int) -> None:
    """A camera with vibration and a readout of 25 ms: much more accurate than without the model."""
    known, unknown = list[float](), list[float]()
    for seed in range(seeds):
        spec = f"sim:aisle?camera=pinhole&size=320x200&start=60&frames=60&vibration=4&readout={readout}&seed={seed}"
        with open_source(spec) as source:
            images, truth = list(source), source.ground_truth
            assert truth is not None and source.rig.readout_s == readout
            known.append(ate_mm(source.rig, images, truth))
            unknown.append(ate_mm(dataclasses.replace(source.rig, readout_s=0.0), images, truth))
    print(f"{known} mm, without the times of the rows {unknown} mm")
    assert max(known) < 3.5
    assert np.mean(known) < np.mean(unknown) / 2


@pytest.mark.parametrize("readout", [0.025, -0.025])
def test_a_run_learns_the_readout(readout: float) -> None:
    spec = f"sim:aisle?camera=pinhole&size=320x200&start=60&frames=100&vibration=4&readout={readout}"
    with open_source(spec) as source:
        images, truth, silent = list(source), source.ground_truth, dataclasses.replace(source.rig, readout_s=0.0)
    assert truth is not None
    watching, learning = ReadoutSearch(silent), ReadoutSearch(silent, applies=True)
    unknown, learned = ate_mm(silent, images, truth, watching), ate_mm(silent, images, truth, learning)
    assert watching.used_s == 0 and watching.measured.differs
    assert learning.used_s == pytest.approx(readout, abs=0.004)
    print(f"{learned} mm, without the times of the rows {unknown} mm")
    assert learned < 0.75 * unknown


def test_keyframes_of_a_rendered_sequence_are_those_of_a_global_shutter() -> None:
    """What the map gets: pixels where the points are at the stamp, of tracked and new points and of corners."""
    spec = "sim:aisle?camera=pinhole&size=320x200&rate=10&start=20&frames=40&vibration=4&readout=0.05"
    with open_source(spec) as source:
        rig, corners = source.rig, PlaceCorners(load(), source.rig)
        tracker = Tracker(load().tracker, rig, place_corners=corners)
        off, moved = [], []
        for image in source:
            _, keyframe = tracker.step(image)
            if keyframe is None:
                continue
            keyframe = tracker.describe(keyframe)
            left = rig.left.project(keyframe.points_cam)
            right_T_left = se3.inverse(rig.left_T_right)
            assert rig.right is not None
            right = rig.right.project(se3.transform(right_T_left, keyframe.points_cam))
            off += [np.hypot(*(keyframe.uv_left - left).T), np.hypot(*(keyframe.uv_right - right).T)]
            if not keyframe.described:
                continue
            seen = corners.find(image)
            moved.append(np.hypot(*(keyframe.corners.uv_left - seen.uv_left).T))
    assert len(moved) > 3
    assert np.nanpercentile(np.concatenate(off), 90) < 0.7
    assert np.percentile(np.concatenate(moved), 90) > 0.8
