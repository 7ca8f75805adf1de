"""A sudden rotation of the right camera: noticed in its image, measured by the map, given up if that sees none.

And what the tracker does when the map corrects its rig.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import Config, load
from stereo_sfm.drivers.memory import MemorySource
from stereo_sfm.drivers.sim.source import SimSource
from stereo_sfm.drivers.source import open_source
from stereo_sfm.eval.evaluate import evaluate
from stereo_sfm.eval.record import RunRecord
from stereo_sfm.geometry import se3
from stereo_sfm.pipeline.run import run
from stereo_sfm.tracking.factory import make_tracker
from stereo_sfm.tracking.flow.frame_pose import PoseSolution
from stereo_sfm.tracking.flow.knock import PAUSE_S, UNCONFIRMED_S, KnockDetector
from stereo_sfm.tracking.flow.stereo_cameras import StereoCameras
from stereo_sfm.tracking.flow.tracks import Tracks
from stereo_sfm.types import F64, StereoImage, TrackState, Trajectory
from tests.synthetic import fisheye_rig, pinhole_rig, turned

RIGS = {"fisheye": fisheye_rig(), "pinhole": pinhole_rig()}
KNOCK_DEG = (0.0, 0.2, 0.0)
FRAMES, AT = 64, 40


def known_points(rig: Rig, seen_by: Rig, noise_px: float, count: int = 200) -> tuple[Tracks, PoseSolution]:
    """Points at 1 to 6 m, tracked for long, from the origin."""
    rng = np.random.default_rng(0)
    uv = rng.uniform([0.2, 0.2], [0.8, 0.8], (count, 2)) * rig.left.size
    direction, depth = rig.left.unproject(uv), rng.uniform(1, 6, count)
    uv_right = seen_by.project_right(direction * depth[:, None])
    tracks = Tracks(
        np.arange(count), uv + rng.normal(0, noise_px, uv.shape), uv_right + rng.normal(0, noise_px, uv.shape),
        np.zeros((count, 3)), direction, 1 / depth, np.full(count, 1e-6), np.full(count, 100, np.int32),
        np.zeros(count, np.int32), np.tile(np.eye(2), (count, 1, 1)), np.arange(count), np.zeros(count, bool),
        np.zeros(count, bool), np.zeros((count, 2)),
    )  # fmt: skip
    return tracks, PoseSolution(np.eye(4), np.zeros(6), np.eye(6), np.zeros(count), 0.1, 3.0)


def watching(rig: Rig) -> KnockDetector:
    """One that has seen an image by the rig as it is calibrated."""
    detector = KnockDetector()
    assert detector.seen(*known_points(rig, rig, 0.1), StereoCameras.of(rig), 1 / 15) is None
    return detector


@pytest.mark.parametrize("name", RIGS)
@pytest.mark.parametrize("degrees", [(0.0, 0.2, 0.0), (0.15, -0.1, 0.0), (0.0, 0.0, 0.5)])
def test_a_rotation_is_measured(name: str, degrees: tuple[float, float, float]) -> None:
    rig = RIGS[name]
    tracks, solution = known_points(rig, turned(rig, degrees), 0.1)
    turn = watching(rig).seen(tracks, solution, StereoCameras.of(rig), 1 / 15)
    assert turn is not None and np.rad2deg(turn) == pytest.approx(degrees, abs=0.01)


@pytest.mark.parametrize("name", RIGS)
def test_noise_a_wrong_pose_and_what_moves_are_no_rotation(name: str) -> None:
    rig = RIGS[name]
    cameras = StereoCameras.of(rig)
    tracks, solution = known_points(rig, rig, 0.2)
    assert watching(rig).seen(tracks, solution, cameras, 1 / 15) is None
    for xi in ([0.02, 0.01, -0.02, 0, 0, 0], [0, 0, 0, 0.002, 0.003, 0.004]):
        off = replace(solution, pose=se3.exp(np.array(xi)))
        assert watching(rig).seen(tracks, off, cameras, 1 / 15) is None
    near = tracks.rho > np.median(tracks.rho)  # half of the points have come nearer, by a tenth of their distance
    tracks.rho[near] /= 1.1
    assert watching(rig).seen(tracks, solution, cameras, 1 / 15) is None


@pytest.mark.parametrize("name", RIGS)
def test_a_rig_that_is_wrong_from_the_start_is_no_knock(name: str) -> None:
    """Points show all of it at once, or over seconds, until one rotation explains nearly all; a later knock is one."""
    rig, detector = RIGS[name], KnockDetector()
    cameras = StereoCameras.of(rig)
    for _ in range(10):
        assert detector.seen(*known_points(rig, turned(rig, (0.2, 0.0, 0.0)), 0.1), cameras, 1 / 15) is None
    detector = KnockDetector()
    for share in np.linspace(0.01, 1.0, 90):
        tracks, solution = known_points(rig, turned(rig, (0.0, 0.0, 0.25 * share)), 0.1)
        assert detector.seen(tracks, solution, cameras, 1 / 15) is None
    tracks, solution = known_points(rig, turned(rig, (0.0, 0.25, 0.25)), 0.1)
    assert detector.seen(tracks, solution, cameras, 1 / 15) is not None


def test_what_the_map_does_not_confirm_is_given_up_for_a_while() -> None:
    detector = KnockDetector()
    detector.add(np.array([0.0, 0.003, 0.0]), 0)
    after = int(UNCONFIRMED_S * 1e9)
    assert not detector.given_up(after - 1) and detector.given_up(after)
    assert not detector.turn.any() and not detector.given_up(after + 1)
    assert not detector.watches(after + 1) and detector.watches(after + int(PAUSE_S * 1e9))


@pytest.fixture(scope="module", params=["pinhole&size=320x200", "fisheye&size=424x400"])
def knocked(request: pytest.FixtureRequest) -> tuple[Rig, list[StereoImage], Trajectory]:
    """A rig, and the images of one whose right camera is knocked."""
    with open_source(f"sim:loop?camera={request.param}&rate=15&frames={FRAMES}&start=20") as source:
        assert isinstance(source, SimSource) and source.ground_truth is not None
        rig, out = source.rig, list[StereoImage]()
        for frame_id in source.frame_ids.tolist():
            if len(out) == AT:
                source.renderer.rig = turned(rig, KNOCK_DEG)
            out.append(source.frame(frame_id))
        return rig, out, source.ground_truth


def wrong_steps(odometry: list[F64], truth: Trajectory) -> F64:
    """(N - 1,) metres by which the motion between successive images is wrong."""
    seen, true = np.array(odometry), truth.poses[: len(odometry)]
    off = se3.inverse(se3.inverse(true[:-1]) @ true[1:]) @ (se3.inverse(seen[:-1]) @ seen[1:])
    return np.linalg.norm(off[:, :3, 3], axis=1)


def test_the_odometry_goes_on_before_the_map_knows(knocked: tuple[Rig, list[StereoImage], Trajectory]) -> None:
    rig, images, truth = knocked
    tracker = make_tracker(Config(), rig)
    poses, turns = list[F64](), dict[int, F64]()
    for image in images:
        frame, keyframe = tracker.step(image)
        assert frame.state == TrackState.OK
        poses.append(frame.odom_T_cam)
        if keyframe is not None:
            turns[image.frame_id - images[0].frame_id] = keyframe.right_turn
            tracker.describe(keyframe)
    assert wrong_steps(poses, truth)[AT - 1 :].max() < 0.01
    assert not any(turn.any() for k, turn in turns.items() if k < AT)
    assert all(np.rad2deg(turn) == pytest.approx(KNOCK_DEG, abs=0.03) for k, turn in turns.items() if k >= AT)


def test_the_map_corrects_the_rig_within_a_second(knocked: tuple[Rig, list[StereoImage], Trajectory]) -> None:
    rig, images, truth = knocked
    ates = list[float]()
    for mode in ("auto", "off"):
        config = load(None, [f"self_calibration.mode={mode}"])
        record = RunRecord.of(config)
        for _ in run(MemorySource(rig, images, truth), config, [record]):
            pass
        mapped = record.mapped()
        assert mapped is not None
        ates.append(evaluate(mapped, truth).ape_m.rmse)
        if mode == "auto":
            step = record.calibrations[0]
            assert step.why == "step" and step.stamp_ns - images[AT].stamp_ns < 1_000_000_000
            assert np.rad2deg(record.calibrations[-1].terms[1]) == pytest.approx(0.2, abs=0.02)
    assert ates[0] < 0.25 * ates[1]


def test_the_odometry_does_not_jump_when_the_rig_is_corrected() -> None:
    """From a calibration that is wrong by 0.2 degrees: a tenth of every step is missing, and then nothing is."""
    with open_source("sim:loop?camera=pinhole&size=320x200&rate=15&frames=120&start=20") as source:
        images, truth = list(source), source.ground_truth
        wrong = turned(source.rig, KNOCK_DEG)
    assert truth is not None
    record = RunRecord.of(Config())
    frames = list(run(MemorySource(wrong, images, truth), Config(), [record]))
    off = wrong_steps([frame.odom_T_cam for frame in frames], truth)
    corrected = next(k for k, frame in enumerate(frames) if frame.map_version >= record.calibrations[0].version)
    assert all(frame.state == TrackState.OK for frame in frames) and corrected < 100
    assert off[corrected - 1] < 0.012 and off[corrected:].max() < 0.012
    assert np.median(off[corrected:]) < 0.25 * np.median(off[corrected // 2 : corrected])
