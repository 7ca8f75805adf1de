"""Distances between 256-bit binary descriptors, for compiled kernels: 32 bytes as four uint64."""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false, reportMissingTypeArgument=false

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stereo_sfm.geometry.kernels import inner, njit
from stereo_sfm.types import U8

U64 = NDArray[np.uint64]
BITS = 256


def as_words(descriptors: U8) -> U64:
    """(N, 32) uint8 -> (N, 4) uint64 with the same bits."""
    return np.ascontiguousarray(descriptors, np.uint8).reshape(-1, 32).view(np.uint64)


@inner
def _popcount(x):
    x = x - ((x >> np.uint64(1)) & np.uint64(0x5555555555555555))
    x = (x & np.uint64(0x3333333333333333)) + ((x >> np.uint64(2)) & np.uint64(0x3333333333333333))
    x = (x + (x >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return np.int64((x * np.uint64(0x0101010101010101)) >> np.uint64(56))


@njit
def hamming(a, i, b, j):
    """Number of bits in which row i of a and row j of b differ."""
    return (
        _popcount(a[i, 0] ^ b[j, 0])
        + _popcount(a[i, 1] ^ b[j, 1])
        + _popcount(a[i, 2] ^ b[j, 2])
        + _popcount(a[i, 3] ^ b[j, 3])
    )


@inner
def hamming_to_all(a, i, columns, out):
    """Number of bits in which row i of a (N, 4) and each column of `columns` (4, M) differ: out (M,) int16.

    Words in columns let the processor count those of several descriptors at once.
    """
    a0, a1, a2, a3 = a[i, 0], a[i, 1], a[i, 2], a[i, 3]
    for j in range(columns.shape[1]):
        out[j] = (
            _popcount(a0 ^ columns[0, j])
            + _popcount(a1 ^ columns[1, j])
            + _popcount(a2 ^ columns[2, j])
            + _popcount(a3 ^ columns[3, j])
        )
