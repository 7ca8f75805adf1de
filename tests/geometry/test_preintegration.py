from __future__ import annotations

import dataclasses

import gtsam
import numpy as np
import pytest

from stereo_sfm.geometry import se3
from stereo_sfm.geometry.preintegration import GRAVITY, Preintegrated, preintegrate
from stereo_sfm.types import F64

DT = 0.005
GYRO_NOISE, ACCEL_NOISE = 1.7e-4, 2.0e-3


def samples(seed: int, n: int = 40, dt: float = DT) -> tuple[F64, F64, F64]:
    """Smooth random rates, strong enough that second-order errors would show."""
    rng = np.random.default_rng(seed)
    t = np.arange(n)[:, None] * dt
    phase = rng.uniform(0, 6, (2, 3))
    gyro = 1.5 * np.sin(3 * t + phase[0])
    accel = 4 * np.cos(2 * t + phase[1]) + [0.3, -0.2, GRAVITY]
    return np.full(n, dt), gyro, accel


def ours(seed: int, gyro_bias: F64, accel_bias: F64) -> Preintegrated:
    return preintegrate(*samples(seed), gyro_bias, accel_bias, GYRO_NOISE, ACCEL_NOISE)


@pytest.mark.parametrize("seed", range(4))
def test_values_are_gtsams(seed: int) -> None:
    gyro_bias, accel_bias = np.array([0.01, -0.02, 0.03]), np.array([0.1, -0.05, 0.02])
    params = gtsam.PreintegrationParams.MakeSharedU(GRAVITY)
    params.setGyroscopeCovariance(np.eye(3) * GYRO_NOISE**2)
    params.setAccelerometerCovariance(np.eye(3) * ACCEL_NOISE**2)
    params.setIntegrationCovariance(np.zeros((3, 3)))
    theirs = gtsam.PreintegratedImuMeasurements(params, gtsam.imuBias.ConstantBias(accel_bias, gyro_bias))
    seconds, gyro, accel = samples(seed, 2000, 1e-4)  # so fine that its tangent integration is exact as well
    for dt, w, a in zip(seconds, gyro, accel, strict=True):
        middle = se3.so3_exp(0.5 * dt * (w - gyro_bias))  # theirs acts in the axes at the beginning of an interval
        theirs.integrateMeasurement(middle @ (a - accel_bias) + accel_bias, w, dt)
    mine = preintegrate(seconds, gyro, accel, gyro_bias, accel_bias, GYRO_NOISE, ACCEL_NOISE)
    assert np.allclose(mine.rotation, theirs.deltaRij().matrix(), atol=1e-6)
    assert np.allclose(mine.velocity, theirs.deltaVij(), atol=1e-6)
    assert np.allclose(mine.position, theirs.deltaPij(), atol=1e-6)
    assert mine.seconds == pytest.approx(theirs.deltaTij())


