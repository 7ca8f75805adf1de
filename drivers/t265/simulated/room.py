# pyright: reportUntypedFunctionDecorator=false
"""A textured room seen through a fisheye pair: fast rendering with exact ground truth for the simulated camera.

The simulated store (`sim:`) is more realistic and takes seconds per frame; this one takes milliseconds.
"""

from __future__ import annotations

import cv2
import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.geometry import se3
from stereo_sfm.kernel_cache import jit
from stereo_sfm.types import F32, F64, U8

_HALF_SIZE_M = np.array([5.0, 1.6, 4.0])  # x right, y down, z forward
_TEXTURE_PX_PER_M = 64.0


@jit(fastmath=False)
def _trace(bearings: F32, rotation: F64, origin: F64, half: F64, texture: U8, scale: float, out: U8) -> None:
    """Brightness of the inside of a box along every ray; 0 where a pixel has no ray.

    Args:
        bearings: (H, W, 3) in the camera, NaN where there is none.
        rotation, origin: world_T_cam. half: (3,) half the box's size, m.
        texture: (6, S, S). scale: texels per metre. out: (H, W) to fill.
    """
    size = texture.shape[1]
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            out[i, j] = 0
            if np.isnan(bearings[i, j, 0]):
                continue
            best, face = 1e9, -1
            x = bearings[i, j, 0]
            y = bearings[i, j, 1]
            z = bearings[i, j, 2]
            d = (
                rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z,
                rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z,
                rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z,
            )
            for axis in range(3):
                if d[axis] > 1e-9:
                    t = (half[axis] - origin[axis]) / d[axis]
                    side = 1
                elif d[axis] < -1e-9:
                    t = (-half[axis] - origin[axis]) / d[axis]
                    side = 0
                else:
                    continue
                if t < best:
                    best, face = t, 2 * axis + side
            a = 1 if face < 2 else 0
            b = 1 if face >= 4 else 2
            u = (origin[a] + best * d[a] + half[a]) * scale
            v = (origin[b] + best * d[b] + half[b]) * scale
            u0, v0 = int(u), int(v)
            fu, fv = u - u0, v - v0
            u0, v0 = u0 % (size - 1), v0 % (size - 1)
            top = texture[face, v0, u0] * (1 - fu) + texture[face, v0, u0 + 1] * fu
            low = texture[face, v0 + 1, u0] * (1 - fu) + texture[face, v0 + 1, u0 + 1] * fu
            out[i, j] = int(top * (1 - fv) + low * fv + 0.5)


class Room:
    """Renders pairs of one rig."""

    def __init__(self, rig: Rig, seed: int = 0) -> None:
        assert rig.right is not None
        rng = np.random.default_rng(seed)
        self._rig = rig
        self._bearings = [camera.bearing_grid().astype(np.float32) for camera in (rig.left, rig.right)]
        self._texture = np.stack([self._wall(rng) for _ in range(6)])

    @staticmethod
    def _wall(rng: np.random.Generator, size: int = 1024) -> U8:
        """Blobs of several sizes: corners at every distance."""
        wall = np.zeros((size, size), np.float32)
        for cells, weight in ((32, 0.8), (128, 1.0), (384, 0.7)):
            noise = rng.random((cells, cells), np.float32)
            wall += weight * cv2.resize(noise, (size, size), interpolation=cv2.INTER_CUBIC)
        wall = (wall - wall.min()) / np.ptp(wall)
        return np.clip(20 + 215 * np.clip((wall - 0.5) * 2.2 + 0.5, 0, 1), 0, 255).astype(np.uint8)

    def render(self, world_T_cam: F64) -> tuple[U8, U8]:
        """(H, W) left and right for the left camera's pose."""
        poses = (world_T_cam, world_T_cam @ self._rig.left_T_right)
        images: list[U8] = []
        for bearings, pose in zip(self._bearings, poses, strict=True):
            out = np.empty(bearings.shape[:2], np.uint8)
            rotation = np.ascontiguousarray(pose[:3, :3])
            _trace(bearings, rotation, pose[:3, 3].copy(), _HALF_SIZE_M, self._texture, _TEXTURE_PX_PER_M, out)
            images.append(out)
        return images[0], images[1]


def camera_path(seconds: F64) -> F64:
    """(N,) s -> (N, 4, 4) world_T_cam: a slow loop through the room at about 0.5 m/s, looking around."""
    t = np.asarray(seconds, float)
    phase = 0.25 * t
    position = np.stack([2.2 * np.sin(phase), 0.12 * np.sin(1.9 * t), -1.5 + 1.5 * np.cos(phase) + 0.4 * phase * 0], -1)
    yaw = 0.5 * np.sin(0.6 * t)
    pitch, roll = 0.06 * np.sin(1.3 * t), 0.05 * np.sin(1.7 * t)
    turn = se3.so3_exp(np.stack([pitch, yaw, roll], -1))
    return se3.from_rotation_translation(turn, position)
