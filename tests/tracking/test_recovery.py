"""A covered lens: prediction, and relocalization in the same odometry."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import cache

import numpy as np
import pytest

from stereo_sfm.calib.choice import with_terms
from stereo_sfm.config import Config
from stereo_sfm.drivers.sim.options import SimOptions
from stereo_sfm.drivers.sim.scenes import SCENES
from stereo_sfm.drivers.sim.source import SimSource
from stereo_sfm.drivers.sim.world import Layout
from stereo_sfm.geometry import se3
from stereo_sfm.loop.recent_places import RecentPlaces
from stereo_sfm.pipeline.stages import make_tracker_with_places
from stereo_sfm.tracking.flow.follower import Follower, ReferenceImage
from stereo_sfm.tracking.flow.frame_pose import PoseSolution
from stereo_sfm.tracking.flow.klt import StereoPyramids
from stereo_sfm.tracking.flow.motion_prior import MotionPrior
from stereo_sfm.tracking.flow.partial_view import PartialView
from stereo_sfm.tracking.flow.recovery import REACH, Recovery
from stereo_sfm.tracking.flow.tracker import Tracker
from stereo_sfm.tracking.flow.tracks import Tracks
from stereo_sfm.types import F64, Corners, Frame, Keyframe, StereoImage, TrackState
from tests.synthetic import pinhole_rig

RATE, BEGIN, COVERED, FREE = 15, 60, range(72, 82), range(82, 90)  # frames: 0.67 s without sight


@cache
def drive() -> SimSource:
    scene = dataclasses.replace(SCENES["aisle"], layout=Layout(gondolas=2, gondola_length=6.0, products=40))
    return SimSource("aisle", scene, SimOptions(size=(424, 400), rate=RATE, speed=0.8))


@cache
def seen(frame_id: int) -> StereoImage:
    return drive().frame(frame_id)


def covered(frame_id: int) -> StereoImage:
    """A cloth in front of both lenses."""
    rng = np.random.default_rng(frame_id)
    left, right = (rng.normal(90, 2, (400, 424)).astype(np.uint8) for _ in range(2))
    return StereoImage(frame_id, drive().stamp_ns(frame_id), left, right)


def tracked(images: Sequence[StereoImage]) -> list[Frame]:
    tracker = make_tracker_with_places(Config(), drive().rig)
    frames: list[Frame] = []
    for image in images:
        frame, keyframe = tracker.step(image)
        if keyframe is not None:
            tracker.describe(keyframe)
        frames.append(frame)
    return frames


def error(a: Frame, b: Frame) -> tuple[float, float]:
    """Metres and degrees by which the motion between two frames is wrong."""
    true = se3.inverse(drive().pose(a.frame_id)) @ drive().pose(b.frame_id)
    metres, radians = se3.extent(se3.inverse(true) @ se3.inverse(a.odom_T_cam) @ b.odom_T_cam)
    return float(metres), float(np.rad2deg(radians))


def test_a_covered_camera_is_found_again_at_first_sight() -> None:
    images = [seen(k) for k in range(BEGIN, COVERED.start)] + [covered(k) for k in COVERED] + [seen(k) for k in FREE]
    frames = {frame.frame_id: frame for frame in tracked(images)}
    states = [frames[k].state for k in COVERED]
    assert states == [TrackState.OCCLUDED] * len(COVERED)
    sigmas = [float(np.sqrt(np.trace(frames[k].covariance[:3, :3]))) for k in COVERED]
    assert sigmas == sorted(sigmas)
    last = frames[COVERED[-1]]
    metres, _ = error(frames[COVERED.start - 1], last)
    assert metres < 0.15
    assert metres < 3 * sigmas[-1]
    again = [k for k in FREE if frames[k].state == TrackState.RECOVERED]
    assert again
    assert again[0] <= FREE.start + 2
    metres, degrees = error(frames[COVERED.start - 1], frames[again[0]])
    assert metres < 0.03
    assert degrees < 0.3
    assert frames[FREE[-1]].state == TrackState.OK


def test_a_camera_that_drove_on_while_covered_is_found_among_repeating_lamps() -> None:
    """For 1.8 s, half of the way from lamp to lamp: the ceiling alone agrees with another place."""
    again = range(COVERED.start + 27, COVERED.start + 32)
    cover = [covered(k) for k in range(COVERED.start, again.start)]
    frames = tracked([seen(k) for k in range(BEGIN, COVERED.start)] + cover + [seen(k) for k in again])
    found = [frame for frame in frames if frame.state == TrackState.RECOVERED]
    assert found
    assert found[0].frame_id <= again.start + 2
    metres, degrees = error(frames[COVERED.start - BEGIN - 1], found[0])
    assert metres < 0.03
    assert degrees < 0.3


def test_a_camera_that_turned_while_covered_is_found_in_half_a_second() -> None:
    again = range(COVERED.start + 20, COVERED.start + 27)
    last_T_now = se3.exp(np.array([0.0, 0.0, 0.7, 0.0, 1.0, 0.0]))
    turned = [drive().image_at(drive().pose(COVERED.start - 1) @ last_T_now, k) for k in again]
    cover = [covered(k) for k in range(COVERED.start, again.start)]
    frames = tracked([seen(k) for k in range(BEGIN, COVERED.start)] + cover + turned)
    found = [frame for frame in frames if frame.state == TrackState.RECOVERED]
    assert found
    moved = se3.inverse(frames[COVERED.start - BEGIN - 1].odom_T_cam) @ found[0].odom_T_cam
    metres, radians = se3.extent(se3.inverse(last_T_now) @ moved)
    assert metres < 0.03
    assert np.rad2deg(radians) < 0.3


def test_a_camera_that_reappears_elsewhere_is_not_found() -> None:
    turned = se3.exp(np.array([0, 0, 0, 0, np.pi, 0]))  # in one frame: no robot does that
    elsewhere = [drive().image_at(drive().pose(k) @ turned, k) for k in FREE]
    images = [seen(k) for k in range(BEGIN, COVERED.start)] + [covered(k) for k in COVERED] + elsewhere
    assert TrackState.RECOVERED not in [frame.state for frame in tracked(images)]


def keyframe(frame_id: int) -> Keyframe:
    """What a tracker that begins there makes of an image."""
    tracker = make_tracker_with_places(Config(), drive().rig)
    made = tracker.step(seen(frame_id))[1]
    assert made is not None
    return tracker.describe(made)


def test_places_are_found_with_the_corrected_rig() -> None:
    before, after = 71, FREE.start
    expected = se3.inverse(drive().pose(before)) @ drive().pose(after)
    wrong = with_terms(drive().rig, np.array([0.0, 0.02, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
    found: list[list[F64]] = []
    for rigs in ([wrong], [wrong, drive().rig], [drive().rig]):
        places = RecentPlaces(Config().loop, rigs[0])
        places.use(rigs[-1])
        places.add(keyframe(before))
        found.append(list(places.find(keyframe(after), expected)))
    assert min(float(se3.extent(se3.inverse(expected) @ pose)[0]) for pose in found[1]) < 0.03
    assert np.array_equal(found[1], found[2])
    assert not np.array_equal(found[1], found[0])


def moving(seconds: F64) -> list[F64]:
    """A robot that moves at 1 m/s and turns at 0.2 rad/s."""
    return [se3.exp(np.array([0.0, 0.0, 1.0, 0.0, 0.2, 0.0]) * t) for t in seconds]


def test_motion_prior_is_the_mean_of_the_last_second_with_growing_covariance() -> None:
    motion = MotionPrior()
    times = np.arange(0, 3, 0.1)
    for t, pose in zip(times, moving(times), strict=True):
        motion.add(round(t * 1e9), pose)
    assert motion.velocity() == pytest.approx([0.0, 0.0, 1.0, 0.0, 0.2, 0.0], abs=1e-9)
    soon, late = motion.expect(3_100_000_000), motion.expect(5_000_000_000)
    assert se3.extent(se3.inverse(moving(np.array([3.1]))[0]) @ soon.odom_T_cam)[0] < 0.01
    assert soon.sigma_m < 0.1 < late.sigma_m
    assert soon.sigmas_off(soon.odom_T_cam) == 0
    assert late.sigmas_off(moving(np.array([5.0]))[0]) < 1


def test_a_turn_is_not_predicted_to_go_on_for_long() -> None:
    motion = MotionPrior()
    for t, pose in zip(np.arange(0, 3, 0.1), moving(np.arange(0, 3, 0.1)), strict=True):
        motion.add(round(t * 1e9), pose)
    last = moving(np.array([2.9]))[0]
    metres, radians = se3.extent(se3.inverse(last) @ motion.expect(5_900_000_000).odom_T_cam)
    assert 1.5 < metres < 3.0
    assert radians < 0.2  # at 0.2 rad/s
    straight, *others = (se3.inverse(last) @ pose for pose in motion.others(5_900_000_000))
    assert se3.extent(straight)[1] < 1e-9
    assert min(float(se3.extent(other)[0]) for other in others) < 1e-9  # it stops
    turns = [float(se3.log(other)[4]) for other in others]
    assert max(turns) > 2.4  # half a turn is possible
    assert min(turns) < -2.4


@pytest.mark.parametrize(("recall", "seconds", "accepted"), [(0.64, 2.0, False), (0.69, 2.0, True), (0.2, 0.3, True)])
def test_less_certain_poses_need_more_of_the_view(recall: float, seconds: float, accepted: bool) -> None:
    """Ceiling and floor alone are less than two thirds of the view."""
    recovery = Recovery(None, None, (424, 400))
    recovery.motion.add(-100_000_000, np.eye(4))
    recovery.motion.add(0, np.eye(4))
    expected = recovery.motion.expect(round(seconds * 1e9))
    solution = PoseSolution(np.eye(4), np.zeros(6), np.eye(6), np.zeros(100), 0.3, 3.0, np.zeros(100, bool))
    assert recovery.possible(expected, solution, recall) == accepted


@pytest.mark.parametrize(("metres", "accepted"), [(0.1, True), (1.2, False), (-1.2, False)])
def test_where_a_steady_motion_ends_less_of_the_view_is_enough(metres: float, accepted: bool) -> None:
    """A ceiling repeats after 1.2 m."""
    recovery = Recovery(None, None, (424, 400))
    for t in (-1.0, 0.0):
        recovery.motion.add(round(t * 1e9), se3.exp(np.array([0.0, 0.0, 0.8 * t, 0.0, 0.0, 0.0])))
    stamp = 2_000_000_000
    expected, steady = recovery.motion.expect(stamp), recovery.motion.steady(stamp)
    there = se3.exp(np.array([0.0, 0.0, 1.6 + metres, 0.0, 0.0, 0.0]))
    solution = PoseSolution(there, np.zeros(6), np.eye(6), np.zeros(100), 0.3, 3.0, np.zeros(100, bool))
    assert recovery.possible(expected, solution, 0.5, steady) == accepted
    assert not recovery.possible(expected, solution, 0.5)


def test_without_places_there_is_no_search() -> None:
    recovery = Recovery(None, None, (424, 400))
    recovery.motion.add(0, np.eye(4))
    image = covered(0)
    assert list(recovery.search(image, None, recovery.motion.expect(10**8))) == []  # type: ignore[arg-type]


class Places:
    """Corners that a detector found, and no known place."""

    def __init__(self, corners: Corners) -> None:
        self.corners = corners

    def find_in(self, *_: object) -> Corners:
        return self.corners

    def add(self, keyframe: Keyframe) -> None: ...

    def find(self, *_: object) -> list[F64]:
        return []


def test_a_rim_beside_a_cover_is_not_a_free_view() -> None:
    """A fisheye of 848x800 px: as many corners as without the cover, all beyond 70 degrees.

    Shelves have theirs in a band across the image; the rim has them in as many cells.
    """
    rng = np.random.default_rng(0)
    radius, angle = 400 * np.sqrt(rng.uniform(0, 1, 400)), rng.uniform(0, 2 * np.pi, 400)

    def corners(radii: F64, angles: F64) -> Corners:
        around = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        uv = ([424.0, 400.0] + radii[:, None] * around).astype(np.float32)
        points = np.tile(np.array([0, 0, 2], np.float32), (len(uv), 1))
        return Corners(uv, uv.copy(), points, np.zeros((len(uv), 32), np.uint8))

    rim, part = 345 + 50 * radius / 400, angle < 1.5 * np.pi
    band, turned = (np.abs(radius * np.sin(angle + turn)) < 120 for turn in (0.0, np.pi))
    for before, now, free in (
        (corners(radius, angle), corners(radius, angle), True),
        (corners(radius, angle), corners(radius[part], angle[part]), True),
        (corners(radius, angle), corners(rim, angle), False),
        (corners(radius[band], angle[band]), corners(radius[turned], angle[turned] + np.pi), True),
        (corners(radius[band], angle[band]), corners(rim, angle), False),
    ):
        places = Places(now)
        recovery = Recovery(places, places, (848, 800))  # type: ignore[arg-type]
        recovery.remember(dataclasses.replace(keyframe(BEGIN), corners=before))
        recovery.motion.add(0, np.eye(4))
        pyramids = StereoPyramids([], np.zeros((1, 1), np.float32))
        list(recovery.search(covered(0), pyramids, recovery.motion.expect(10**8)))
        assert recovery.unobstructed == free


def wall(uv: F64, at: float = 0.0) -> Tracks:
    """Points (N, 2) px of a wall 4 m ahead of the odometry's origin, seen by a pinhole camera driven `at` metres."""
    bearing, n = pinhole_rig().left.unproject(uv), len(uv)
    return Tracks(
        np.arange(n), uv, uv, np.tile([0.0, 0.0, at], (n, 1)), bearing, bearing[:, 2] / (4.0 - at), np.ones(n),
        np.ones(n, np.int32), np.zeros(n, np.int32), np.zeros((n, 2, 2)), np.arange(n), np.zeros(n, bool),
        np.zeros(n, bool), np.zeros((n, 2)), np.zeros(n, bool),
    )  # fmt: skip


