"""The default tracker on real and simulated sequences, and on disturbances in a store."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import pytest

from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import load
from stereo_sfm.drivers.memory import MemorySource
from stereo_sfm.drivers.rectified import RectifiedSource
from stereo_sfm.drivers.source import Source, open_source
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.eval.evaluate import evaluate
from stereo_sfm.geometry import se3
from stereo_sfm.tracking.flow.frame_pose import PoseSolution
from stereo_sfm.tracking.flow.klt import StereoPyramids
from stereo_sfm.tracking.flow.motion_prior import SPREAD
from stereo_sfm.tracking.flow.tracker import NOT_FOUND, Tracker
from stereo_sfm.tracking.flow.tracks import Tracks
from stereo_sfm.types import Frame, StereoImage, TrackState, Trajectory
from tests.synthetic import pinhole_rig

Change = Callable[[Iterator[StereoImage]], Iterator[StereoImage]]
CONFIG = load().tracker


def track(source: Source, count: int | None = None, change: Change | None = None) -> list[Frame]:
    with source:
        tracker = Tracker(CONFIG, source.rig)
        images = islice(source, count)
        return [tracker.step(image)[0] for image in (change(images) if change else images)]


def ate_mm(frames: list[Frame], truth: Trajectory | None) -> float:
    assert truth is not None
    good = [f for f in frames if f.state in (TrackState.OK, TrackState.RECOVERED)]
    estimate = Trajectory(np.array([f.stamp_ns for f in good]), np.array([f.odom_T_cam for f in good]))
    return evaluate(estimate, truth).ape_m.rmse * 1e3


def black(images: Iterator[StereoImage]) -> Iterator[StereoImage]:
    """One fully black frame."""
    for image in images:
        dark = np.zeros_like(image.left)
        yield dataclasses.replace(image, left=dark, right=dark.copy()) if image.frame_id == 30 else image


def dropped(images: Iterator[StereoImage]) -> Iterator[StereoImage]:
    """Five frames in a row are missing."""
    return (image for image in images if not 30 <= image.frame_id < 35)


def brighter(images: Iterator[StereoImage]) -> Iterator[StereoImage]:
    """The exposure jumps up by half and back down to sixty percent."""
    for image in images:
        gain = 1.5 if 20 <= image.frame_id < 40 else 0.6 if image.frame_id >= 40 else 1.0
        cameras = [np.clip(e.astype(float) * gain, 0, 255).astype(np.uint8) for e in (image.left, image.right)]
        yield dataclasses.replace(image, left=cameras[0], right=cameras[1])


def blurred(images: Iterator[StereoImage]) -> Iterator[StereoImage]:
    """One frame is blurred along a diagonal of nine pixels."""
    for image in images:
        cameras = [cv2.filter2D(e, -1, np.eye(9) / 9) if image.frame_id == 30 else e for e in (image.left, image.right)]
        yield dataclasses.replace(image, left=cameras[0], right=cameras[1])


@pytest.mark.parametrize(
    "change", [None, black, dropped, brighter, blurred], ids=lambda c: c.__name__ if c else "as recorded"
)
def test_euroc_with_disturbances(data_root: Path, change: Change | None) -> None:
    source = open_source(data_root / "euroc_mh01")
    frames = track(source, 70, change)
    lost = [f for f in frames if f.state == TrackState.LOST]
    assert len(lost) == (1 if change is black else 0)
    assert all(f.reason == "dark" for f in lost)
    assert ate_mm(frames, source.ground_truth) < 7.0
    if change is black:
        assert [f.state for f in frames if f.frame_id == 31] == [TrackState.RECOVERED]


@pytest.mark.parametrize(
    ("folder", "limit_percent"),
    [("kitti", 0.4), ("rgbd_dataset_freiburg1_xyz", 0.5)],  # 9 mm of 1.79 m
)
def test_accuracy_of_odometry_alone(data_root: Path, folder: str, limit_percent: float) -> None:
    source = open_source(data_root / folder)
    frames = track(source)
    if source.rig.readout_s:
        assert frames.pop(0).reason == "first_image"
    assert all(f.state == TrackState.OK for f in frames)
    assert source.ground_truth is not None
    path = source.ground_truth.length if folder == "kitti" else 1.79
    assert ate_mm(frames, source.ground_truth) / 1e3 / path * 100 < limit_percent


@pytest.mark.parametrize("folder", ["tum_vi_room1", "t265_office"])
def test_fisheyes_that_hardly_move(data_root: Path, folder: str) -> None:
    source = open_source(data_root / folder)
    with source:
        tracker, images = Tracker(CONFIG, source.rig), iter(source)
        _, keyframe = tracker.step(next(images))
        assert keyframe is not None
        depth = np.linalg.norm(tracker.describe(keyframe).points_cam, axis=1)
        frames = [tracker.step(image)[0] for image in images]
    assert all(f.state == TrackState.OK for f in frames)
    assert np.abs(frames[-1].odom_T_cam[:3, 3]).max() < 0.1
    assert len(depth) > 40
    assert 0.3 < np.percentile(depth, 5) < np.median(depth) < 8  # an office and a room


@pytest.mark.parametrize("scene", ["sim:aisle?camera=fisheye&size=424x400", "sim:aisle?camera=pinhole"])
def test_a_simulated_aisle(scene: str) -> None:
    source = open_source(f"{scene}&frames=40")
    frames = track(source)
    assert all(f.state == TrackState.OK for f in frames)
    assert ate_mm(frames, source.ground_truth) < 6.0


def test_rectified_fisheye() -> None:
    source = RectifiedSource(open_source("sim:aisle?camera=fisheye&size=424x400&frames=30"), "epipolar")
    frames = track(source)
    assert all(f.state == TrackState.OK for f in frames)
    assert ate_mm(frames, source.ground_truth) < 6.0


@pytest.mark.slow
def test_people_crossing() -> None:
    source = open_source("sim:people?frames=200")
    frames = track(source)
    assert all(f.state == TrackState.OK for f in frames)
    assert ate_mm(frames, source.ground_truth) < 0.002 * 1e3 * 7


def test_new_points_come_after_the_pose_of_their_keyframe(data_root: Path) -> None:
    """Described or not, a keyframe gets them before the next image is tracked."""
    with open_source(data_root / "euroc_mh01") as source:
        images = list(islice(source, 30))
        described, odometry_alone = Tracker(CONFIG, source.rig), Tracker(CONFIG, source.rig)
    more = 0
    for image in images:
        frame, keyframe = described.step(image)
        if keyframe is not None:
            complete = described.describe(keyframe)
            more += len(np.setdiff1d(complete.point_ids, frame.observations.point_ids))
        assert np.array_equal(odometry_alone.step(image)[0].odom_T_cam, frame.odom_T_cam)
    assert more > 20
    assert np.array_equal(odometry_alone.points, described.points)


def test_the_same_images_give_the_same_bits(data_root: Path) -> None:
    a, b = (track(open_source(data_root / "euroc_mh01"), 25) for _ in range(2))
    for x, y in zip(a, b, strict=True):
        assert np.array_equal(x.odom_T_cam, y.odom_T_cam)
        assert np.array_equal(x.observations.uv_right, y.observations.uv_right, equal_nan=True)


def test_a_long_loss_of_tracking_starts_a_submap(data_root: Path) -> None:
    def blind(images: Iterator[StereoImage]) -> Iterator[StereoImage]:
        for image in images:
            dark = np.zeros_like(image.left)
            yield dataclasses.replace(image, left=dark, right=dark) if 10 <= image.frame_id < 35 else image

    source = open_source(data_root / "euroc_mh01")
    with source:
        tracker = Tracker(CONFIG, source.rig)
        answers = [tracker.step(image) for image in blind(islice(source, 45))]
    states = [f.state for f, _ in answers]
    assert states[35] == TrackState.RESTARTED
    assert states[36:] == [TrackState.OK] * 9
    assert next(k.submap_id for _, k in answers if k is not None and k.frame_id >= 35) >= 1
    steps = np.linalg.norm(np.diff([f.odom_T_cam[:3, 3] for f, _ in answers], axis=0), axis=1)
    assert steps.max() < 0.2  # the odometry pose never jumps


def test_a_pose_that_was_searched_for_tells_no_velocity(data_root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It may jump, and the next images would be looked for farther along; the link to it is in doubt."""
    jump = se3.exp(np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.0]))
    with open_source(data_root / "euroc_mh01") as source:
        images = list(islice(source, 24))
        tracker = Tracker(CONFIG, source.rig)
    for image in images[:20]:
        tracker.step(image)
    before = tracker._velocity.copy()
    follow = tracker._follow

    def jumped(image: StereoImage, pyramids: StereoPyramids) -> tuple[Tracks, PoseSolution]:
        tracks, solution = follow(pyramids, tracker._predict(image.stamp_ns))
        return tracks, dataclasses.replace(solution, pose=solution.pose @ jump)

    with monkeypatch.context() as patch:
        patch.setattr(tracker, "_follow", lambda *_: NOT_FOUND)
        patch.setattr(tracker, "_search", jumped)
        frame, keyframe = tracker.step(images[20])
    assert frame.state == TrackState.RECOVERED
    assert np.linalg.norm(tracker._velocity[:3] - before[:3]) < 0.5  # not 0.1 m in 1/20 s
    assert keyframe is not None and keyframe.doubt[0] == pytest.approx((SPREAD[0] / 20) ** 2, rel=0.01)


