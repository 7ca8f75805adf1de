"""How many of sixteen bits a source's images use: determined once, so that brightness does not jump between frames."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from stereo_sfm.pixels import sensor_bits

log = logging.getLogger("stereo_sfm")

SAMPLED = 8  # frames


def used_bits(name: str, sample: Callable[[int], Iterator[Any]]) -> int:
    """Sixteen for images of eight bits too.

    Args:
        name: of the source, for the warning where fewer than sixteen are used.
        sample: readable images of so many evenly spaced frames.
    """
    if not any(image.dtype == np.uint16 for image in sample(1)):
        return 16
    bits = sensor_bits(image for image in sample(SAMPLED) if image.dtype == np.uint16)
    if bits < 16:
        log.warning("%s: its sixteen-bit images use %d bits, these are scaled to eight", name, bits)
    return bits
