"""Masks: pixels of a camera that are used, as opposed to those that show the robot itself or dirt on the lens.

A mask is (H, W) bool, True where the image is used. Its file is an image of the camera's size; black pixels
(0) are not used, all others are, as in COLMAP and OpenCV's feature detectors.
"""

from __future__ import annotations

import base64
import binascii
from pathlib import Path

import cv2
import numpy as np

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.input_file import read_bytes
from stereo_sfm.pixels import decode_gray
from stereo_sfm.types import Bool

INLINE = "data:image/png;base64,"  # prefix of a mask contained in rig.yaml itself (RFC 2397)


def read_mask(path: Path) -> Bool:
    """The mask (H, W) of an image file.

    Raises:
        StereoSfmError: the file cannot be read or is no image.
    """
    try:
        return decode_gray(read_bytes(path)) > 0
    except OSError as error:
        raise StereoSfmError(f"cannot read the mask {path}: {error.strerror}") from None
    except ValueError as error:
        raise StereoSfmError(f"cannot read the mask {path}: {error}") from None


def encode_mask(mask: Bool) -> bytes:
    """A mask (H, W) as a PNG file, white where the image is used."""
    return cv2.imencode(".png", np.where(mask, 255, 0).astype(np.uint8))[1].tobytes()


def mask_to_text(mask: Bool) -> str:
    """A mask (H, W) as text that `mask_from_text` reads."""
    return INLINE + base64.b64encode(encode_mask(mask)).decode("ascii")


def mask_from_text(text: str, folder: Path | None) -> Bool:
    """The mask (H, W) that rig.yaml names: PNG data, or a file relative to the folder of rig.yaml.

    Args:
        text: value of `mask`. folder: None if files may not be named, as in a log.

    Raises:
        ValueError: the data is no image, or a file is named without a folder.
        StereoSfmError: the file cannot be read.
    """
    if text.startswith(INLINE):
        try:
            return decode_gray(base64.b64decode(text[len(INLINE) :], validate=True)) > 0
        except binascii.Error:
            raise ValueError("the mask is not base64 text") from None
    if folder is None:
        raise ValueError("the mask is not PNG data")
    return read_mask(folder / text)


def half_size(mask: Bool) -> Bool:
    """(H / 2, W / 2) mask of the half-size image: used where the four pixels and their neighbours are all used."""
    return (cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0)[::2, ::2]


def uncovered(mask: Bool, margin_px: int) -> Bool:
    """(H, W) where all pixels within `margin_px` (a square) are used; those outside the image count as used."""
    size = 2 * margin_px + 1
    return cv2.erode(mask.astype(np.uint8), np.ones((size, size), np.uint8)) > 0
