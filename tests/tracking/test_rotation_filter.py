"""Rotations of images and gyroscope together, against exact ones."""

from __future__ import annotations

import numpy as np

from stereo_sfm.geometry import se3
from stereo_sfm.tracking.inertial.rotation_filter import RotationFilter
from stereo_sfm.types import F64

SEEN, TURNED = 1e-4, 4e-5  # rad, standard deviations of a rotation from an image and of one between two images


def covariance() -> F64:
    """(6, 6) of a pose from an image: a shift to the right looks like a turn to the left."""
    rotation = SEEN**2 * np.eye(3)
    out = np.diag([1e-8, 1e-8, 1e-8, SEEN**2, SEEN**2, SEEN**2])
    out[0, 0] += 4.0 * SEEN**2  # x = 2 m/rad * turn about y
    out[0, 4] = out[4, 0] = 2.0 * rotation[1, 1]
    return out


def drive(
    seed: int, frames: int = 400, wrong: int = -1, slips: tuple[int, ...] = (), drift: float = 0.0
) -> tuple[F64, F64, F64]:
    """Errors of the poses by images (N, 6) and of the fused ones, and chi-squared (N,).

    `wrong`: a frame with a turn of two degrees that only the gyroscope measures. `slips`: frames in which the images
    say a turn of a tenth of a degree too much. `drift`: rad a frame of the gyroscope.
    """
    rng, filter_ = np.random.default_rng(seed), RotationFilter()
    true, fused = np.eye(4), np.eye(4)
    errors, chi2 = list[tuple[F64, F64]](), list[float]()
    for k in range(frames):
        turn = np.asarray(se3.so3_exp(rng.normal(0, 0.02, 3)))
        true = true @ se3.from_rotation_translation(turn, rng.normal(0, 0.02, 3))
        measured = turn @ se3.so3_exp(rng.normal(0, TURNED, 3) + (0.035 if k == wrong else drift))
        seen = true @ se3.exp(rng.multivariate_normal(np.zeros(6), covariance()))
        if k in slips:
            seen = seen @ se3.exp(np.array([0, 0, 0, 1.7e-3, 0, 0]))
        fused = filter_.fused(fused[:3, :3] @ measured, measured, TURNED**2 * np.eye(3), seen, covariance())
        errors.append((se3.log(se3.inverse(true) @ seen), se3.log(se3.inverse(true) @ fused)))
        chi2.append(filter_.chi2)
    by_images, both = np.swapaxes(np.array(errors), 0, 1)
    return by_images, both, np.array(chi2)


def test_the_gyroscope_makes_rotation_and_the_shift_that_looks_like_it_more_exact() -> None:
    by_images, both, chi2 = drive(0)
    for axis, most in ((3, 0.7), (4, 0.7), (5, 0.7), (0, 0.8)):
        assert both[:, axis].std() < most * by_images[:, axis].std()
    steps = [np.diff(errors[:, 3:], axis=0).std() for errors in (by_images, both)]
    assert steps[1] < 0.45 * steps[0]
    assert both[:, 1:3].std() < 1.02 * by_images[:, 1:3].std()
    assert 2.7 < chi2[1:].mean() < 3.3  # three degrees of freedom: the covariance is right


def test_a_wrong_turn_of_the_gyroscope_does_not_count() -> None:
    by_images, both, chi2 = drive(1, wrong=200)
    assert chi2[200] > 1e4
    assert np.abs(both[200, 3:] - by_images[200, 3:]).max() < 5 * SEEN
    assert both[205:, 3:].std() < 0.7 * by_images[205:, 3:].std()


def test_the_images_are_wrong_where_they_contradict_a_good_gyroscope() -> None:
    slips = (100, 101, 180, 300)
    by_images, both, _ = drive(2, slips=slips)
    assert np.abs(by_images[list(slips), 3]).min() > 1e-3
    assert np.abs(both[list(slips), 3]).max() < 3e-4
    assert both[320:, 3:].std() < 0.7 * by_images[320:, 3:].std()


def test_a_gyroscope_that_contradicts_the_images_all_the_time_is_wrong() -> None:
    by_images, both, chi2 = drive(3, drift=1e-3)
    assert np.median(chi2[100:]) > 11.3
    assert np.abs(both[100:, 3:] - by_images[100:, 3:]).max() < 5 * SEEN


def test_the_first_pose_is_that_of_the_image() -> None:
    filter_, seen = RotationFilter(), se3.exp(np.array([0.1, 0.2, 0.3, 0.1, 0.0, 0.2]))
    other = np.asarray(se3.so3_exp(np.array([0.1, 0.0, 0.0])))
    for _ in range(2):
        assert np.array_equal(filter_.fused(other, other, TURNED**2 * np.eye(3), seen, covariance()), seen)
        filter_.restart()
