"""Descriptor trackers on a rendered store and on the real sequences: accuracy, ids, losing and finding, same bits."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import Config, FeaturesConfig, OdometryConfig, load
from stereo_sfm.drivers.source import open_source
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.eval.evaluate import evaluate
from stereo_sfm.geometry import se3
from stereo_sfm.papers.feature_tracker import FeatureTracker
from stereo_sfm.presets import PRESETS, preset
from stereo_sfm.tracking.factory import make_tracker
from stereo_sfm.types import F64, Frame, Keyframe, MapUpdate, StereoImage, TrackState, Trajectory

SPEC = "sim:aisle?camera=pinhole&frames=7&size=480x300"


@cache
def rendered() -> tuple[Rig, tuple[StereoImage, ...], F64]:
    """Rig, frames and true poses of a short sequence."""
    with open_source(SPEC) as source:
        images = tuple(source)
        assert source.ground_truth is not None
        rows = np.searchsorted(source.ground_truth.stamp_ns, [image.stamp_ns for image in images])
        return source.rig, images, source.ground_truth.poses[rows]


def config_for(method: str, kind: str = "orb", count: int = 800, **odometry: object) -> Config:
    return Config(
        features=FeaturesConfig(kind=kind, count=count), odometry=replace(OdometryConfig(method=method), **odometry)
    )


def track(config: Config, images: tuple[StereoImage, ...]) -> Iterator[tuple[Frame, Keyframe | None]]:
    tracker = make_tracker(config, rendered()[0])
    for image in images:
        yield tracker.step(image)


def step_errors(frames: list[Frame], poses: F64) -> tuple[F64, F64]:
    """Degrees and metres between consecutive frames."""
    estimate = np.array([frame.odom_T_cam for frame in frames])
    difference = se3.inverse(se3.inverse(poses[:-1]) @ poses[1:]) @ (se3.inverse(estimate[:-1]) @ estimate[1:])
    xi = se3.log(difference)
    return np.degrees(np.linalg.norm(xi[:, 3:], axis=1)), np.linalg.norm(xi[:, :3], axis=1)


@pytest.mark.parametrize(
    ("method", "kind", "degrees", "metres"),
    [
        ("em-r", "sift", 0.15, 0.02),
        ("vp-r", "orb", 0.3, 0.03),
        ("r-um", "akaze", 0.5, 0.04),
        ("pnp", "orb", 0.15, 0.02),
        ("eight-point", "orb", 0.3, 0.03),
    ],
)
def test_every_estimator_follows_a_sequence(method: str, kind: str, degrees: float, metres: float) -> None:
    _, images, poses = rendered()
    frames = [frame for frame, _ in track(config_for(method, kind), images)]
    assert all(frame.state == TrackState.OK for frame in frames)
    turn, shift = step_errors(frames, poses)
    assert np.median(turn) < degrees
    assert np.median(shift) < metres


def test_ids_name_one_physical_point_and_never_twice_in_a_frame() -> None:
    _, images, poses = rendered()
    seen: dict[int, F64] = {}
    distances: list[float] = []
    for (_, keyframe), pose in zip(track(config_for("pnp", keyframe_frames=1), images), poses, strict=True):
        assert keyframe is not None and len(np.unique(keyframe.point_ids)) == len(keyframe.point_ids)
        world = se3.transform(pose, keyframe.points_cam)
        for point, where in zip(keyframe.point_ids.tolist(), world, strict=True):
            if point in seen and np.linalg.norm(where - pose[:3, 3]) < 4:
                distances.append(float(np.linalg.norm(seen[point] - where)))
            seen[point] = where
    assert len(distances) > 200
    assert np.median(distances) < 0.06


def test_keyframes_come_by_frames_and_by_share() -> None:
    _, images, _ = rendered()
    by_frames = [k is not None for _, k in track(config_for("pnp", keyframe_frames=3, keyframe_ratio=0.0), images)]
    assert by_frames == [True, False, False, True, False, False, True]
    always = [k is not None for _, k in track(config_for("pnp", keyframe_ratio=1.1), images)]
    assert all(always)


def test_a_dark_gap_is_lost_and_recovered() -> None:
    _, images, poses = rendered()
    dark = [replace(image, left=np.zeros_like(image.left), right=np.zeros_like(image.left)) for image in images[3:5]]
    frames = [frame for frame, _ in track(config_for("pnp"), (*images[:3], *dark, *images[5:]))]
    assert [frame.state for frame in frames[3:6]] == [TrackState.LOST, TrackState.LOST, TrackState.RECOVERED]
    assert frames[3].reason == "too_few_points"
    assert np.linalg.norm(frames[-1].odom_T_cam[:3, 3] - (se3.inverse(poses[0]) @ poses[-1])[:3, 3]) < 0.05


def test_after_long_darkness_a_new_submap_begins() -> None:
    _, images, _ = rendered()
    black, lost_ns = np.zeros_like(images[0].left), round(1e9 * Config().tracker.lost_s)
    dark = [replace(images[1], left=black, right=black, stamp_ns=images[1].stamp_ns + k * lost_ns) for k in (1, 2)]
    last = replace(images[-1], stamp_ns=images[1].stamp_ns + 3 * lost_ns)
    sequence = (images[0], images[1], *dark, last)
    answers = list(track(config_for("pnp"), sequence))
    frame, keyframe = answers[-1]
    assert frame.state in (TrackState.RESTARTED, TrackState.RECOVERED)
    if frame.state == TrackState.RESTARTED:
        assert keyframe is not None and keyframe.submap_id == 1


def test_same_input_same_bits() -> None:
    _, images, _ = rendered()
    first, second = ([frame.odom_T_cam for frame, _ in track(config_for("em-r"), images[:4])] for _ in range(2))
    assert np.array_equal(first, second)


def test_map_updates_move_the_odometry_and_fuse_ids() -> None:
    rig, images, _ = rendered()
    tracker = FeatureTracker(config_for("pnp"), rig)
    frame, keyframe = tracker.step(images[0])
    assert keyframe is not None
    old, new = keyframe.point_ids[:2].tolist()
    shift = se3.exp(np.array([0.1, 0, 0, 0, 0, 0.0]))
    none = np.zeros(0, np.int64)
    tracker.apply(
        MapUpdate(1, 0, np.array([0]), shift[None], none, np.zeros((0, 3)), none, np.array([[old, new]]), np.eye(4))
    )
    after, _ = tracker.step(replace(images[0], frame_id=1))
    assert after.map_version == 1
    np.testing.assert_allclose(after.odom_T_cam, shift @ frame.odom_T_cam, atol=2e-3)
    assert old not in after.observations.point_ids


def test_one_camera_is_rejected_where_depth_is_needed() -> None:
    rig, _, _ = rendered()
    with pytest.raises(StereoSfmError, match="one camera"):
        make_tracker(config_for("em-r"), Rig(rig.left))
    with pytest.raises(StereoSfmError, match=r"odometry\.scale=unit"):
        make_tracker(config_for("eight-point"), Rig(rig.left))


def test_one_camera_with_unit_steps_and_with_true_steps() -> None:
    rig, images, poses = rendered()
    stamps = np.array([image.stamp_ns for image in images], np.int64)
    alone = [replace(image, right=None) for image in images]
    for scale, step in (("unit", 1.0), ("ground-truth", None)):
        config = config_for("eight-point", scale=scale)
        tracker = make_tracker(config, Rig(rig.left), None, Trajectory(stamps, poses))
        frames = [tracker.step(image)[0] for image in alone]
        lengths = np.linalg.norm(np.diff([frame.odom_T_cam[:3, 3] for frame in frames], axis=0), axis=1)
        true = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
        moved = lengths > 0  # a pure rotation has no direction, so no step
        assert moved.sum() >= 3
        np.testing.assert_allclose(lengths[moved], true[moved] if step is None else step, rtol=1e-6)


@pytest.mark.parametrize("name", list(PRESETS))
def test_presets_are_valid_configurations(name: str) -> None:
    assert load(base=preset(name)) is not None


def test_unknown_preset_is_one_clear_line() -> None:
    with pytest.raises(StereoSfmError, match="retail-thesis"):
        preset("orb-slam")


def run_preset(name: str, folder: Path, frames: int) -> tuple[Trajectory, Trajectory]:
    with open_source(folder) as source:
        tracker = make_tracker(load(base=preset(name)), source.rig)
        answers = [tracker.step(image)[0] for image, _ in zip(source, range(frames), strict=False)]
        good = [frame for frame in answers if frame.state in (TrackState.OK, TrackState.RECOVERED)]
        assert source.ground_truth is not None
        stamps = np.array([frame.stamp_ns for frame in good], np.int64)
        return Trajectory(stamps, np.array([frame.odom_T_cam for frame in good])), source.ground_truth


def test_sparse_localization_on_tum_beats_the_paper(data_root: Path) -> None:
    estimate, truth = run_preset("sparse-localization", data_root / "rgbd_dataset_freiburg1_xyz", 12)
    assert len(estimate) == 12
    assert evaluate(estimate, truth).ape_m.rmse < 0.167  # the paper's table I, fr1_xyz
    assert evaluate(estimate, truth).ape_m.rmse < 0.05


def test_the_course_system_starts_and_tracks_on_tum_with_one_camera(data_root: Path) -> None:
    estimate, truth = run_preset("cpp-course", data_root / "rgbd_dataset_freiburg1_xyz", 20)
    assert len(estimate) >= 12
    assert evaluate(estimate, truth).ate_sim3_m < 0.03
