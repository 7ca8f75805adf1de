"""All textures in one byte array, each as a ripmap: filtered for every pair of horizontal and vertical scales.

A shelf seen along its aisle shrinks its pictures in one direction only; a ripmap (anisotropic mip pyramid, as in
Larson and Shah 1990) filters each axis by its own footprint, so that nothing aliases and nothing blurs needlessly.
Level (i, j) of a (h, w) picture lies in a (2h, 2w) block at column 2w - (2w >> i), row 2h - (2h >> j).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np

from stereo_sfm.types import F64, I64, U8


def _power_of_two(n: int) -> int:
    return 1 << max(2, int(np.ceil(np.log2(max(n, 4)) - 0.25)))


def _ripmap(image: U8) -> U8:
    """(h, w) powers of two -> (2h, 2w)."""
    h, w = image.shape
    out = np.zeros((2 * h, 2 * w), np.uint8)
    row = image.astype(np.float32)
    j = 0
    while True:
        level, i, y0 = row, 0, 2 * h - (2 * h >> j)
        while True:
            x0 = 2 * w - (2 * w >> i)
            out[y0 : y0 + level.shape[0], x0 : x0 + level.shape[1]] = np.rint(level)
            if level.shape[1] == 1:
                break
            level, i = 0.5 * (level[:, ::2] + level[:, 1::2]), i + 1
        if row.shape[0] == 1:
            return out
        row, j = 0.5 * (row[::2] + row[1::2]), j + 1


@dataclass
class Atlas:
    """Collects pictures and packs them."""

    blocks: list[U8] = field(default_factory=list[U8])
    table: list[tuple[int, int, int, int]] = field(default_factory=list[tuple[int, int, int, int]])
    sizes: list[tuple[float, float]] = field(default_factory=list[tuple[float, float]])
    used: int = 0

    def add(self, image: U8, size: tuple[float, float] = (0.0, 0.0), wrap: bool = False) -> int:
        """Add a picture.

        Args:
            image: (h, w), resized to powers of two.
            size: metres (width, height) that one period covers; (0, 0) stretches it over whatever it is put on.
            wrap: repeat beyond its edges, else clamp.

        Returns:
            Its index.
        """
        h, w = _power_of_two(image.shape[0]), _power_of_two(image.shape[1])
        if image.shape != (h, w):
            image = np.asarray(cv2.resize(image, (w, h), interpolation=cv2.INTER_AREA), np.uint8)
        self.blocks.append(_ripmap(image).ravel())
        self.table.append((self.used, w.bit_length() - 1, h.bit_length() - 1, int(wrap)))
        self.sizes.append(size)
        self.used += 4 * h * w
        return len(self.table) - 1

    def pack(self) -> tuple[U8, I64, F64]:
        """Bytes (N,), table (T, 4) of offset, log2 width, log2 height, wraps; sizes (T, 2) metres."""
        return np.concatenate(self.blocks), np.array(self.table, np.int64), np.array(self.sizes, float)
