"""A sudden rotation of the right camera: noticed and measured in its image, given up if the camera does not stay so.

And what the tracker does when the map corrects its rig.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

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
from stereo_sfm.tracking.flow.keyframes import Keyframes
from stereo_sfm.tracking.flow.stereo_cameras import StereoCameras
from stereo_sfm.tracking.flow.sudden_turn import DECIDED, SUSPECTED, SuddenTurns
from stereo_sfm.tracking.flow.tracker import Tracker
from stereo_sfm.tracking.flow.tracks import Tracks
from stereo_sfm.types import F64, MapUpdate, StereoImage, TrackState, Trajectory, no_ids
from tests.synthetic import fisheye_rig, pinhole_rig, turned

RIGS = {"fisheye": fisheye_rig(), "pinhole": pinhole_rig()}
KNOCK_DEG = (0.0, 0.2, 0.0)
FRAMES, AT = 64, 40


class Sequence:
    """Points at 1 to 6 m that a camera at rest sees in image after image."""

    def __init__(self, rig: Rig, noise_px: float = 0.1) -> None:
        self.rig, self.noise_px, self.turns = rig, noise_px, SuddenTurns()
        self._rng = np.random.default_rng(0)
        self.uv = self._rng.uniform([0.2, 0.2], [0.8, 0.8], (200, 2)) * rig.left.size
        self.direction, self.depth = rig.left.unproject(self.uv), self._rng.uniform(1, 6, 200)
        self.last = self.image(rig)

    def image(self, seen_by: Rig, depth: F64 | None = None) -> Tracks:
        """An image by a rig, of points at other distances."""
        count, noise = len(self.uv), lambda: self._rng.normal(0, self.noise_px, self.uv.shape)
        uv_right = seen_by.project_right(self.direction * (self.depth if depth is None else depth)[:, None])
        return Tracks(
            np.arange(count), self.uv + noise(), uv_right + noise(), np.zeros((count, 3)), self.direction,
            1 / self.depth, np.full(count, 1e-6), np.full(count, 100, np.int32), np.zeros(count, np.int32),
            np.tile(np.eye(2), (count, 1, 1)), np.arange(count), np.zeros(count, bool), np.zeros(count, bool),
            np.zeros((count, 2)), np.zeros(count, bool),
        )  # fmt: skip

    def see(self, degrees: tuple[float, float, float], pose: F64 | None = None, depth: F64 | None = None) -> bool:
        """Whether `turn` changed with an image by a right camera that is turned by `degrees`."""
        image = self.image(turned(self.rig, degrees), depth)
        cameras = StereoCameras.of(self.rig)
        changed = self.turns.seen(self.last, np.eye(4), image, np.eye(4) if pose is None else pose, cameras)
        self.last = image
        return changed


def test_a_turn_that_the_mapper_refuses_is_given_up() -> None:
    """Else odometry goes on with a rig that is wrong, and without the map, to the end of the run."""
    turns, keyframes, tracker = SuddenTurns(), object.__new__(Keyframes), object.__new__(Tracker)
    turns.turn = np.array([0.002, 0.0, 0.0])
    assert "corrected if it stays so" in turns.news()
    own: Any = keyframes
    own._turn, own._turned_kf_id, own._first_of_rig = turns.turn, 10, 0
    own, used = tracker, list[str]()
    own._sudden, own._keyframes, own._sensors, own._tracks = turns, keyframes, None, Tracks()
    own._pose, own._velocity, own._resumed_T_odom = np.eye(4), np.zeros(6), np.eye(4)
    own._new_points = SimpleNamespace(triangulate_again=lambda *_: used.append("points"))
    own._use_rig = lambda: used.append("rig")
    for kf_id in range(10, 10 + DECIDED):
        tracker.apply(MapUpdate(kf_id, kf_id, no_ids(), np.zeros((0, 4, 4))))
        assert turns.turn.any() and not used
    tracker.apply(MapUpdate(20, 10 + DECIDED, no_ids(), np.zeros((0, 4, 4))))
    assert not turns.turn.any() and used == ["rig", "points"]
    assert "did not stay so" in turns.news()


@pytest.mark.parametrize("name", RIGS)
@pytest.mark.parametrize("degrees", [(0.0, 0.1, 0.0), (0.15, -0.1, 0.0), (0.0, 0.0, 0.5)])
def test_a_rotation_is_measured(name: str, degrees: tuple[float, float, float]) -> None:
    sequence = Sequence(RIGS[name])
    assert not any(sequence.see((0.0, 0.0, 0.0)) for _ in range(30))
    assert sequence.see(degrees)
    assert np.rad2deg(sequence.turns.turn) == pytest.approx(degrees, abs=0.01)
    assert not any(sequence.see(degrees) for _ in range(30))
    sequence.turns.confirmed(sequence.turns.turn)
    assert not sequence.turns.turn.any()


@pytest.mark.parametrize("name", RIGS)
def test_noise_a_wrong_pose_and_what_moves_are_no_rotation(name: str) -> None:
    sequence = Sequence(RIGS[name], 0.2)
    assert not any(sequence.see((0.0, 0.0, 0.0)) for _ in range(30))
    for xi in ([0.02, 0.01, -0.02, 0, 0, 0], [0, 0, 0, 0.002, 0.003, 0.004]):
        assert not sequence.see((0.0, 0.0, 0.0), se3.exp(np.array(xi)))
    nearer = np.where(sequence.depth < 2, sequence.depth / 1.1, sequence.depth)
    assert not sequence.see((0.0, 0.0, 0.0), depth=nearer)


@pytest.mark.parametrize("name", RIGS)
def test_a_rig_that_is_wrong_or_becomes_wrong_slowly_has_not_turned_suddenly(name: str) -> None:
    sequence = Sequence(RIGS[name])
    sequence.last = sequence.image(turned(RIGS[name], (0.2, 0.0, 0.0)))
    assert not any(sequence.see((0.2, 0.0, 0.25 * share)) for share in np.linspace(0.0, 1.0, 90))
    assert sequence.see((0.2, 0.25, 0.25))


@pytest.mark.parametrize("later", [(0.0, 0.0, 0.0), (0.0, 0.25, 0.0)])
def test_a_camera_that_turns_back_or_on_has_not_turned_for_good(later: tuple[float, float, float]) -> None:
    sequence = Sequence(RIGS["pinhole"])
    assert not any(sequence.see((0.0, 0.0, 0.0)) for _ in range(30))
    assert sequence.see((0.0, 0.1, 0.0)) and sequence.turns.turn.any()
    assert "0.10 degrees" in sequence.turns.news() and not sequence.turns.news()
    assert not any(sequence.see((0.0, 0.1, 0.0)) for _ in range(3))
    assert sequence.see(later) and not sequence.turns.turn.any()
    assert "did not stay so" in sequence.turns.news()


def test_a_rotation_that_begins_during_an_exposure_is_one() -> None:
    sequence = Sequence(RIGS["pinhole"])
    assert not any(sequence.see((0.0, 0.0, 0.0)) for _ in range(30))
    assert sequence.see((0.0, 0.1, 0.0)) and sequence.see((0.0, 0.25, 0.0))
    assert np.rad2deg(sequence.turns.turn) == pytest.approx((0.0, 0.25, 0.0), abs=0.01)


def test_on_a_mount_that_gives_nothing_is_sudden() -> None:
    """Which hops by 0.1 degrees about y: a rotation about x is sudden still."""
    sequence, rng = Sequence(RIGS["pinhole"]), np.random.default_rng(0)
    hops = 0.1 * rng.choice([-1, 0, 1], 60)
    changed = [sequence.see((0.0, hop, 0.0)) for hop in hops]
    assert not any(changed[20:])
    assert sequence.see((0.1, float(hops[-1]), 0.0))


def test_vibration_that_comes_back_is_no_rotation() -> None:
    """A camera that vibrates by 0.01 degrees hops by 0.04, and beyond where it was: what comes back has not turned."""
    sequence, rng = Sequence(RIGS["pinhole"], 0.02), np.random.default_rng(0)
    assert not any(sequence.see((0.0, x, 0.0)) for x in 0.01 * rng.standard_normal(60))
    assert not any(sequence.see((0.0, x, 0.0)) for x in (0.0, 0.04, -0.03, 0.0))
    assert sequence.see((0.0, 0.1, 0.0))


def test_a_rotation_on_top_of_a_steady_one() -> None:
    """Errors of distances look like a rotation that goes on: what it does not explain is sudden."""
    sequence, rng = Sequence(RIGS["pinhole"], 0.02), np.random.default_rng(0)
    course = np.cumsum(0.02 + 0.002 * rng.standard_normal(60))
    assert not any(sequence.see((0.0, x, 0.0)) for x in course)
    assert sequence.see((0.0, course[-1] + 0.08, 0.0))
    assert np.rad2deg(sequence.turns.turn) == pytest.approx((0.0, 0.06, 0.0), abs=0.01)


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
    poses, reasons, turns = list[F64](), list[str](), dict[int, F64]()
    for image in images:
        frame, keyframe = tracker.step(image)
        assert frame.state == TrackState.OK
        poses.append(frame.odom_T_cam)
        reasons.append(frame.reason)
        if keyframe is not None:
            turns[image.frame_id - images[0].frame_id] = keyframe.right_turn
            tracker.describe(keyframe)
    assert {k: reason for k, reason in enumerate(reasons) if reason} == {AT: reasons[AT]}
    assert reasons[AT].startswith(SUSPECTED)
    assert wrong_steps(poses, truth)[AT - 1 :].max() < 0.01
    assert not any(turn.any() for k, turn in turns.items() if k < AT)
    assert all(np.rad2deg(turn) == pytest.approx(KNOCK_DEG, abs=0.03) for k, turn in turns.items() if k >= AT)


def test_the_map_corrects_the_rig_soon(knocked: tuple[Rig, list[StereoImage], Trajectory]) -> None:
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
            assert step.why == "step" and step.stamp_ns - images[AT].stamp_ns < 1_500_000_000
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
