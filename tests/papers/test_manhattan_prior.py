"""The rotation prior: corrects drift after enough evidence, rejects contradictions, keeps the frames of the map."""

from __future__ import annotations

from itertools import islice

import numpy as np
import pytest

from stereo_sfm.config import ManhattanConfig, load
from stereo_sfm.drivers.source import open_source
from stereo_sfm.eval.record import RunRecord
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.vanishing import Manhattan
from stereo_sfm.papers.manhattan_prior import ManhattanTracker, RotationFilter
from stereo_sfm.pipeline.inline import InlineRun
from stereo_sfm.presets import preset
from stereo_sfm.types import F64, Frame, Keyframe, MapUpdate, Observations, StereoImage, TrackState, Trajectory
from tests.synthetic import pinhole_rig

CONFIG = ManhattanConfig(every=1, drift_sigma_deg_per_frame=0.02)
WORLD_R_AXES = se3.so3_exp(np.array([0.1, -0.2, 0.3]))


def measurement(world_R_cam: F64, rng: np.random.Generator, sigma: float = 1e-3) -> Manhattan:
    noisy = se3.so3_exp(rng.normal(size=3) * sigma) @ world_R_cam.T @ WORLD_R_AXES
    return Manhattan(noisy, np.eye(3) * sigma**2, 0.8, np.array([9, 9, 9]), np.zeros(27, np.int64))


def camera_path(frames: int, bias_deg: float = 0.02) -> tuple[list[F64], list[F64]]:
    """True rotations, and those of a tracker whose heading drifts by `bias_deg` a frame."""
    truth, drifted = [np.eye(3)], [np.eye(3)]
    for k in range(frames):
        step = se3.so3_exp(np.array([0.0, 0.01 * np.sin(0.05 * k), 0.0]))
        truth.append(truth[-1] @ step)
        drifted.append(drifted[-1] @ step @ se3.so3_exp(np.radians([0, bias_deg, 0])))
    return truth, drifted


def degrees(a: F64, b: F64) -> float:
    return float(np.degrees(np.linalg.norm(se3.so3_log(a.T @ b))))


def test_drift_stays_bounded() -> None:
    truth, drifted = camera_path(400)
    rng = np.random.default_rng(0)
    rotation, prior = np.eye(3), RotationFilter(CONFIG)
    for k in range(1, 401):
        rotation = rotation @ drifted[k - 1].T @ drifted[k]
        prior.predict()
        rotation = prior.correct(rotation, measurement(truth[k], rng))
    assert degrees(drifted[-1], truth[-1]) > 7
    assert degrees(rotation, truth[-1]) < 0.8
    assert prior.refused == 0


def test_nothing_is_corrected_before_enough_measurements_agree() -> None:
    rng = np.random.default_rng(0)
    prior = RotationFilter(CONFIG)
    for k in range(20):
        wild = se3.so3_exp(np.array([0.0, 0.2 * k, 0.1 * k]))
        assert np.array_equal(prior.correct(np.eye(3), measurement(wild, rng)), np.eye(3))
    assert not prior.active


def test_a_contradicting_measurement_is_refused() -> None:
    rng = np.random.default_rng(0)
    prior = RotationFilter(CONFIG)
    for _ in range(10):
        prior.predict()
        prior.correct(np.eye(3), measurement(np.eye(3), rng))
    assert prior.active
    wrong = measurement(se3.so3_exp(np.radians([0, 6.0, 0])), rng)
    assert np.array_equal(prior.correct(np.eye(3), wrong), np.eye(3))
    assert prior.refused == 1


class Walker:
    """A tracker that reports given poses and remembers the update it got."""

    def __init__(self, poses: list[F64]) -> None:
        self.poses = poses
        self.update: MapUpdate | None = None

    def step(self, image: StereoImage) -> tuple[Frame, Keyframe | None]:
        pose = self.poses[image.frame_id]
        frame = Frame(image.frame_id, 0, pose, np.eye(6), TrackState.OK, "", Observations.empty(), 0, np.eye(4))
        return frame, None

    def describe(self, keyframe: Keyframe) -> Keyframe:
        raise AssertionError("there are no keyframes")

    def apply(self, update: MapUpdate) -> None:
        self.update = update


def test_updates_reach_the_tracker_in_its_own_frame() -> None:
    _, drifted = camera_path(30)
    poses = [se3.from_rotation_translation(r, np.array([0.1 * k, 0, 0])) for k, r in enumerate(drifted)]
    inner = Walker(poses)
    tracker = ManhattanTracker(inner, CONFIG, pinhole_rig())
    blank = np.full((480, 640), 90, np.uint8)
    for k in range(3):
        frame, _ = tracker.step(StereoImage(k, k, blank, blank))
    np.testing.assert_allclose(frame.odom_T_cam, poses[2], atol=1e-9)  # nothing seen, nothing changed
    # Turn the corrected pose away from the tracker's: a map point must land at the same place before the camera.
    correction = se3.exp(np.array([0.2, 0, 0, 0, 0.1, 0]))
    tracker._outer_T_inner = correction
    none = np.zeros(0, np.int64)
    map_T_odom = se3.exp(np.array([1.0, 2, 3, 0.1, 0.2, 0.3]))
    update = MapUpdate(
        1, 0, none, np.zeros((0, 4, 4)), none, np.zeros((0, 3)), none, np.zeros((0, 2), np.int64), map_T_odom
    )
    tracker.apply(update)
    assert inner.update is not None
    point = np.array([[0.3, -0.2, 4.0]])
    outer = se3.transform(se3.inverse(correction @ poses[2]) @ se3.inverse(map_T_odom), point)
    seen = se3.transform(se3.inverse(poses[2]) @ se3.inverse(inner.update.map_T_odom), point)
    np.testing.assert_allclose(seen, outer, atol=1e-12)


@pytest.mark.parametrize(
    ("name", "camera", "options"),
    [
        ("default", "fisheye", []),
        ("default", "fisheye", ["odometry.method=em-r", "features.kind=orb"]),
        ("cpp-course", "pinhole", []),
    ],
)
def test_a_compass_that_never_measures_changes_nothing(name: str, camera: str, options: list[str]) -> None:
    paths: list[Trajectory] = []
    for enabled in ("false", "true"):
        overrides = [*options, f"manhattan.enabled={enabled}", "manhattan.every=1000000", "loop.enabled=false"]
        config = load(None, overrides, preset(name))
        record = RunRecord.of(config)
        with open_source(f"sim:aisle?camera={camera}&size=424x400&rate=10") as source:
            run = InlineRun(source, config, [record], None)
            for image in islice(source, 1, 40):  # frame 0 is measured: it is a multiple of every number
                run.step(image)
            run.finish()
        paths.append(record.mapped())
    assert len(paths[0]) > 15
    np.testing.assert_array_equal(paths[1].stamp_ns, paths[0].stamp_ns)
    np.testing.assert_allclose(paths[1].poses, paths[0].poses, atol=1e-6)
