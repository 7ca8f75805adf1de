"""Effects of lens and sensor: motion blur, exposure, vignetting, noise, eight bits. Seeded by frame and camera."""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false, reportMissingTypeArgument=false

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from stereo_sfm.drivers.sim.kernels import njit
from stereo_sfm.drivers.sim.lens import Dirt, compressed, flicker
from stereo_sfm.drivers.sim.render import CameraRays, View
from stereo_sfm.drivers.sim.robot import RobotView
from stereo_sfm.types import F32, F64, U8


@dataclass(frozen=True)
class Effects:
    """Effects of a lens and a sensor; `CLEAN` has none."""

    exposure_s: float = 0.004  # motion blur and StereoImage.exposure_us
    lens_blur_px: float = 0.45  # standard deviation of the lens's point spread
    gain: float = 1.2  # brightness of the image
    drift: float = 0.12  # relative swing of the exposure over time
    vignetting: float = 0.35  # loss at the edge of the field
    read_noise: float = 0.9  # standard deviation in grey levels, in the dark
    shot_noise: float = 0.02  # variance in grey levels per grey level
    black_level: float = 3.0
    dirt: float = 0.0  # spots on the lens, 0 to 1
    flicker: float = 0.0  # swing of the lamps' brightness at twice the mains frequency
    jpeg: int = 0  # quality of a lossy link; 0: none
    drop: float = 0.0  # fraction of frames that never arrive
    defocus_px: float = 0.0  # standard deviation of what a lens out of focus adds to its point spread


