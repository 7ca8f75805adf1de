"""Integration of velocities against closed forms and differences."""

from __future__ import annotations

import numpy as np

from stereo_sfm.geometry import se3
from stereo_sfm.geometry.twist_integration import integrate_twists


def test_an_arc() -> None:
    n, radius = 2000, 1.5
    angular, linear = np.tile([0, 0, 0.4], (n, 1)), np.tile([0.4 * radius, 0, 0], (n, 1))
    motion = integrate_twists(np.full(n, 1e-3), angular, linear, 0.0, 0.0)
    turned = 0.8
    np.testing.assert_allclose(motion.position, [radius * np.sin(turned), radius * (1 - np.cos(turned)), 0], atol=1e-7)
    np.testing.assert_allclose(motion.rotation, se3.so3_exp(np.array([0, 0, turned])), atol=1e-12)
    assert np.isclose(motion.way, radius * turned) and np.isclose(motion.seconds, 2.0)


def test_derivatives_by_a_constant_error_of_the_rate() -> None:
    rng = np.random.default_rng(1)
    seconds, angular, linear = np.full(60, 0.02), rng.normal(0, 1, (60, 3)), rng.normal(0, 1, (60, 3))
    motion = integrate_twists(seconds, angular, linear, 0.0, 0.0)
    h = 1e-6
    for k in range(3):
        ends = [integrate_twists(seconds, angular + s * h * np.eye(3)[k], linear, 0.0, 0.0) for s in (-1, 1)]
        moved = (ends[1].position - ends[0].position) / (2 * h)
        turned = se3.so3_log(ends[0].rotation.T @ ends[1].rotation) / (2 * h)
        np.testing.assert_allclose(motion.position_by_rate[:, k], moved, atol=1e-6)
        np.testing.assert_allclose(motion.rotation_by_rate[:, k], turned, atol=1e-6)


def test_the_covariance_is_that_of_many_noisy_integrations() -> None:
    rng = np.random.default_rng(2)
    n, dt, turn_noise, noise = 100, 0.02, 0.03, 0.02
    angular, linear = np.tile([0, 0, 0.5], (n, 1)), np.tile([1.0, 0, 0], (n, 1))
    motion = integrate_twists(np.full(n, dt), angular, linear, turn_noise, noise)
    off = np.zeros((1500, 6))
    for row in off:
        noisy = [v + rng.normal(0, s / dt**0.5, v.shape) for v, s in ((angular, turn_noise), (linear, noise))]
        got = integrate_twists(np.full(n, dt), noisy[0], noisy[1], 0.0, 0.0)
        row[:3] = got.position - motion.position
        row[3:] = se3.so3_log(motion.rotation.T @ got.rotation)
    np.testing.assert_allclose(np.std(off, axis=0), np.sqrt(np.diag(motion.covariance)), rtol=0.08)
