"""Patches are found again where an exact warp has put them."""

from __future__ import annotations

import numpy as np
import pytest

from stereo_sfm.calib.patches import F32, align, cut, unstretched
from stereo_sfm.types import F64


def picture(u: F64, v: F64) -> F32:
    """A smooth texture, defined between the pixels too."""
    rng = np.random.default_rng(3)
    out = np.full(u.shape, 120.0)
    for _ in range(40):
        a, b, phase = *rng.uniform(-0.7, 0.7, 2), rng.uniform(0, 6.3)
        out = out + 9 * np.sin(a * u + b * v + phase)
    return out.astype(np.float32)


@pytest.mark.parametrize("gain", [1.0, 0.6])
def test_a_stretched_and_darker_image_is_followed(gain: float) -> None:
    v, u = np.mgrid[0:120, 0:160].astype(float)
    stretch = np.array([[1.15, 0.06], [-0.04, 1.1]])
    shift = np.array([-6.4, 3.3])
    back = (np.stack([u, v], -1) - shift) @ np.linalg.inv(stretch).T
    other = gain * picture(back[..., 0], back[..., 1]) + 20
    uv = np.stack(np.meshgrid(np.arange(25.0, 120, 12), np.arange(25.0, 85, 12)), -1).reshape(-1, 2)
    truth = uv @ stretch.T + shift
    rough = truth + np.random.default_rng(1).uniform(-0.7, 0.7, truth.shape)
    warp, good = align(cut(picture(u, v), uv), other.astype(np.float32), unstretched(rough), iterations=15)
    inside = (truth > 14).all(1) & (truth[:, 0] < 145) & (truth[:, 1] < 105)
    assert good[inside].mean() > 0.95
    error = np.linalg.norm(warp.uv - truth, axis=1)[inside & good]
    assert np.sqrt((error**2).mean()) < 0.05
    np.testing.assert_allclose(np.median(warp.stretch[inside & good], axis=0), stretch, atol=0.01)


def test_occluded_windows_are_not_found() -> None:
    v, u = np.mgrid[0:80, 0:80].astype(float)
    uv = np.array([[30.0, 30], [45, 40], [40, 55]])
    noise = np.random.default_rng(0).uniform(0, 255, (80, 80)).astype(np.float32)
    _, good = align(cut(picture(u, v), uv), noise, unstretched(uv))
    assert not good.any()
