"""Image defects: dirt on the lens, flicker of lamps, JPEG compression."""

from __future__ import annotations

import math

import cv2
import numpy as np

from stereo_sfm.types import F32, U8

SPOTS = 14  # with dirt=1
HAZE = 18.0  # grey levels of scattered light where the dirt is opaque
FLICKER_HZ = 100.0  # lamps on 50 Hz mains have two maxima per period


class Dirt:
    """Fingerprints and dust out of focus: soft spots that dim the image behind them and add haze."""

    def __init__(self, shape: tuple[int, int], amount: float, rng: np.random.Generator) -> None:
        """Args:
        shape: (H, W). amount: 0 to 1. rng: a different one for each camera.
        """
        h, w = shape
        v, u = np.mgrid[0:h, 0:w].astype(np.float32)
        opaque = np.zeros(shape, np.float32)
        for _ in range(round(SPOTS * amount)):
            cu, cv = rng.uniform(0, w), rng.uniform(0, h)
            radius, strength = rng.uniform(0.01, 0.06) * w, rng.uniform(0.3, 0.9)
            distance = np.hypot(u - cu, v - cv) / radius
            opaque = np.maximum(opaque, strength * np.clip(1.5 - distance, 0, 1)).astype(np.float32)
        self._through: F32 = 1 - opaque
        self._haze: F32 = (HAZE * opaque).astype(np.float32)

    def over(self, image: F32) -> F32:
        """The image (H, W) seen through the dirt."""
        return image * self._through + self._haze


def flicker(amount: float, seconds: float, exposure_s: float) -> float:
    """Brightness relative to steady light, averaged over the exposure, of lamps with modulation `amount` (0 to 1)."""
    half = math.pi * FLICKER_HZ * exposure_s
    averaged = math.sin(half) / half if half > 1e-9 else 1.0
    return 1 + amount * averaged * math.sin(2 * math.pi * FLICKER_HZ * seconds)


def compressed(image: U8, quality: int) -> U8:
    """The image (H, W) after JPEG compression at `quality` (1 to 100); unchanged at 0."""
    if quality == 0:
        return image
    data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE), np.uint8)
