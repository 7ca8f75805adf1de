"""Decoding of image files to grey, and conversion from 16 to 8 bits.

The size in the header is checked before a file is decoded: a few kilobytes of PNG or JPEG can expand to
gigabytes of pixels.
"""

from __future__ import annotations

import io
import logging
import warnings
import zlib
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.types import U8, U16

log = logging.getLogger("stereo_sfm")

SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm", ".webp")  # of image files
MAX_PIXELS = 10**8  # of one image, more than any camera of a rig has
PNG = b"\x89PNG\r\n\x1a\n"  # how such a file begins
DARK = 30  # grey level; an image without a brighter pixel is dark
LEFT_ALIGNED = 0xF  # bits that are always zero when a sensor of at most twelve bits fills the upper part of sixteen


def declared_size(data: bytes) -> tuple[int, int]:
    """(width, height) that the header of an image file declares; no pixel is decoded.

    Raises:
        ValueError: not an image file, or larger than `MAX_PIXELS`.
    """
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(io.BytesIO(data)) as image:
                width, height = image.size
    except Image.DecompressionBombError:
        raise ValueError(f"a compressed image has more than {MAX_PIXELS} pixels") from None
    except (OSError, ValueError, SyntaxError, ArithmeticError, LookupError, TypeError, MemoryError):
        raise ValueError("a compressed image cannot be decoded") from None
    if width * height > MAX_PIXELS:
        raise ValueError(f"a compressed image of {width}x{height} has more than {MAX_PIXELS} pixels")
    return width, height


def write_image(path: Path, pixels: Any) -> None:
    """Write (H, W) or (H, W, C) pixels in the format of the suffix: `cv2.imwrite` ends the process where a name is not
    UTF-8.

    Raises:
        StereoSfmError: the file cannot be written.
    """
    try:
        path.write_bytes(cv2.imencode(path.suffix, pixels)[1].tobytes())
    except OSError as error:
        raise StereoSfmError(f"cannot write {path}: {error.strerror}") from None


def cut_off(data: bytes) -> bool:
    """Whether a PNG or JPEG file ends before its image does: OpenCV fills the rest with grey or black.

    A PNG ends with the chunk IEND. A JPEG has an end marker after its last start of a scan; both are
    unambiguous, as a scan's own bytes of 255 are followed by zero.
    """
    if data.startswith(PNG):
        return b"IEND" not in data
    return data.startswith(b"\xff\xd8") and data.rfind(b"\xff\xd9") < data.rfind(b"\xff\xda")


def _damaged_png(data: bytes) -> bool:
    """Whether a checksum of its chunks is wrong: libpng would print lines of its own about that."""
    view, at = memoryview(data), len(PNG)
    while at + 12 <= len(data):
        end = at + 12 + int.from_bytes(view[at : at + 4])
        if end > len(data) or zlib.crc32(view[at + 4 : end - 4]) != int.from_bytes(view[end - 4 : end]):
            return True
        if data[at + 4 : at + 8] == b"IEND":
            return False
        at = end
    return True


def decode(data: bytes, flags: int) -> np.ndarray[Any, Any]:
    """The pixels of an image file as OpenCV's `flags` want them.

    Raises:
        ValueError: not an image file, damaged, or too large.
    """
    declared_size(data)
    if cut_off(data):
        raise ValueError("a compressed image is cut off")
    if data.startswith(PNG) and _damaged_png(data):
        raise ValueError("a compressed image is damaged")
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except (cv2.error, MemoryError):
        image = None
    if image is None:
        raise ValueError("a compressed image cannot be decoded")
    return image


def decode_gray(data: bytes) -> U8 | U16:
    """Bytes of any image file that OpenCV reads -> (H, W) grey with the file's depth of eight or sixteen bits.

    Raises:
        ValueError: not an image file, damaged, too large, or of another depth.
    """
    image = decode(data, cv2.IMREAD_ANYDEPTH | cv2.IMREAD_GRAYSCALE)
    if image.dtype not in (np.uint8, np.uint16):
        raise ValueError(f"a compressed image has {image.dtype} pixels")
    return image


def sensor_bits(images: Iterable[U16]) -> int:
    """How many of the 16 bits a sensor uses (8, 10, 12, 14 or 16), from some of its images.

    Values whose lowest bits are always zero while the upper ones are used fill the upper part of the sixteen (TUM VI:
    twelve bits), so that full white is 65,535; of all others the largest one tells.
    """
    used = 0
    for image in images:
        used |= int(np.bitwise_or.reduce(image, axis=None))
    if not used & LEFT_ALIGNED and used >> 12:
        return 16
    return max(8, used.bit_length() + used.bit_length() % 2)


class BitsSoFar:
    """How many of 16 bits successive images use: what is white is known from those that came."""

    def __init__(self) -> None:
        self._bits = 0

    def including(self, images: Sequence[U8 | U16]) -> int:
        """Bits for `eight_bits`, of these images and those before; those of eight bits do not count."""
        deep: list[Any] = [image for image in images if image.dtype == np.uint16]
        bits = max(sensor_bits(deep), self._bits) if deep else self._bits
        if bits != self._bits:
            log.warning("16-bit images: the values use %d bits, %d is taken as white", bits, 2**bits - 1)
            self._bits = bits
        return bits


def eight_bits(image: U8 | U16, bits: int = 16) -> U8:
    """(H, W) u8 unchanged; u16 keeps the upper eight of the `bits` that its sensor uses, what is above is white."""
    if image.dtype == np.uint16:
        return np.minimum(np.right_shift(image, bits - 8), 255).astype(np.uint8)
    return image.astype(np.uint8, copy=False)
