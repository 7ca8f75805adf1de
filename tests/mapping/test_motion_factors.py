"""IMU, wheels and odometry between keyframes: GTSAM's factors, joined by the map, a gain for bundle adjustment."""

from __future__ import annotations

import dataclasses
import pickle
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import gtsam
import numpy as np
import pytest

from stereo_sfm.calib.imu import Imu
from stereo_sfm.config import MapperConfig
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.preintegration import GRAVITY
from stereo_sfm.mapping import motion_factors as mf
from stereo_sfm.mapping import window
from stereo_sfm.mapping.bundle import BundleConfig, bundle_adjust, counted_information
from stereo_sfm.mapping.map import Map
from stereo_sfm.mapping.mapper import Mapper
from stereo_sfm.mapping.motion_factors import InertialFactors, MotionFactors, PoseFactors, motion_factors
from stereo_sfm.mapping.motions import Motion
from stereo_sfm.types import F64, InertialLink, Keyframe, MotionLink
from tests.mapping.test_bundle import bundle_of
from tests.synthetic import KeyframeStream, keyframe_stream, make_scene, pinhole_rig

DT = 1e-3
WORLD_GRAVITY = np.array([0.0, 0.0, -GRAVITY])
GYRO_BIAS, ACCEL_BIAS = np.array([0.002, -0.003, 0.001]), np.array([0.03, -0.02, 0.01])
IMU = Imu(
    left_T_imu=se3.exp(np.array([0.05, -0.02, 0.03, 0.4, -1.2, 0.7])),
    gyro_noise=1e-4, accel_noise=1e-3, gyro_walk=1e-5, accel_walk=1e-4,
)  # fmt: skip


def imu_pose(seconds: F64 | float) -> F64:
    """(..., 4, 4) of a sensor that drives, sways and turns."""
    t = np.asarray(seconds, float)
    phi = np.stack([0.1 * np.sin(1.3 * t), 0.2 * np.sin(0.9 * t + 1), 0.5 * t], -1)
    position = np.stack([np.sin(0.5 * t) * 2, 1.5 * np.cos(0.7 * t), 0.1 * np.sin(2 * t)], -1)
    return se3.from_rotation_translation(np.asarray(se3.so3_exp(phi)), position)


def velocity(seconds: float) -> F64:
    return (imu_pose(seconds + 1e-5)[:3, 3] - imu_pose(seconds - 1e-5)[:3, 3]) / 2e-5


def samples(begin_s: float, end_s: float) -> tuple[F64, F64, F64]:
    """Edges in seconds, and what the sensor measures between them."""
    edges = np.linspace(begin_s, end_s, round((end_s - begin_s) / DT) + 1)
    poses, dt = imu_pose(edges), edges[1] - edges[0]
    gyro = np.asarray(se3.so3_log(poses[:-1, :3, :3].mT @ poses[1:, :3, :3])) / dt
    middle = 0.5 * (edges[:-1] + edges[1:])
    positions = [imu_pose(middle + k * 1e-4)[:, :3, 3] for k in (-1, 0, 1)]
    force = (positions[0] - 2 * positions[1] + positions[2]) / 1e-8 - WORLD_GRAVITY
    accel = np.einsum("nji,nj->ni", imu_pose(middle)[:, :3, :3], force)
    return edges, gyro + GYRO_BIAS, accel + ACCEL_BIAS


def link(begin_s: float, end_s: float, noise: np.random.Generator | None = None, sigma: float = 1.0) -> InertialLink:
    """As a tracker gives it, with what it knows at the end, `sigma` times as exact as a millimetre a second."""
    edges, gyro, accel = samples(begin_s, end_s)
    if noise is not None:
        gyro = gyro + noise.normal(0, IMU.gyro_noise / DT**0.5, gyro.shape)
        accel = accel + noise.normal(0, IMU.accel_noise / DT**0.5, accel.shape)
    turn = imu_pose(end_s)[:3, :3].T
    state = np.concatenate([turn @ velocity(end_s), turn @ WORLD_GRAVITY, ACCEL_BIAS, GYRO_BIAS])
    covariance = np.diag(np.repeat([1e-3, 1e-3, 1e-2, 1e-4], 3) ** 2) * sigma**2
    return InertialLink(np.round(edges * 1e9).astype(np.int64), gyro, accel, state, covariance)