def along(metres: float) -> F64:
    return se3.exp(np.array([0.0, 0.0, metres, 0.0, 0.0, 0.0]))


def follower() -> Follower:
    tracker = make_tracker_with_places(Config(), pinhole_rig())
    assert isinstance(tracker, Tracker)
    return tracker._follower  # pyright: ignore[reportPrivateUsage]


WIDTH, HEIGHT = pinhole_rig().left.size
EVERYWHERE = np.stack(np.meshgrid(np.linspace(5, WIDTH - 6, 24), np.linspace(5, HEIGHT - 6, 18)), -1).reshape(-1, 2)
MIDDLE = (np.abs(EVERYWHERE / [WIDTH, HEIGHT] - 0.5) < 0.25).all(1)
PYRAMIDS = StereoPyramids((), ())


@pytest.mark.parametrize(("metres", "renewed"), [(0.0, False), (0.5, False), (2.5, True)])
def test_half_the_view_becomes_the_reference_once_little_of_a_whole_one_is_left(metres: float, renewed: bool) -> None:
    """A robot that stands keeps the image of the whole view; points added to it after a loss change nothing."""
    kept, tracks = follower(), wall(EVERYWHERE)
    kept.refer_to(PYRAMIDS, tracks, np.ones(len(tracks), bool), np.eye(4), np.eye(4))
    first = kept.reference
    first.add(tracks.append(tracks).append(tracks))
    kept.refer_to(PYRAMIDS, wall(EVERYWHERE, metres), EVERYWHERE[:, 0] < WIDTH / 2, along(metres), along(metres))
    assert (kept.reference is not first) == renewed


