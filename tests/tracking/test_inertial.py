"""Inertial motion against exact trajectories: estimates, accuracy in the dark, rejected sensors."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from stereo_sfm.calib import load_rig, save_rig
from stereo_sfm.calib.imu import Imu
from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import Config
from stereo_sfm.drivers.source import open_source
from stereo_sfm.eval.smoothing import smooth_bridges
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Pinhole
from stereo_sfm.geometry.preintegration import GRAVITY
from stereo_sfm.pipeline.run import run
from stereo_sfm.tracking.flow.keyframes import Keyframes
from stereo_sfm.tracking.inertial.agreement import SensorUse
from stereo_sfm.tracking.inertial.inertial_motion import InertialMotion, roll_pitch_deg
from stereo_sfm.tracking.inertial.motion_sensors import MotionSensors
from stereo_sfm.tracking.inertial.series import LONGEST_S, SampleBuffer, Series
from stereo_sfm.types import F64, I64, Bool, ImuSamples, StereoImage, TrackState

RATE_NS, FRAME_NS = 5_000_000, 50_000_000
GYRO_BIAS, ACCEL_BIAS = np.array([0.01, -0.02, 0.015]), np.array([0.05, -0.08, 0.1])
LEFT_T_IMU = se3.exp(np.array([0.05, -0.02, 0.01, 0.3, -1.2, 0.4]))


@dataclass(frozen=True)
class Session:
    """A camera that is moved by hand: smooth in all six directions."""

    seconds: float = 8.0
    offset_s: float = 0.0

    @property
    def imu(self) -> Imu:
        return Imu(left_T_imu=LEFT_T_IMU, gyro_noise=1.7e-4, accel_noise=2e-3, offset_s=self.offset_s)

    def pose(self, t: float) -> F64:
        """odom_T_cam."""
        turn = [0.2 * np.sin(1.3 * t), 0.3 * np.sin(0.9 * t + 1), 0.15 * np.cos(1.1 * t)]
        move = [0.8 * np.sin(0.7 * t), 0.3 * np.sin(1.1 * t), 0.5 * t + 0.2 * np.cos(0.8 * t)]
        return se3.from_rotation_translation(se3.so3_exp(np.array(turn)), np.array(move))

    def samples(self, seed: int = 0) -> ImuSamples:
        """Differences of the exact poses, with bias and noise; gravity is along +y of the odometry frame."""
        rng = np.random.default_rng(seed)
        stamps = np.arange(0, round(self.seconds * 1e9), RATE_NS)
        h = 1e-4
        gyro, accel = np.zeros((len(stamps), 3)), np.zeros((len(stamps), 3))
        for k, stamp in enumerate(stamps):
            before, now, after = (self.pose(stamp * 1e-9 + d) @ LEFT_T_IMU for d in (-h, 0, h))
            gyro[k] = se3.so3_log(before[:3, :3].T @ after[:3, :3]) / (2 * h)
            force = (before[:3, 3] - 2 * now[:3, 3] + after[:3, 3]) / h**2 - [0, GRAVITY, 0]
            accel[k] = now[:3, :3].T @ force
        gyro += GYRO_BIAS + rng.normal(0, 1.7e-4 * 200**0.5, gyro.shape)
        accel += ACCEL_BIAS + rng.normal(0, 2e-3 * 200**0.5, accel.shape)
        return ImuSamples(stamps + round(self.offset_s * 1e9), gyro, accel)


def follow(session: Session, until_s: float, samples: ImuSamples | None = None, seed: int = 0) -> InertialMotion:
    """Told the poses of all frames until a time, half a millimetre and half a minute of arc off."""
    motion, rng = InertialMotion(session.imu), np.random.default_rng(seed)
    samples = samples or session.samples(seed)
    at = 0
    for stamp in range(0, round(session.seconds * 1e9), FRAME_NS):
        until = int(np.searchsorted(samples.stamp_ns, stamp + round(session.offset_s * 1e9), side="right"))
        motion.feed(samples.part(slice(at, until)))
        at = until
        if stamp <= until_s * 1e9:
            noise = np.concatenate([rng.normal(0, 5e-4, 3), rng.normal(0, 1.5e-4, 3)])
            motion.accept(stamp, session.pose(stamp * 1e-9) @ se3.exp(noise))
    return motion


def test_samples_do_not_pile_up_while_no_image_has_a_pose() -> None:
    """Else each image of a night in the dark takes longer than the one before."""
    series, minute = Series(0.05), np.arange(0, 60 * 10**9, 10**7)
    for k in range(30):
        series.add(minute + k * 60 * 10**9, np.zeros((len(minute), 6)))
    assert len(series.stamp_ns) < 2 * len(minute) * (LONGEST_S / 60 + 1)
    assert series.edges(28 * 60 * 10**9, 30 * 60 * 10**9 - 10**7) is not None


def test_the_first_keyframe_of_a_new_submap_says_nothing_about_gravity() -> None:
    """Its pose is predicted: the camera may have been tilted while nothing was seen."""
    down = np.array([0.0, 1.0, 0.0])
    sensors: Any = SimpleNamespace(links=lambda *a: (None, None), samples=lambda: None, gravity=lambda p: (down, 0.01))
    keyframes: Any = object.__new__(Keyframes)
    keyframes._stamp_ns, keyframes._submap_id = 0, 0
    known = [keyframes._measured(sensors, 10**9, np.eye(4), submap) for submap in (0, 1)]
    assert known[0]["down"] is down and known[0]["down_sigma"] > 0.01
    assert "down" not in known[1]


@pytest.mark.parametrize("seed", range(3))
def test_gravity_biases_and_velocity_are_found(seed: int) -> None:
    session = Session()
    state = follow(session, 6.0, seed=seed).state
    assert state is not None
    angle = np.degrees(np.arccos(state.gravity[1] / np.linalg.norm(state.gravity)))
    assert angle < 0.2
    np.testing.assert_allclose(state.gyro_bias, GYRO_BIAS, atol=1e-3)
    np.testing.assert_allclose(state.accel_bias, ACCEL_BIAS, atol=0.04)
    h = 1e-4
    now, later = ((session.pose(6.0 + d) @ LEFT_T_IMU)[:3, 3] for d in (-h, h))
    np.testing.assert_allclose(state.velocity, (later - now) / (2 * h), atol=0.02)


def test_roll_and_pitch_against_gravity() -> None:
    tilted = se3.so3_exp(np.array([np.radians(20), 0, 0])) @ se3.so3_exp(np.array([0, 0, np.radians(10)]))
    np.testing.assert_allclose(roll_pitch_deg(tilted.T @ [0.0, GRAVITY, 0.0]), (10, 20), atol=1e-9)
    session = Session()
    pose = session.pose(6.0)
    level = MotionSensors(follow(session, 6.0), None).level(pose)
    assert not MotionSensors(follow(session, 1.0), None).level(pose)
    true = roll_pitch_deg(pose[:3, :3].T @ [0.0, GRAVITY, 0.0])
    np.testing.assert_allclose((level["roll_deg"], level["pitch_deg"]), true, atol=0.2)
    assert 0.0 < level["tilt_sigma_deg"] < 0.2


def test_a_turn_that_only_the_images_see_does_not_tilt_gravity() -> None:
    session, rng = Session(), np.random.default_rng(0)
    samples, motion, at = session.samples(0), InertialMotion(session.imu), 0
    slip = np.radians(1.0) * np.array([0.6, 0.0, 0.8])  # of the odometry, between the fifth and the sixth second
    for stamp in range(0, round(6.2e9), FRAME_NS):
        until = int(np.searchsorted(samples.stamp_ns, stamp, side="right"))
        motion.feed(samples.part(slice(at, until)))
        at = until
        turn = se3.so3_exp(np.clip(stamp * 1e-9 - 5.0, 0.0, 1.0) * slip)
        noise = np.concatenate([rng.normal(0, 5e-4, 3), rng.normal(0, 1.5e-4, 3)])
        exact = session.pose(stamp * 1e-9)
        motion.accept(stamp, se3.from_rotation_translation(turn @ exact[:3, :3], exact[:3, 3]) @ se3.exp(noise))
    assert motion.state is not None
    down = se3.so3_exp(slip) @ np.array([0.0, 1.0, 0.0])
    assert np.degrees(np.linalg.norm(np.cross(motion.state.gravity / GRAVITY, down))) < 0.25


class Turns(Session):
    """Turns that begin and end within a third of a second."""

    def pose(self, t: float) -> F64:
        turn = np.array([0.05 * np.sin(1.3 * t), 0.6 * np.tanh(3 * np.sin(t)), 0.03 * np.cos(1.1 * t)])
        return se3.from_rotation_translation(se3.so3_exp(turn), super().pose(t)[:3, 3])


@pytest.mark.parametrize("offset_s", [0.005, 0.02])
def test_a_wrong_time_offset_hardly_turns_the_pose_of_the_images(offset_s: float) -> None:
    session, sigma = Turns(seconds=7.5), 1e-4
    imu, samples, rng, at = Turns().imu, replace(session, offset_s=offset_s).samples(), np.random.default_rng(0), 0
    motion, errors = InertialMotion(imu), list[float]()
    covariance = np.diag([1e-6, 1e-6, 1e-6, sigma**2, sigma**2, sigma**2])
    for stamp in range(0, round(session.seconds * 1e9), FRAME_NS):
        until = int(np.searchsorted(samples.stamp_ns, stamp + round(offset_s * 1e9), side="right"))
        motion.feed(samples.part(slice(at, until)))
        at, exact = until, session.pose(stamp * 1e-9)
        pose = motion.fused(stamp, exact @ se3.exp(rng.normal(0, 1, 6) * np.sqrt(np.diag(covariance))), covariance)
        motion.accept(stamp, pose)
        errors.append(float(np.linalg.norm(se3.so3_log(exact[:3, :3].T @ pose[:3, :3]))))
    assert max(errors[50:]) < np.radians(0.1)


@pytest.mark.parametrize("seed", range(3))
def test_in_the_dark_the_error_stays_small_and_is_known(seed: int) -> None:
    session = Session()
    motion = follow(session, 5.0, seed=seed)
    for seconds, limit_m in ((0.5, 0.01), (1.5, 0.04), (2.5, 0.1)):
        stamp = round((5.0 + seconds) * 1e9)
        assert motion.bridge(stamp) is not None
        error = se3.inverse(motion.predict(stamp, np.eye(4))) @ session.pose(stamp * 1e-9)
        covariance = motion.covariance(stamp)
        assert covariance is not None
        assert np.linalg.norm(error[:3, 3]) < min(limit_m, 4 * np.sqrt(np.trace(covariance[:3, :3])))
        assert np.degrees(np.linalg.norm(se3.so3_log(error[:3, :3]))) < 0.2
    assert MotionSensors(motion, None).bridge(round(30e9)) is None


def test_before_velocity_is_known_only_the_rotation_is_predicted() -> None:
    session = Session()
    expected = se3.from_rotation_translation(np.eye(3), np.array([1.0, 2.0, 3.0]))
    np.testing.assert_array_equal(follow(session, 0.3).predict(350_000_000, expected), expected)  # nothing shown yet
    motion, stamp = follow(session, 1.0), 1_050_000_000
    predicted = motion.predict(stamp, expected)
    np.testing.assert_array_equal(predicted[:3, 3], expected[:3, 3])
    turned = predicted[:3, :3].T @ session.pose(stamp * 1e-9)[:3, :3]
    assert np.degrees(np.linalg.norm(se3.so3_log(turned))) < 0.2
    assert motion.bridge(stamp) is None


def test_the_time_offset_is_corrected() -> None:
    assert follow(Session(offset_s=0.03), 6.0).state is not None
    state = follow(Session(offset_s=0.03), 6.0).state
    assert state is not None
    np.testing.assert_allclose(state.gyro_bias, GYRO_BIAS, atol=1e-3)


@pytest.mark.parametrize("wrong", ["sign", "degrees"])
def test_a_sensor_that_contradicts_the_images_is_left_out(wrong: str) -> None:
    session = Session()
    good = session.samples()
    gyro = -good.gyro if wrong == "sign" else np.degrees(good.gyro)
    motion = follow(session, 6.0, ImuSamples(good.stamp_ns, gyro, good.accel))
    assert motion.left_out == "gyro_contradicts_images" and motion.state is None
    expected = se3.exp(np.full(6, 0.1))
    np.testing.assert_array_equal(motion.predict(round(6.05e9), expected), expected)


@pytest.mark.parametrize("wrong", ["axes", "scale"])
def test_an_accelerometer_that_contradicts_the_images_is_left_out(wrong: str) -> None:
    good = Session().samples()
    accel = good.accel[:, [1, 2, 0]] if wrong == "axes" else 1.2 * good.accel
    motion = follow(Session(), 8.0, ImuSamples(good.stamp_ns, good.gyro, accel))
    assert motion.left_out == "accelerometer_contradicts_images" and motion.bridge(round(7.9e9)) is None


def test_a_bias_that_was_found_in_turns_is_remembered() -> None:
    """After the turns a level drive straight ahead: gravity stays right, though the bias is no longer to be seen."""
    motion = InertialMotion(Imu(left_T_imu=np.eye(4), accel_walk=1e-3))
    rng, bias, heading, position = np.random.default_rng(1), np.array([0.04, 0.0, -0.05]), 0.0, np.zeros(3)
    for k in range(40 * 20):  # y is down
        turning = 0.6 * np.sin(0.5 * k / 20) if k < 20 * 20 else 0.0
        stamps = k * FRAME_NS + np.arange(RATE_NS, FRAME_NS + 1, RATE_NS)
        rate = np.pi / 2  # rad/s, in which it is moved up and down, too
        lifted = np.cos(1e-9 * rate * stamps) if k < 20 * 20 else np.ones(len(stamps))
        position[1] = 0.1 * (1 - lifted[-1])
        accel = np.tile(np.array([0.0, -GRAVITY, 0.0]) + bias, (len(stamps), 1))
        accel[:, 1] += 0.1 * rate**2 * lifted if k < 20 * 20 else 0.0
        gyro = np.tile([0.0, turning, 0.0], (len(stamps), 1))
        noise = rng.normal(0, 1, (len(stamps), 6)) * np.repeat([2e-3, 3e-2], 3)
        motion.feed(ImuSamples(stamps, gyro + noise[:, :3], accel + noise[:, 3:]))
        heading += turning * 0.05
        turned = se3.so3_exp(np.array([0.0, heading, 0.0]) + rng.normal(0, 1e-4, 3))
        motion.accept(round(stamps[-1]), se3.from_rotation_translation(turned, position + rng.normal(0, 5e-4, 3)))
    state = motion.state
    assert state is not None
    np.testing.assert_allclose(state.accel_bias[[0, 2]], bias[[0, 2]], atol=0.01)
    off = np.linalg.norm(state.gravity[[0, 2]]) / GRAVITY
    assert off < np.radians(0.1) and state.tilt_sigma < np.radians(0.1)


def test_gaps_doubles_disorder_and_separate_accelerations() -> None:
    session = Session(seconds=2.0)
    good = session.samples()
    clean = SampleBuffer(session.imu)
    clean.add(good)
    reference = clean.between(300_000_000, 1_700_000_000)
    assert reference is not None and reference.seconds.sum() == pytest.approx(1.4)
    untidy = SampleBuffer(session.imu)
    for k in range(0, len(good), 7):
        part = good.part(slice(max(k - 2, 0), k + 7))  # the last two again
        untidy.add(part)
    found = untidy.between(300_000_000, 1_700_000_000)
    assert found is not None
    np.testing.assert_allclose(found.gyro, reference.gyro)
    gap = SampleBuffer(session.imu)
    gap.add(good.part(slice(0, 100)))
    gap.add(good.part(slice(130, 400)))
    assert gap.between(300_000_000, 1_700_000_000) is None and gap.between(800_000_000, 1_700_000_000) is not None
    apart = SampleBuffer(session.imu)
    gyro, accel = good.gyro.copy(), good.accel.copy()
    gyro[::4], accel[np.arange(len(good)) % 4 != 0] = np.nan, np.nan
    apart.add(ImuSamples(good.stamp_ns, gyro, accel))
    found = apart.between(300_000_000, 1_700_000_000)
    assert found is not None and np.abs(found.accel.mean(0) - reference.accel.mean(0)).max() < 0.02


def bridged(first: int, end: int) -> tuple[I64, F64, Bool]:
    """Stamps and poses of 120 frames, and which of them the IMU gave."""
    session, stamps = Session(), np.arange(120, dtype=np.int64) * FRAME_NS
    truth = np.array([session.pose(s * 1e-9) for s in stamps])
    return stamps, truth, (np.arange(120) >= first) & (np.arange(120) < end)


def test_smoothing_brings_a_bridge_to_both_ends() -> None:
    stamps, truth, inertial = bridged(40, 90)
    drifted = truth.copy()
    t = (stamps[40:90] - stamps[39])[:, None] * 1e-9
    drifted[40:90, :3, 3] += t * [0.004, -0.003, 0.002] + 0.5 * t**2 * [0.02, 0.03, -0.02]
    smooth = smooth_bridges(stamps, drifted, inertial)
    before = np.linalg.norm(drifted[:, :3, 3] - truth[:, :3, 3], axis=1).max()
    after = np.linalg.norm(smooth[:, :3, 3] - truth[:, :3, 3], axis=1).max()
    assert before > 0.1 and after < 0.006
    np.testing.assert_array_equal(smooth[~inertial], truth[~inertial])
    open_end = bridged(100, 120)[2]
    np.testing.assert_array_equal(smooth_bridges(stamps, drifted, open_end), drifted)


def test_smoothing_does_not_believe_the_velocity_of_poses_that_wheels_correct() -> None:
    """Each half second they jump by some centimetres: the map's way stays as near to the truth as the odometry."""
    stamps, truth, inertial = bridged(20, 100)
    jumping = truth.copy()
    since = stamps[20:100] % 500_000_000 * 1e-9
    jumping[20:100, :3, 3] += np.outer(0.2 * since, [1.0, -0.5, 0.0])
    smooth = smooth_bridges(stamps, jumping, inertial)
    off = [np.linalg.norm(poses[:, :3, 3] - truth[:, :3, 3], axis=1).max() for poses in (jumping, smooth)]
    assert off[1] < 1.1 * off[0]