def keyframe(k: int, stamp_s: float, inertial: InertialLink | None, wheels: MotionLink | None = None) -> Keyframe:
    none = np.zeros((0, 2))
    pose = imu_pose(stamp_s) @ se3.inverse(IMU.left_T_imu)
    return Keyframe(
        k, k, round(stamp_s * 1e9), pose, np.zeros(0, np.int64), none, none, np.zeros((0, 3)),
        np.zeros((0, 32), np.uint8), inertial=inertial, wheels=wheels,
    )  # fmt: skip


def factors(times: list[float], noise: np.random.Generator | None = None) -> MotionFactors:
    """Of keyframes in the bundle at these times."""
    motions = [Motion.of(keyframe(1, b, link(a, b, noise)), IMU) for a, b in pairwise(times)]
    begin, count = link(times[0] - 0.1, times[0]), len(times)
    links = np.stack([np.arange(count - 1), np.arange(1, count)], 1)
    states = np.zeros((count, 9))
    inertial = [m.inertial for m in motions if m is not None and m.inertial is not None]
    known: list[tuple[F64, F64] | None] = [(begin.state, begin.covariance)]
    return MotionFactors(
        np.arange(count), poses(times), InertialFactors(IMU, links, inertial, np.array([0]), known, states), None
    )


def poses(times: list[float]) -> F64:
    return np.stack([imu_pose(t) @ se3.inverse(IMU.left_T_imu) for t in times])


def gtsams(times: list[float], at: F64) -> tuple[F64, F64]:
    """Normal equations of the same motions over the steps (translation, rotation) of all poses but the first, at camera
    poses (K, 4, 4), velocities and biases eliminated."""
    x, v, b = (lambda k, c=c: gtsam.symbol(c, k) for c in "xvb")
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    params = gtsam.PreintegrationParams.MakeSharedU(GRAVITY)
    params.setGyroscopeCovariance(np.eye(3) * IMU.gyro_noise**2)
    params.setAccelerometerCovariance(np.eye(3) * IMU.accel_noise**2)
    params.setIntegrationCovariance(np.zeros((3, 3)))
    bias = gtsam.imuBias.ConstantBias(ACCEL_BIAS, GYRO_BIAS)
    noise: Callable[[F64], Any] = gtsam.noiseModel.Diagonal.Sigmas
    for k, pose in enumerate(at):
        values.insert(x(k), gtsam.Pose3(pose @ IMU.left_T_imu))
        values.insert(v(k), velocity(times[k]))
        values.insert(b(k), bias)
    graph.add(gtsam.PriorFactorVector(v(0), velocity(times[0]), noise(np.full(3, 1e-3))))
    graph.add(gtsam.PriorFactorConstantBias(b(0), bias, noise(np.repeat([1e-2, 1e-4], 3))))
    for k in range(len(times) - 1):
        measured = gtsam.PreintegratedImuMeasurements(params, bias)
        edges, gyro, accel = samples(times[k], times[k + 1])
        for dt, w, a in zip(np.diff(edges), gyro, accel, strict=True):
            middle = np.asarray(se3.so3_exp(0.5 * dt * (w - GYRO_BIAS)))  # as in tests/geometry/test_preintegration.py
            measured.integrateMeasurement(middle @ (a - ACCEL_BIAS) + ACCEL_BIAS, w, dt)
        graph.add(gtsam.ImuFactor(x(k), v(k), x(k + 1), v(k + 1), b(k), measured))
        walk = np.repeat([IMU.accel_walk, IMU.gyro_walk], 3) * np.sqrt(times[k + 1] - times[k])
        graph.add(gtsam.BetweenFactorConstantBias(b(k), b(k + 1), gtsam.imuBias.ConstantBias(), noise(walk)))
    count, ordering = len(times), gtsam.Ordering()
    for key in [x(k) for k in range(1, count)] + [x(0)] + [f(k) for k in range(count) for f in (v, b)]:
        ordering.push_back(key)
    h, g = graph.linearize(values).hessian(ordering)
    n = 6 * (count - 1)
    rest = np.arange(n + 6, len(g))
    left = h[:n, :n] - h[:n, rest] @ np.linalg.solve(h[np.ix_(rest, rest)], h[rest, :n])
    pull = g[:n] - h[:n, rest] @ np.linalg.solve(h[np.ix_(rest, rest)], g[rest])
    by_camera = se3.adjoint(se3.inverse(IMU.left_T_imu))[[3, 4, 5, 0, 1, 2]]
    into = np.kron(np.eye(count - 1), by_camera)
    return into.T @ left @ into, into.T @ pull