def test_covariance_grows_where_little_is_seen(data_root: Path) -> None:
    frames = track(open_source(data_root / "euroc_mh01"), 10)
    assert all(np.linalg.eigvalsh(f.covariance).min() > 0 for f in frames[1:])


def test_one_camera_is_rejected_in_one_line() -> None:
    from stereo_sfm.geometry.cameras import Pinhole

    with pytest.raises(StereoSfmError, match="needs a stereo or RGB-D source"):
        Tracker(CONFIG, Rig(Pinhole(640, 480, 400, 400, 320, 240)))


def test_poses_are_rigid(data_root: Path) -> None:
    for frame in track(open_source(data_root / "euroc_mh01"), 40):
        rotation = frame.odom_T_cam[:3, :3]
        assert np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-9
        assert np.allclose(se3.inverse(frame.odom_T_cam) @ frame.odom_T_cam, np.eye(4))


def test_backwards_points_are_kept_as_long_as_forwards() -> None:
    """There and back twice: a tracker that loses points where the view widens makes keyframes instead."""
    with open_source("sim:aisle?size=212x200&frames=150") as source:
        images, rig = list(source), source.rig
    tracker = Tracker(load().tracker, rig)
    steps = [tracker.step(image) for image in MemorySource(rig, images, count=600, there_and_back=True)]
    keyframes = np.array([keyframe is not None for _, keyframe in steps]).reshape(4, 150).sum(1)
    back_at_start = steps[298][0].odom_T_cam[:3, 3] - steps[0][0].odom_T_cam[:3, 3]
    assert keyframes[1] + keyframes[3] < 1.5 * (keyframes[0] + keyframes[2])
    assert np.linalg.norm(back_at_start) < 0.02


