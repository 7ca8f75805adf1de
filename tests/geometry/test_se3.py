"""Rigid transforms: group axioms, exponential and logarithm, quaternions, alignment."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from stereo_sfm.geometry import se3

tangent = st.tuples(*[st.floats(-5, 5)] * 3, *[st.floats(-1.8, 1.8)] * 3).map(np.array)
tiny = st.tuples(*[st.floats(-1e-7, 1e-7)] * 6).map(np.array)


def hat(xi: np.ndarray) -> np.ndarray:
    out = np.zeros((4, 4))
    out[:3, :3], out[:3, 3] = se3.skew(xi[3:]), xi[:3]
    return out


@settings(max_examples=100, deadline=None)
@given(st.one_of(tangent, tiny))
def test_exp_is_the_matrix_exponential_and_log_inverts_it(xi: np.ndarray) -> None:
    np.testing.assert_allclose(se3.exp(xi), expm(hat(xi)), atol=1e-12)
    np.testing.assert_allclose(se3.log(se3.exp(xi)), xi, atol=1e-9)


@settings(max_examples=60, deadline=None)
@given(tangent, tangent, tangent)
def test_group_axioms(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> None:
    ta, tb, tc = se3.exp(a), se3.exp(b), se3.exp(c)
    np.testing.assert_allclose((ta @ tb) @ tc, ta @ (tb @ tc), atol=1e-12)
    np.testing.assert_allclose(ta @ se3.inverse(ta), np.eye(4), atol=1e-12)
    np.testing.assert_allclose(se3.inverse(ta @ tb), se3.inverse(tb) @ se3.inverse(ta), atol=1e-12)
    conjugate = ta @ se3.exp(b) @ se3.inverse(ta)  # exp(Ad b) = T exp(b) T^-1
    np.testing.assert_allclose(se3.exp(se3.adjoint(ta) @ b), conjugate, atol=1e-10)
    np.testing.assert_allclose(
        se3.transform(ta, np.stack([c[:3], b[:3]])), [(ta @ [*p[:3], 1.0])[:3] for p in (c, b)], atol=1e-12
    )


@settings(max_examples=100, deadline=None)
@given(st.tuples(*[st.floats(-1, 1)] * 4).map(np.array).filter(lambda q: np.linalg.norm(q) > 1e-3))
def test_quaternions_agree_with_scipy(q: np.ndarray) -> None:
    rotation = Rotation.from_quat(q).as_matrix()
    np.testing.assert_allclose(se3.rotation_from_quaternion(q), rotation, atol=1e-12)
    back = se3.quaternion_from_rotation(rotation)
    assert back[3] >= 0
    np.testing.assert_allclose(se3.rotation_from_quaternion(back), rotation, atol=1e-12)


def test_quaternions_are_the_same_one_by_one() -> None:
    rotations = se3.so3_exp(np.random.default_rng(0).normal(size=(500, 3)) * 2.0)
    single = np.array([se3.quaternion_from_rotation(r) for r in rotations])
    np.testing.assert_array_equal(single, se3.quaternion_from_rotation(rotations))


@pytest.mark.parametrize("size", [1e-200, 1.0, 1e200, 1e300])
def test_quaternions_of_any_size(size: float) -> None:
    q = np.array([0.1, -0.2, 0.3, 0.9])
    rotation = se3.rotation_from_quaternion(size * q)
    np.testing.assert_allclose(rotation, se3.rotation_from_quaternion(q), atol=1e-12)
    assert np.isnan(se3.rotation_from_quaternion(np.zeros(4))).any()


@pytest.mark.parametrize("axis", np.vstack([np.eye(3), [[0.6, 0.8, 0], [0.1, -0.7, 0.7]]]))
@pytest.mark.parametrize("angle", [np.pi, np.pi - 1e-9, np.pi - 1e-5])
def test_half_turns(axis: np.ndarray, angle: float) -> None:
    rotation = se3.so3_exp(axis / np.linalg.norm(axis) * angle)
    phi = se3.so3_log(rotation)
    assert np.linalg.norm(phi) == pytest.approx(angle, abs=1e-7)
    np.testing.assert_allclose(se3.so3_exp(phi), rotation, atol=1e-9)


def test_batches_equal_single_calls() -> None:
    xi = np.random.default_rng(0).standard_normal((3, 4, 6))
    batch = se3.exp(xi)
    assert batch.shape == (3, 4, 4, 4)
    for i in range(3):
        for j in range(4):
            np.testing.assert_allclose(batch[i, j], se3.exp(xi[i, j]), atol=1e-15)
    np.testing.assert_allclose(se3.log(batch), np.stack([[se3.log(t) for t in row] for row in batch]), atol=1e-12)


def test_interpolation_is_halfway() -> None:
    a, b = se3.exp(np.array([1, 2, 3, 0.1, 0.2, 0.3])), se3.exp(np.array([0, 1, 0, -0.5, 0.2, 0.9]))
    half = se3.interpolate(a, b, 0.5)
    np.testing.assert_allclose(se3.log(se3.inverse(a) @ half), se3.log(se3.inverse(half) @ b), atol=1e-12)
    ends = se3.interpolate(a, b, np.array([0.0, 1.0]))
    np.testing.assert_allclose(ends, np.stack([a, b]), atol=1e-12)


def test_orthonormalize_mends_drift() -> None:
    t = se3.exp(np.array([1, 2, 3, 0.4, -0.2, 0.9]))
    dirty = t + 1e-6 * np.random.default_rng(1).standard_normal((4, 4))
    clean = se3.orthonormalize(dirty)
    np.testing.assert_allclose(clean[:3, :3] @ clean[:3, :3].T, np.eye(3), atol=1e-14)
    assert np.linalg.det(clean[:3, :3]) == pytest.approx(1.0)
    np.testing.assert_allclose(clean[3], [0, 0, 0, 1])


@settings(max_examples=50, deadline=None)
@given(tangent, st.floats(0.1, 8), st.integers(0, 2**31))
def test_umeyama_finds_the_similarity(xi: np.ndarray, scale: float, seed: int) -> None:
    source = np.random.default_rng(seed).standard_normal((20, 3))
    truth = se3.exp(xi)
    target = scale * source @ truth[:3, :3].T + truth[:3, 3]
    found, found_scale = se3.umeyama(source, target, with_scale=True)
    np.testing.assert_allclose(found, truth, atol=1e-9)
    assert found_scale == pytest.approx(scale)
    rigid, one = se3.umeyama(source, (target - truth[:3, 3]) / scale + truth[:3, 3])
    np.testing.assert_allclose(rigid, truth, atol=1e-9)
    assert one == 1.0


def test_umeyama_never_reflects_and_refuses_lines() -> None:
    source = np.random.default_rng(3).standard_normal((30, 3))
    mirrored = source * [1, 1, -1]
    assert np.linalg.det(se3.umeyama(source, mirrored)[0][:3, :3]) == pytest.approx(1.0)
    line = np.outer(np.arange(5.0), [1, 2, 3])
    with pytest.raises(ValueError, match="collinear"):
        se3.umeyama(line, line)
    with pytest.raises(ValueError, match="three points"):
        se3.umeyama(line[:2], line[:2])


def test_extent_is_metres_and_radians() -> None:
    xi = np.array([[3.0, 0, 4.0, 0, 0, 0], [0, 0, 0, 0.3, 0, 0.4], [0, 0, 0, 0, np.pi, 0]])
    metres, radians = se3.extent(se3.exp(xi))
    np.testing.assert_allclose(metres, [5.0, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(radians, [0.0, 0.5, np.pi], atol=1e-7)