@pytest.mark.parametrize(("metres", "middle_is_better"), [(0.0, False), (2.0, True)])
def test_what_will_be_in_view_is_held(metres: float, middle_is_better: bool) -> None:
    """What a robot drives towards is still in view after it went on unseen, what is beside that is not."""
    kept, tracks = follower(), wall(EVERYWHERE)
    kept.refer_to(PYRAMIDS, tracks, MIDDLE, np.eye(4), along(metres))
    first = kept.reference
    kept.refer_to(PYRAMIDS, tracks, ~MIDDLE, np.eye(4), along(metres))
    assert (kept.reference is first) == middle_is_better


def test_a_pose_from_a_part_of_the_view_is_found_anew_once_more_is_free() -> None:
    reference, other = (ReferenceImage(StereoPyramids((), ()), Tracks(), np.eye(4)) for _ in range(2))
    part = PartialView()
    assert not part.wanted(reference, 0)
    few, more = 2e-4 * np.eye(6), 1e-4 * np.eye(6)
    part.begin(reference, 0.4, few, 0)
    assert part.wanted(reference, 10**9)
    assert not part.wanted(reference, 10**9 + 1)
    assert not part.wanted(other, 0)  # which became the reference since, and has the error
    near, far = (se3.exp(np.array([metres, 0.0, 0.0, 0.0, 0.0, 0.0])) for metres in (0.05, 0.5))
    assert part.improved(np.eye(4), near, 0.6, more)
    assert not part.improved(np.eye(4), near, 0.6, few)
    assert not part.improved(np.eye(4), near, 0.5, more)
    assert part.improved(np.eye(4), far, 0.6, few)  # one of the two is wrong: the one by less of the view
    assert not part.improved(np.eye(4), far, 0.5, more)
    part.end(0.6)
    assert part.wanted(reference, 0)
    part.end(0.7)
    assert not part.wanted(reference, 0)
    part.begin(reference, 0.7, more, 0)
    assert not part.wanted(reference, 0)