def test_a_tracker_that_loses_its_second_image_begins_anew_at_once_but_once() -> None:
    """One image is nothing to wait for; a camera that shakes must not make a submap of every other image."""
    rng, rig, images = np.random.default_rng(0), pinhole_rig(), list[StereoImage]()
    for k in range(6):  # ten a second, unrelated to one another
        wide = cv2.GaussianBlur(rng.integers(0, 256, (480, 660)).astype(np.float32), (0, 0), 2.0)
        wide = cv2.normalize(wide, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
        left, right = (np.ascontiguousarray(side) for side in (wide[:, :640], wide[:, 16:656]))
        images.append(StereoImage(frame_id=k, stamp_ns=k * 100_000_000, left=left, right=right))
    tracker = Tracker(CONFIG, rig)
    states = [tracker.step(image)[0].state for image in images]
    ok, lost, begun = TrackState.OK, TrackState.LOST, TrackState.RESTARTED
    assert states == [ok, lost, begun, lost, lost, lost]


def test_a_hiccup_of_the_clock_is_no_motion(data_root: Path) -> None:
    """Two images are stamped a millisecond apart: 30 m/s would look for the next one far away."""
    with open_source(data_root / "euroc_mh01") as source:
        images = list(islice(source, 26))
        tracker = Tracker(CONFIG, source.rig)
    late = images[20].stamp_ns - 1_000_000
    images[19] = dataclasses.replace(images[19], stamp_ns=late)
    speeds = list[float]()
    for image in images:
        frame, _ = tracker.step(image)
        speeds.append(float(np.linalg.norm(tracker._velocity[:3])))
        assert frame.state == TrackState.OK
    assert max(speeds[19:]) < 2 * max(speeds[5:19])
    assert np.sqrt(tracker._solver._difference[0]) < 20.0