def test_the_model_of_the_poses_is_gtsams(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mf, "TURN_SHARE", 0.0)
    times = [1.0, 1.4, 1.7, 2.3]
    rng = np.random.default_rng(0)
    at = poses(times) @ se3.exp(rng.normal(0, 1, (4, 6)) * np.repeat([2e-4, 2e-5], 3))
    known = link(0.9, 1.0)
    sure = known.covariance.copy()
    sure[3:6, 3:6] = 1e-14 * np.eye(3)  # GTSAM has no unknown gravity
    mine = factors(times)
    assert mine.inertial is not None
    first = imu_pose(1.0)[:3, :3].T @ (at[0] @ IMU.left_T_imu)[:3, :3]  # the first pose has an error
    state = known.state.copy()
    state[:3], state[3:6] = first.T @ state[:3], first.T @ state[3:6]
    mine = dataclasses.replace(mine, inertial=dataclasses.replace(mine.inertial, known=[(state, sure)]))
    model = mine.linearized(at[:, :3, :3].copy(), at[:, :3, 3].copy(), np.array([-1, 0, 1, 2]), False)
    h, g = gtsams(times, at)
    scale = np.sqrt(np.diag(h))
    np.testing.assert_allclose(model.h / np.outer(scale, scale), h / np.outer(scale, scale), atol=2e-3)
    np.testing.assert_allclose(-model.g / scale, g / scale, atol=2e-3 * float(np.abs(g / scale).max()))


def test_states_are_those_of_the_true_motion() -> None:
    times = [1.0, 1.3, 1.6, 2.0]
    mine, at = factors(times), poses(times)
    model = mine.linearized(at[:, :3, :3].copy(), at[:, :3, 3].copy(), np.array([-1, 0, 1, 2]), True)
    assert model.states is not None
    states = model.states.after(np.zeros(18))
    true = np.stack([imu_pose(t)[:3, :3].T @ velocity(t) for t in times])
    np.testing.assert_allclose(states[:, :3], true, atol=1e-4)
    np.testing.assert_allclose(states[:, 3:], np.tile(np.r_[ACCEL_BIAS, GYRO_BIAS], (4, 1)), atol=1e-4)
    assert model.cost < 0.01
    assert np.abs(model.g / np.sqrt(np.diag(model.h))).max() < 0.05


@pytest.mark.parametrize("kind", ["imu", "wheels"])
def test_gradient_and_cost_are_those_at_other_poses(kind: str) -> None:
    times, rng = [1.0, 1.5, 2.0], np.random.default_rng(3)
    mine, at = factors(times, rng), poses(times)
    if kind == "wheels":
        moved = se3.inverse(at[:-1]) @ at[1:] @ se3.exp(rng.normal(0, 1e-3, (2, 6)))
        wheels = [MotionLink(m, np.diag(np.repeat([1e-2, 2e-3], 3) ** 2)) for m in moved]
        mine = dataclasses.replace(mine, inertial=None, poses=PoseFactors(np.array([[0, 1], [1, 2]]), wheels))
    free, step = np.array([-1, 0, 1]), rng.normal(0, 1, (2, 6)) * np.repeat([1e-4, 1e-5], 3)
    there = at.copy()
    there[1:] = at[1:] @ se3.exp(step)
    model = mine.linearized(at[:, :3, :3].copy(), at[:, :3, 3].copy(), free, False)
    anew = mine.linearized(there[:, :3, :3].copy(), there[:, :3, 3].copy(), free, False)
    pull, cost = model.evaluate(there[1:, :3, :3], there[1:, :3, 3])
    assert cost == pytest.approx(anew.cost, rel=0.01)
    np.testing.assert_allclose(pull, anew.g, atol=0.01 * float(np.abs(anew.g).max()))