def test_a_new_submap_is_tracked_on_although_people_moved_before_it() -> None:
    """The robot drove on unseen; what the old points did, and that it may be fast, does not bind the new ones."""
    config = dataclasses.replace(Config().tracker, lost_s=2.5 / RATE)
    tracker = make_tracker_with_places(dataclasses.replace(Config(), tracker=config), drive().rig)
    assert isinstance(tracker, Tracker)
    stamp, frames = drive().stamp_ns(BEGIN), list[Frame]()
    far = [drive().frame(k) for k in range(400, 408)]  # nothing of which was seen before
    for n, image in enumerate([seen(k) for k in range(BEGIN, BEGIN + 6)] + far):
        if n == 5:  # something moved
            tracker._solver._alert_s = 0.5  # pyright: ignore[reportPrivateUsage]
        image = dataclasses.replace(image, stamp_ns=stamp + round(n * 1e9 / RATE))
        frame, keyframe = tracker.step(image)
        if keyframe is not None:
            tracker.describe(keyframe)
        frames.append(frame)
    states = [frame.state for frame in frames]
    begun = states.index(TrackState.RESTARTED)
    assert states[begun + 1 :] == [TrackState.OK] * (len(states) - begun - 1) != []
    for a, b in zip(frames[begun:], frames[begun + 1 :], strict=False):
        assert error(a, b)[0] < 0.01


