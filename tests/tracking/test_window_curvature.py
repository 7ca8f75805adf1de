"""The quadratic part of the deformation of a window: by the plane that its affine part determines."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Camera, KannalaBrandt, Pinhole
from stereo_sfm.tracking.flow import klt
from stereo_sfm.tracking.flow.tracks import Patches
from stereo_sfm.tracking.flow.window_curvature import window_curvatures, window_rays
from stereo_sfm.types import F64, U8

CAMERAS = (
    KannalaBrandt(848, 800, 286.0, 286.0, 424.0, 400.0, (-0.008, 0.05, -0.047, 0.01)),
    Pinhole(848, 800, 450.0, 450.0, 424.0, 400.0),
)
FLOOR = np.array([0.3, 1.0, 0.3]) / 0.9  # n X = 1, in the first camera: 0.8 m away
NEW_T_OLD = se3.inverse(se3.exp(np.array([0.05, 0.02, 0.5, 0.01, -0.05, 0.005])))  # towards what it sees


def old_pixels() -> F64:
    """(N, 2) where the floor is seen at a grazing angle."""
    return np.stack(np.meshgrid(np.arange(150.0, 700, 28), np.arange(520.0, 720, 28)), -1).reshape(-1, 2)


def mapped(camera: Camera, uv: F64) -> F64:
    """Where the floor at pixels (N, 2) of the old image is in the new one."""
    rays = camera.unproject(uv)
    return camera.project(se3.transform(NEW_T_OLD, rays / (rays @ FLOOR)[:, None]))


def warps(camera: Camera, uv: F64) -> F64:
    """(N, 2, 2) exact derivatives of `mapped`."""
    ends = [[mapped(camera, uv + sign * 0.5 * step) for sign in (1, -1)] for step in np.eye(2)]
    return np.stack([a - b for a, b in ends], axis=2)


def curvatures(camera: Camera, uv: F64, warp: F64) -> F64:
    rays, out = camera.unproject(uv), np.full((len(uv), 6), np.nan)
    odom_T_new = se3.inverse(NEW_T_OLD)
    window_curvatures(
        np.arange(len(uv)), window_rays(camera, uv, np.eye(3)), np.zeros((len(uv), 3)),
        rays / (rays @ FLOOR)[:, None], warp, odom_T_new, odom_T_new, camera.model_id, camera.params, out,
    )  # fmt: skip
    return out


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda c: type(c).__name__)
def test_curvatures_are_those_of_the_plane(camera: Camera) -> None:
    uv = old_pixels()
    warp, centre = warps(camera, uv), mapped(camera, uv)
    found = curvatures(camera, uv, warp).reshape(-1, 2, 3)
    assert found.any(axis=(1, 2)).all()
    for offset in np.array([(6.0, 0.0), (0.0, 6.0), (5.0, 5.0), (4.0, -6.0)]):
        both = [
            np.linalg.solve(warp, (mapped(camera, uv + sign * offset) - centre)[..., None])[..., 0] for sign in (1, -1)
        ]
        true = 0.5 * (both[0] + both[1])  # without the odd part
        x, y = offset
        expected = found @ np.array([0.5 * x * x, x * y, 0.5 * y * y])
        assert np.abs(true).max() > 0.04
        assert np.abs(expected - true).max() < 0.02 * np.abs(true).max()


def picture(camera: Camera, camera_T_old: F64) -> U8:
    """The floor, with a random texture, from a pose."""
    texture = cv2.GaussianBlur(np.random.default_rng(0).uniform(0, 255, (1200, 1200)).astype(np.float32), (0, 0), 2.2)
    texture = np.asarray(255 * (texture - texture.min()) / np.ptp(texture), np.float32)
    uv = np.stack(np.meshgrid(np.arange(float(camera.width)), np.arange(float(camera.height))), -1).reshape(-1, 2)
    rays = camera.unproject(uv) @ camera_T_old[:3, :3]
    origin = se3.inverse(camera_T_old)[:3, 3]
    points = origin + rays * ((1 - origin @ FLOOR) / (rays @ FLOOR))[:, None]
    with np.errstate(invalid="ignore"):
        ahead = (rays @ FLOOR > 0.02) & (np.abs(points) < 5.5).all(1)
    x, y = (np.where(ahead, points[:, k] * 100 + 600, 0).reshape(camera.height, camera.width) for k in (0, 2))
    return (
        np.rint(cv2.remap(texture, x.astype(np.float32), y.astype(np.float32), cv2.INTER_CUBIC))
        .clip(0, 255)
        .astype(np.uint8)
    )


def test_a_window_on_the_floor_is_found_without_a_bias() -> None:
    camera, uv = CAMERAS[0], old_pixels()
    old, new = picture(camera, np.eye(4)), picture(camera, NEW_T_OLD)
    store, slots = Patches(len(uv)).windows, np.arange(len(uv))
    good = klt.make_patches(klt.build_pyramid(old, 1)[0], uv, slots, store, klt.WEIGHTS, klt.COORDINATES)
    true, exact = mapped(camera, uv), warps(camera, uv)
    curved = curvatures(camera, uv, exact)
    spread = (klt.WEIGHTS * klt.COORDINATES[0] ** 2).sum()  # px^2, of a window's samples
    shift = np.einsum("nij,njk,k->ni", exact, curved.reshape(-1, 2, 3), [0.5 * spread, 0, 0.5 * spread])
    share = list[float]()  # of the shift by which the quadratic part moves a window's mean
    for curvature in (np.zeros_like(curved), curved):
        out, warp = true.copy(), exact.copy()
        ncc = klt.track_affine(
            klt.build_pyramid(new, 1)[0], out, warp, curvature, slots, good, store, 20, klt.WEIGHTS, klt.COORDINATES
        )
        error = out - true
        found = (ncc > 0.9) & (np.linalg.norm(error, axis=1) < 0.5)
        assert found.mean() > 0.6
        share.append(float((error * shift)[found].sum() / (shift * shift)[found].sum()))
    assert share[0] > 0.5
    assert abs(share[1]) < 0.25