def test_a_motion_that_the_poses_contradict_counts_less() -> None:
    """Wheels that slipped by ten sigmas pull no more than if they had slipped by a little more than four."""
    at = poses([1.0, 1.5])
    true = se3.inverse(at[0]) @ at[1]

    def pull(slip_m: float) -> float:
        moved = true @ se3.exp(np.array([slip_m, 0, 0, 0, 0, 0]))
        wheels = PoseFactors(np.array([[0, 1]]), [MotionLink(moved, np.diag(np.repeat([1e-2, 1e-2], 3) ** 2))])
        factors = MotionFactors(np.arange(2), at, None, wheels)
        model = factors.linearized(at[:, :3, :3], at[:, :3, 3], np.array([-1, 0]), True)
        return float(np.linalg.norm(model.g))

    assert pull(0.1) < pull(0.03) < pull(0.04)
    assert pull(0.02) == pytest.approx(2 * pull(0.01))


@pytest.mark.parametrize("joint", [False, True])
def test_the_counted_information_is_that_of_many_estimates(joint: bool) -> None:
    """The mean of 200 pixels, or pairs of them, by iteratively reweighted least squares, two thousand times."""
    rng, s, c, dimensions = np.random.default_rng(2), 0.3, 0.2, 4 if joint else 2
    r = rng.normal(0, s, (2000, 200, dimensions))
    estimate, w = np.zeros((2000, 1, dimensions)), np.ones((2000, 200, 1))
    for _ in range(30):
        w = c**2 / (c**2 + ((r - estimate) ** 2).sum(axis=2, keepdims=True))
        estimate = (w * r).sum(axis=1, keepdims=True) / w.sum(axis=1, keepdims=True)
    counted, true = float(w.sum(axis=1).mean()), 1.0 / float(estimate.var())
    assert counted_information(2 * np.log(2) * s**2, c, joint) == pytest.approx(counted / true, rel=0.1)
    assert counted_information(2 * np.log(2) * s**2, 0.0, joint) == pytest.approx(s**2)
    assert counted_information(2 * np.log(2) * s**2, 1e3, joint) == pytest.approx(s**2)


def test_bundle_adjustment_gains_by_the_imu() -> None:
    """Few points and much noise, poses of a drive: the error of the positions is halved, the turns are exact."""
    rig, times = pinhole_rig(), [float(t) for t in np.arange(1.0, 4.0, 0.3)]
    at, rng = poses(times), np.random.default_rng(5)
    scene = make_scene(rig, points=60, noise_px=1.0, seed=4, poses=at)
    start = dataclasses.replace(bundle_of(scene), fixed=np.arange(len(at)) == 0)
    fused = dataclasses.replace(start, motions=factors(times, rng))
    without, held = (bundle_adjust(rig, b, BundleConfig(iterations=30)) for b in (start, fused))

    def errors(found: F64) -> tuple[float, float]:
        off = np.asarray(se3.log(se3.inverse(at) @ found))
        return float(np.linalg.norm(off[:, :3], axis=1).mean()), float(np.linalg.norm(off[:, 3:], axis=1).mean())

    assert errors(held.world_T_kf)[0] < 0.5 * errors(without.world_T_kf)[0]
    assert errors(held.world_T_kf)[1] < 0.3 * errors(without.world_T_kf)[1]
    assert held.states is not None and without.states is None
    true = np.stack([imu_pose(t)[:3, :3].T @ velocity(t) for t in times])
    assert np.abs(held.states[:, :3] - true).max() < 0.02


