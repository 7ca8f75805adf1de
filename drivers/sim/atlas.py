"""All textures in one byte array, each as a ripmap: filtered for every pair of horizontal and vertical scales.

A shelf seen along its aisle shrinks its textures in one direction only; a ripmap (anisotropic mip pyramid, as in
Larson and Shah 1990) filters each axis by its own footprint, so that nothing aliases and nothing blurs needlessly.
Level (i, j) of a (h, w) image lies in a (2h, 2w) block at column 2w - (2w >> i), row 2h - (2h >> j).
"""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np

from stereo_sfm.drivers.sim.kernels import njit
from stereo_sfm.types import F32, F64, I64, U8


@njit
def _fill_ripmap(block, out):
    """Complete `block` (2h, 2w) float, whose first quarter is the image, by pair means; round into `out`."""
    h, w = block.shape[0] // 2, block.shape[1] // 2
    x0, n = w, w // 2
    while n >= 1:  # halve along the rows
        before = x0 - 2 * n
        for y in range(h):
            for x in range(n):
                block[y, x0 + x] = 0.5 * (block[y, before + 2 * x] + block[y, before + 2 * x + 1])
        x0 += n
        n //= 2
    y0, n = h, h // 2
    while n >= 1:  # halve every column of that
        before = y0 - 2 * n
        for y in range(n):
            for x in range(2 * w):
                block[y0 + y, x] = 0.5 * (block[before + 2 * y, x] + block[before + 2 * y + 1, x])
        y0 += n
        n //= 2
    for y in range(2 * h):
        for x in range(2 * w):
            out[y, x] = np.uint8(block[y, x] + 0.5)


def _ripmap(image: U8) -> U8:
    """(h, w) powers of two -> (2h, 2w)."""
    h, w = image.shape
    block = np.zeros((2 * h, 2 * w), np.float32)
    block[:h, :w] = image
    out = np.empty((2 * h, 2 * w), np.uint8)
    _fill_ripmap(block, out)
    return out


def _power_of_two(n: int) -> int:
    return 1 << max(2, int(np.ceil(np.log2(max(n, 4)) - 0.25)))


def _resize(image: U8, w: int, h: int) -> U8:
    """Each axis by the filter that suits it: means when it shrinks, linear when it grows."""
    wide: F32 = image.astype(np.float32)
    for size, shrinks in (((w, image.shape[0]), w < image.shape[1]), ((w, h), h < image.shape[0])):
        how = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
        wide = np.asarray(cv2.resize(wide, size, interpolation=how), np.float32)
    return np.clip(np.rint(wide), 0, 255).astype(np.uint8)


@dataclass
class Atlas:
    """Collects images and packs them."""

    blocks: list[U8] = field(default_factory=list[U8])
    table: list[tuple[int, int, int, int]] = field(default_factory=list[tuple[int, int, int, int]])
    sizes: list[tuple[float, float]] = field(default_factory=list[tuple[float, float]])
    used: int = 0

    def add(self, image: U8, size: tuple[float, float] = (0.0, 0.0), wrap: bool = False) -> int:
        """Add an image.

        Args:
            image: (h, w), resized to powers of two.
            size: metres (width, height) that one period covers; (0, 0) stretches it over whatever it is put on.
            wrap: repeat beyond its edges, else clamp.

        Returns:
            Its index.
        """
        h, w = _power_of_two(image.shape[0]), _power_of_two(image.shape[1])
        if image.shape != (h, w):
            image = _resize(image, w, h)
        self.blocks.append(_ripmap(image).ravel())
        self.table.append((self.used, w.bit_length() - 1, h.bit_length() - 1, int(wrap)))
        self.sizes.append(size)
        self.used += 4 * h * w
        return len(self.table) - 1

    def pack(self) -> tuple[U8, I64, F64]:
        """Bytes (N,), table (T, 4) of offset, log2 width, log2 height, wraps; sizes (T, 2) metres."""
        texels = np.concatenate(self.blocks) if self.blocks else np.zeros(0, np.uint8)
        return texels, np.array(self.table, np.int64).reshape(-1, 4), np.array(self.sizes, float).reshape(-1, 2)