CLEAN = Effects(0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


class Sensor:
    """Lens and sensor of one camera, with tables by pixel."""

    def __init__(
        self, rays: CameraRays, effects: Effects, robot: RobotView | None = None, rng: np.random.Generator | None = None
    ) -> None:
        """`robot`: what this camera sees of the robot. `rng`: of the dirt on this lens."""
        self.robot = robot
        self._dirt = Dirt(rays.grid.shape[:2], effects.dirt, rng) if effects.dirt > 0 and rng is not None else None
        grid = rays.grid
        camera = rays.camera
        corners = camera.unproject(np.array([[0, camera.cy], [camera.width - 1, camera.cy]]))
        edge = np.nanmax(np.arccos(np.clip(corners[:, 2], -1, 1))) if np.isfinite(corners[:, 2]).any() else 1.6
        angle = np.arccos(np.clip(np.nan_to_num(grid[..., 2], nan=-1.0), -1, 1))
        fall = 1 - effects.vignetting * np.minimum(angle / edge, 1.2) ** 2
        rim = np.clip((np.deg2rad(92.5) - angle) / np.deg2rad(6.0), 0, 1)
        soft = rim * rim * (3 - 2 * rim) if effects.vignetting > 0 else 1.0
        self.vignette = np.where(np.isfinite(grid[..., 2]), fall * soft, 0).astype(np.float32)  # (H, W)
        self.effects = effects
        self._steepest = 0.0  # px per radian at most
        self._jacobian: F32 | None = None  # (H, W, 2, 3) d pixel / d bearing
        if effects.exposure_s > 0:
            self._jacobian = np.nan_to_num(camera.project_jacobian(grid)[1]).astype(np.float32)
            self._steepest = float(np.linalg.norm(self._jacobian, axis=(2, 3)).max())

    def expose(self, view: View, twist: F64, brightness: float, key: int) -> U8:
        """(H, W) image of the sensor.

        Args:
            twist: (6,) velocity of the camera in its own axes, metres and radians a second.
            brightness: exposure relative to the clean image. key: of the noise, one for each frame and camera.
        """
        effects = self.effects
        image = view.image
        if self._jacobian is not None:
            blurred = np.empty_like(image)
            _blur(image, view.depth, self._jacobian, self._steepest, twist * effects.exposure_s, blurred)
            image = blurred
        image = image if self.robot is None else self.robot.over(image)
        if effects.lens_blur_px > 0:
            image = np.asarray(cv2.GaussianBlur(image, (5, 5), effects.lens_blur_px), np.float32)
        if effects.defocus_px > 0:
            image = np.asarray(cv2.GaussianBlur(image, (0, 0), effects.defocus_px), np.float32)
        image = image if self._dirt is None else self._dirt.over(image)
        out = np.empty(image.shape, np.uint8)
        read, shot = effects.read_noise**2, effects.shot_noise
        _digitise(
            image,
            self.vignette,
            np.uint64(key),
            brightness,
            read,
            shot,
            effects.black_level,
            out,
        )
        return compressed(out, effects.jpeg)


def brightness(effects: Effects, seconds: float, seed: int) -> float:
    """Exposure at a time: the gain with two slow oscillations."""
    phase = np.random.default_rng([seed, 91]).uniform(0, 2 * np.pi, 2)
    swing = 0.7 * math.sin(2 * math.pi * seconds / 13.0 + phase[0]) + 0.3 * math.sin(
        2 * math.pi * seconds / 4.1 + phase[1]
    )
    return effects.gain * (1 + effects.drift * swing) * flicker(effects.flicker, seconds, effects.exposure_s)


@njit
def _blur(image, depth, jacobian, steepest, move, out):
    """Average along each pixel's path while the shutter is open, symmetric about mid-exposure.

    A point at depth t along bearing b moves by -(v + w x (t b)) in the camera frame, its pixel by J(b) times that / t.
    """
    h, w = image.shape
    speed = math.sqrt(move[0] * move[0] + move[1] * move[1] + move[2] * move[2])
    turning = math.sqrt(move[3] * move[3] + move[4] * move[4] + move[5] * move[5])
    for y in range(h):
        for x in range(w):
            t = depth[y, x]
            j = jacobian[y, x]
            out[y, x] = image[y, x]
            if not (t > 0 and steepest * (speed / t + turning) >= 0.74):
                continue
            # J(b) annihilates b, and J(b) maps a change of the bearing to pixels: use the tangent part only.
            v0, v1, v2 = move[0] / t, move[1] / t, move[2] / t
            b = _bearing(j)
            p0 = -(v0 + move[4] * b[2] - move[5] * b[1])
            p1 = -(v1 + move[5] * b[0] - move[3] * b[2])
            p2 = -(v2 + move[3] * b[1] - move[4] * b[0])
            fu = j[0, 0] * p0 + j[0, 1] * p1 + j[0, 2] * p2
            fv = j[1, 0] * p0 + j[1, 1] * p1 + j[1, 2] * p2
            n = int(math.sqrt(fu * fu + fv * fv) * 1.34) + 1
            if n < 2:
                continue
            n = min(n, 24)
            total = 0.0
            reach = 0.5 * max(abs(fu), abs(fv)) + 1
            if x < reach or y < reach or x > w - 1 - reach or y > h - 1 - reach:
                continue
            for k in range(n):
                a = (k + 0.5) / n - 0.5
                total += _between(image, x + a * fu, y + a * fv)
            out[y, x] = total / n


@njit
def _bearing(j):
    """Unit vector that both rows of a projection's derivative annihilate (up to the sign, forward half first)."""
    a = j[0, 1] * j[1, 2] - j[0, 2] * j[1, 1]
    b = j[0, 2] * j[1, 0] - j[0, 0] * j[1, 2]
    c = j[0, 0] * j[1, 1] - j[0, 1] * j[1, 0]
    n = math.sqrt(a * a + b * b + c * c) + 1e-30
    return a / n, b / n, c / n


@njit
def _between(image, x, y):
    """Bilinear value inside the image."""
    x0, y0 = int(x), int(y)
    a, b = x - x0, y - y0
    top = image[y0, x0] * (1 - a) + image[y0, x0 + 1] * a
    low = image[y0 + 1, x0] * (1 - a) + image[y0 + 1, x0 + 1] * a
    return top * (1 - b) + low * b


@njit
def _normal(key, index):
    """About standard normal: the centred sum of four 16-bit uniforms out of a hash (splitmix64; Steele et al. 2014)."""
    z = key + np.uint64(index + 1) * np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    z = z ^ (z >> np.uint64(31))
    low = np.uint64(0xFFFF)
    total = (z & low) + ((z >> np.uint64(16)) & low) + ((z >> np.uint64(32)) & low) + (z >> np.uint64(48))
    return (np.float64(np.int64(total)) - 131070.0) * (1.7320508075688772 / 65536.0)


@njit
def _digitise(image, vignette, key, brightness, read, shot, black, out):
    """Exposure, vignetting, noise, clipping and rounding to a byte."""
    h, w = image.shape
    for y in range(h):
        for x in range(w):
            value = image[y, x] * vignette[y, x] * brightness
            if read > 0 or shot > 0:
                value += _normal(key, y * w + x) * math.sqrt(read + shot * max(value, 0.0))
            out[y, x] = int(min(max(value + black + 0.5, 0.0), 255.0))