def test_the_imu_is_part_of_a_rig_file(tmp_path: Path) -> None:
    camera = Pinhole(64, 48, 50.0, 50.0, 32.0, 24.0)
    right = se3.from_rotation_translation(np.eye(3), np.array([0.1, 0, 0]))
    imu = replace(Session(offset_s=0.012).imu, gyro_bias=GYRO_BIAS, accel_matrix=np.diag([1.01, 0.99, 1.0]))
    save_rig(Rig(camera, camera, right, imu=imu), tmp_path / "rig.yaml")
    found = load_rig(tmp_path / "rig.yaml").imu
    assert found is not None
    for name in ("left_T_imu", "gyro_matrix", "gyro_bias", "accel_matrix", "accel_bias"):
        np.testing.assert_array_equal(getattr(found, name), getattr(imu, name))
    assert (found.offset_s, found.gyro_noise) == (imu.offset_s, imu.gyro_noise)
    save_rig(Rig(camera, camera, right), tmp_path / "without.yaml")
    assert "imu" not in (tmp_path / "without.yaml").read_text()


def test_a_drone_is_tracked_through_the_dark(data_root: Path) -> None:
    """EuRoC with a second of black images: no new submap, a pose for every frame."""
    with open_source(data_root / "euroc_mh01") as source:
        assert source.rig.imu is not None
        images: list[StereoImage] = []
        for image in source:
            dark = 45 <= image.frame_id < 65
            images.append(replace(image, left=image.left * 0, right=image.left * 0) if dark else image)
            if image.frame_id == 72:
                break
        truth, rig = source.ground_truth, source.rig
    from stereo_sfm.drivers.memory import MemorySource

    config = Config()
    config = replace(config, mapper=replace(config.mapper, enabled=False), loop=replace(config.loop, enabled=False))
    frames = list(run(MemorySource(rig, images, truth), config))
    states = [f.state for f in frames]
    assert states[45:65] == [TrackState.INERTIAL] * 20 and states[65] == TrackState.RECOVERED
    assert set(states[66:]) == {TrackState.OK}
    assert truth is not None
    at = [int(np.argmin(np.abs(truth.stamp_ns - f.stamp_ns))) for f in (frames[44], frames[64], frames[72])]
    start, dark_end, end = truth.poses[at]
    for frame, pose, limit in ((frames[64], dark_end, 0.03), (frames[72], end, 0.01)):
        seen = se3.inverse(frames[44].odom_T_cam) @ frame.odom_T_cam
        assert np.linalg.norm(seen[:3, 3] - (se3.inverse(start) @ pose)[:3, 3]) < limit
    blind = list(run(MemorySource(replace(rig, imu=None), images, truth), config))
    assert TrackState.LOST in {f.state for f in blind}