def test_a_turning_sensor_at_one_position_does_not_drift() -> None:
    """At the rate of a real sensor, which measures gravity alone in rotating axes."""
    rate, n = np.array([0.4, -1.0, 0.3]), 400
    middles = se3.so3_exp((np.arange(n) + 0.5)[:, None] * DT * rate)
    force = np.einsum("nji,j->ni", middles, [0.0, 0.0, GRAVITY])
    zero = np.zeros(3)
    motion = preintegrate(np.full(n, DT), np.tile(rate, (n, 1)), force, zero, zero, GYRO_NOISE, ACCEL_NOISE)
    t = n * DT
    np.testing.assert_allclose(motion.velocity, [0, 0, GRAVITY * t], atol=1e-9)
    np.testing.assert_allclose(motion.position, [0, 0, 0.5 * GRAVITY * t * t], atol=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_bias_jacobians_are_the_differences(seed: int) -> None:
    zero, step = np.zeros(3), 1e-6
    base = ours(seed, zero, zero)
    for axis in range(3):
        bias = np.eye(3)[axis] * step
        by_gyro, by_accel = ours(seed, bias, zero), ours(seed, zero, bias)
        turned = se3.so3_log(base.rotation.T @ by_gyro.rotation) / step
        assert np.allclose(turned, base.rotation_by_gyro[:, axis], atol=1e-6)
        assert np.allclose((by_gyro.velocity - base.velocity) / step, base.velocity_by_gyro[:, axis], atol=1e-5)
        assert np.allclose((by_gyro.position - base.position) / step, base.position_by_gyro[:, axis], atol=1e-5)
        assert np.allclose((by_accel.velocity - base.velocity) / step, base.velocity_by_accel[:, axis], atol=1e-6)
        assert np.allclose((by_accel.position - base.position) / step, base.position_by_accel[:, axis], atol=1e-6)


@pytest.mark.parametrize("biased", [False, True])
def test_two_motions_make_one(biased: bool) -> None:
    """As integrated at once, derivatives and covariance too; biases of the second are corrected to first order."""
    gyro_bias, accel_bias = np.array([0.01, -0.02, 0.03]), np.array([0.1, -0.05, 0.02])
    other = (gyro_bias + 1e-4, accel_bias - 1e-3) if biased else (gyro_bias, accel_bias)
    seconds, gyro, accel = samples(2)
    parts = [(slice(0, 15), gyro_bias, accel_bias), (slice(15, None), *other)]
    first, second = (preintegrate(seconds[k], gyro[k], accel[k], g, a, GYRO_NOISE, ACCEL_NOISE) for k, g, a in parts)
    joined, whole = first.then(second), ours(2, gyro_bias, accel_bias)
    for field in dataclasses.fields(Preintegrated):
        found, true = np.asarray(getattr(joined, field.name)), np.asarray(getattr(whole, field.name))
        np.testing.assert_allclose(found, true, atol=(1e-3 if biased else 1e-9) * max(float(np.abs(true).max()), 1e-9))
    assert np.abs(joined.position - whole.position).max() < 1e-8


def test_covariance_is_that_of_many_noisy_integrations() -> None:
    seconds, gyro, accel = samples(0)
    clean = preintegrate(seconds, gyro, accel, np.zeros(3), np.zeros(3), GYRO_NOISE, ACCEL_NOISE)
    rng = np.random.default_rng(1)
    errors: list[F64] = []
    for _ in range(1500):
        noisy = preintegrate(
            seconds, gyro + rng.normal(0, GYRO_NOISE / DT**0.5, gyro.shape),
            accel + rng.normal(0, ACCEL_NOISE / DT**0.5, accel.shape), np.zeros(3), np.zeros(3), 0.0, 0.0,
        )  # fmt: skip
        turned = se3.so3_log(clean.rotation.T @ noisy.rotation)
        errors.append(np.concatenate([turned, noisy.velocity - clean.velocity, noisy.position - clean.position]))
    found = np.sqrt(np.diag(np.cov(np.array(errors).T)))
    assert np.allclose(found, np.sqrt(np.diag(clean.covariance)), rtol=0.1)


@pytest.mark.parametrize("pieces", [(0.02,), (0.02 - 1e-7, 1e-7), tuple(np.full(40, 0.0005))])
def test_the_covariance_does_not_depend_on_how_an_interval_is_cut(pieces: tuple[float, ...]) -> None:
    """Of one interval it is not singular: velocity and position are not wrong by the same noise."""
    n, zero = len(pieces), np.zeros(3)
    motion = preintegrate(np.array(pieces), np.zeros((n, 3)), np.zeros((n, 3)), zero, zero, GYRO_NOISE, ACCEL_NOISE)
    t, both = 0.02, motion.covariance[[[3, 3], [6, 6]], [[3, 6], [3, 6]]]
    assert np.allclose(both, ACCEL_NOISE**2 * np.array([[t, t**2 / 2], [t**2 / 2, t**3 / 3]]), rtol=1e-6, atol=0)
    assert np.linalg.cholesky(motion.covariance)[6, 6] > 0.2 * np.sqrt(both[1, 1])