def chain(times: list[float], wheels: bool = True) -> Map:
    """Keyframes without points in a map."""
    out = Map()
    for k, t in enumerate(times):
        pose = imu_pose(t) @ se3.inverse(IMU.left_T_imu)
        turned = None
        if k and wheels:
            before = imu_pose(times[k - 1]) @ se3.inverse(IMU.left_T_imu)
            turned = MotionLink(se3.inverse(before) @ pose, 1e-4 * np.eye(6))
        frame = keyframe(k, t, link(times[max(k - 1, 0)] - (0.1 if k == 0 else 0.0), t), turned)
        out.add_keyframe(frame, pose, Motion.of(frame, IMU))
    return out


def test_motions_of_a_culled_keyframe_are_joined() -> None:
    times = [1.0, 1.3, 1.7, 2.0]
    map_ = chain(times)
    assert sorted(map_.motions) == [1, 2, 3]  # nothing is before the first
    before = len(pickle.dumps(map_.motions))
    map_.cull_keyframe(1)
    assert before - len(pickle.dumps(map_.motions)) > 8 * (9 * 9 + 5 * 9 + 4 * 4 + 6 * 6)  # one motion of two sensors
    whole = Motion.of(keyframe(2, 1.7, link(1.0, 1.7)), IMU)
    joined = map_.motions[2]
    assert sorted(map_.motions) == [2, 3] and 1 not in map_.known_states
    assert whole is not None and whole.inertial is not None and joined.inertial is not None
    np.testing.assert_allclose(joined.inertial.position, whole.inertial.position, atol=1e-9)
    np.testing.assert_allclose(joined.inertial.covariance, whole.inertial.covariance, rtol=1e-6, atol=1e-16)
    assert joined.wheels is not None
    np.testing.assert_allclose(joined.wheels.last_T_cam, se3.inverse(poses([1.0])[0]) @ poses([1.7])[0], atol=1e-12)
    np.testing.assert_allclose(joined.wheels.covariance[3:, 3:], 2e-4 * np.eye(3), atol=1e-12)


def test_a_window_gets_the_motions_to_its_neighbours() -> None:
    map_ = chain([1.0, 1.3, 1.7, 2.0, 2.2])
    rows = np.array([2, 3])
    found = motion_factors(map_, rows, np.array([False, False]), IMU)
    assert found is not None and found.inertial is not None and found.poses is not None
    assert found.rows.tolist() == [-1, 0, 1, -1]  # the keyframes before and after are outside
    assert found.inertial.links.tolist() == [[0, 1], [1, 2], [2, 3]]
    assert found.inertial.first.tolist() == [0]
    alone = motion_factors(map_, rows, np.array([False, False]), None)
    assert alone is not None and alone.inertial is None and alone.poses is not None
    assert motion_factors(map_, rows, np.array([True, True]), IMU) is None
    assert motion_factors(Map(), np.zeros(0, np.int64), np.zeros(0, bool), IMU) is None
    map_.known_states.clear()
    unknown = motion_factors(map_, rows, np.array([False, False]), IMU)
    assert unknown is not None and unknown.inertial is None  # gravity is not known


def drive(noise_px: float, seed: int) -> KeyframeStream:
    """A stream of keyframes with an IMU."""
    times = [float(t) for t in 1.0 + 0.25 * np.arange(24)]
    stream = keyframe_stream(
        dataclasses.replace(pinhole_rig(), imu=IMU), poses(times), noise_px=noise_px, per_keyframe=40, seed=seed
    )
    rng = np.random.default_rng(seed)
    keyframes = [
        dataclasses.replace(k, inertial=link(times[i - 1] if i else t - 0.1, t, rng), stamp_ns=round(t * 1e9))
        for i, (k, t) in enumerate(zip(stream.keyframes, times, strict=True))
    ]
    return dataclasses.replace(stream, keyframes=keyframes)