def test_a_robot_of_unknown_speed_may_be_anywhere_near() -> None:
    motion = MotionPrior()
    motion.add(0, np.eye(4))
    there = se3.exp(np.array([0.0, 0.0, 0.1, 0.0, 0.05, 0.0]))
    assert motion.expect(100_000_000).sigmas_off(there) < REACH
    motion.add(50_000_000, np.eye(4))
    assert motion.expect(150_000_000).sigmas_off(there) > REACH


def test_one_image_without_a_pose_after_a_gap_begins_no_new_submap() -> None:
    """The camera was unplugged for longer than `lost_s`, and its first image shows another place."""
    stamp, gap_ns = drive().stamp_ns(BEGIN), round(2e9 * Config().tracker.lost_s)
    images = [seen(k) for k in range(BEGIN, BEGIN + 6)] + [drive().frame(400), seen(BEGIN + 6)]
    images = [
        dataclasses.replace(image, stamp_ns=stamp + round(n * 1e9 / RATE) + gap_ns * (n > 5))
        for n, image in enumerate(images)
    ]
    *_, other, again = tracked(images)
    assert other.state == TrackState.LOST
    assert again.state in (TrackState.LOST, TrackState.RECOVERED)


def test_a_car_that_goes_on_as_before_is_where_it_can_be() -> None:
    """Its speed does not return to that of a robot in a store."""
    motion = MotionPrior()
    for t in np.arange(0.0, 1.05, 0.1):
        motion.add(round(t * 1e9), se3.exp(np.array([0.0, 0.0, 12.0 * t, 0.0, 0.0, 0.0])))
    for t in (1.5, 2.0, 3.0):
        there = se3.exp(np.array([0.0, 0.0, 12.0 * t, 0.0, 0.0, 0.0]))
        assert motion.expect(round(t * 1e9)).sigmas_off(there) < REACH


def test_the_prior_is_stale_after_a_second_without_a_trusted_pose() -> None:
    motion = MotionPrior()
    motion.add(0, np.eye(4))
    assert not motion.stale(1_000_000_000) and motion.stale(1_100_000_000)