def test_an_accelerometer_that_stops_is_not_held() -> None:
    session = Session(seconds=4.0)
    good = session.samples()
    accel = good.accel.copy()
    accel[good.stamp_ns > 2_000_000_000] = np.nan
    stopped = SampleBuffer(session.imu)
    for k in range(0, len(good), 10):
        rows = slice(k, k + 10)
        stopped.add(ImuSamples(good.stamp_ns[rows], good.gyro[rows], accel[rows]))
    assert stopped.between(1_000_000_000, 2_400_000_000) is not None
    assert stopped.between(2_000_000_000, 3_500_000_000) is None


def test_a_gyroscope_agrees_with_the_images_of_a_fast_camera() -> None:
    """At 200 Hz the noise of a pose is a tenth of a radian a second, which is not the sensor's."""
    session, rng = Session(seconds=3.0), np.random.default_rng(0)
    samples, motion, at = session.samples(0), InertialMotion(session.imu), 0
    for stamp in range(0, round(session.seconds * 1e9), 5_000_000):
        until = int(np.searchsorted(samples.stamp_ns, stamp, side="right"))
        motion.feed(samples.part(slice(at, until)))
        at = until
        noise = np.concatenate([rng.normal(0, 5e-4, 3), rng.normal(0, 3e-4, 3)])
        motion.accept(stamp, session.pose(stamp * 1e-9) @ se3.exp(noise))
        assert not motion.left_out


def test_an_image_of_a_wrong_stamp_does_not_contradict_the_gyroscope() -> None:
    session, rng = Session(seconds=8.0), np.random.default_rng(0)
    samples, motion, at = session.samples(0), InertialMotion(session.imu), 0
    for k in range(int(session.seconds * 1e9) // FRAME_NS):
        true = k * FRAME_NS
        stamp = true + (FRAME_NS - 1_000_000) * (k == 80)  # a millisecond before the next
        until = int(np.searchsorted(samples.stamp_ns, stamp, side="right"))
        motion.feed(samples.part(slice(at, until)))
        at = until
        noise = np.concatenate([rng.normal(0, 5e-4, 3), rng.normal(0, 1.5e-4, 3)])
        motion.accept(stamp, session.pose(true * 1e-9) @ se3.exp(noise), timed=k != 81)
        assert not motion.left_out
    assert motion.use == SensorUse.USED