def test_the_mapper_uses_what_the_keyframes_bring() -> None:
    """A map of few, noisy points: the turns between its keyframes are as exact as the gyroscope."""

    def turn_error(sensors: bool) -> float:
        stream = drive(1.0, 1)
        config = MapperConfig(sensors=sensors, final_iterations=0, full_ba_growth=1e3)
        mapper = Mapper(config, stream.rig)
        for k in stream.keyframes:
            mapper.step(k)
        rows = mapper.map.living_keyframes()
        found, true = mapper.map.keyframes.map_T_kf[rows], stream.world_T_kf[mapper.map.keyframes.kf_id[rows]]
        turns = [se3.inverse(x[:-1]) @ x[1:] for x in (found, true)]
        assert sensors == bool(mapper.map.motions)
        for part in (
            window.covisible_window(mapper.map, int(rows[-1]), config, IMU),
            window.newest(mapper.map, int(rows[4]), 8, config, IMU),
        ):
            assert sensors == (part.bundle.motions is not None)
        if sensors:
            speed = mapper.map.keyframes.state[rows[-1], :3]
            at = float(mapper.map.keyframes.stamp_ns[rows[-1]]) * 1e-9
            np.testing.assert_allclose(speed, imu_pose(at)[:3, :3].T @ velocity(at), atol=0.02)
        off = np.asarray(se3.so3_log(turns[0][:, :3, :3].mT @ turns[1][:, :3, :3]))
        return float(np.degrees(np.linalg.norm(off, axis=1)).mean())

    assert turn_error(True) < 0.5 * turn_error(False)


def test_odometry_holds_a_keyframe_that_shares_few_points_with_the_map() -> None:
    """After a view was covered: the tracker knows the way, of the points of before the map has twelve, with noise."""
    stamps = [1.0 + 0.25 * k for k in range(8)]
    sigmas = np.repeat([0.003, 0.002], 3)

    def error(seed: int, odometry: bool) -> float:
        rng = np.random.default_rng(seed)
        stream = keyframe_stream(pinhole_rig(), poses(stamps), noise_px=1.0, per_keyframe=120, seed=seed)
        mapper = Mapper(MapperConfig(final_iterations=0, full_ba_growth=1e3), stream.rig)
        odom_T_cam = stream.world_T_kf[0]
        for k, frame in enumerate(stream.keyframes):
            ids = np.asarray(frame.point_ids).copy()
            if k >= 4:
                known = np.flatnonzero(np.isin(ids, stream.keyframes[3].point_ids))
                ids[np.setdiff1d(np.arange(len(ids)), known[:12])] += 1_000_000
            moved = None
            if k:
                moved = se3.inverse(stream.world_T_kf[k - 1]) @ stream.world_T_kf[k] @ se3.exp(rng.normal(0, sigmas))
                odom_T_cam = odom_T_cam @ moved
            link = None if moved is None or not odometry else MotionLink(moved, np.diag(sigmas**2))
            mapper.step(dataclasses.replace(frame, point_ids=ids, odom_T_cam=odom_T_cam, odometry=link))
        assert bool(mapper.map.motions) == odometry
        row = {int(mapper.map.keyframes.kf_id[row]): row for row in mapper.map.living_keyframes()}
        found = mapper.map.keyframes.map_T_kf[[row[3], row[4]]]
        true = se3.inverse(stream.world_T_kf[3]) @ stream.world_T_kf[4]
        return float(se3.extent(se3.inverse(true) @ se3.inverse(found[0]) @ found[1])[0])

    errors = np.array([[error(seed, odometry) for odometry in (True, False)] for seed in range(5)])
    assert errors[:, 0].mean() < 0.4 * errors[:, 1].mean()
    assert errors[:, 0].max() < 0.012


def test_a_map_that_shares_many_points_needs_no_odometry() -> None:
    stream = keyframe_stream(pinhole_rig(), poses([1.0 + 0.25 * k for k in range(6)]), noise_px=0.4, per_keyframe=120)
    mapper = Mapper(MapperConfig(final_iterations=0, full_ba_growth=1e3), stream.rig)
    for frame in stream.keyframes:
        mapper.step(dataclasses.replace(frame, odometry=MotionLink(np.eye(4), 1e-6 * np.eye(6))))
    assert not mapper.map.motions
