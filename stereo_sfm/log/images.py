"""Images as Foxglove messages and back: raw, PNG (lossless) and JPEG (lossy)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage

from stereo_sfm.errors import StereoSfmError, one_of
from stereo_sfm.pixels import MAX_PIXELS, decode, decode_gray, eight_bits
from stereo_sfm.types import F32, U8, U16, StereoImage

FORMATS = ("png", "raw", "jpeg")
# Average filter and run-length matching: of 26 settings the best ratio of size to time on real T265 and EuRoC
# images (benchmarks/record_speed.py); OpenCV's default is larger and slower.
PNG_OPTIONS = (
    cv2.IMWRITE_PNG_COMPRESSION,
    1,
    cv2.IMWRITE_PNG_STRATEGY,
    cv2.IMWRITE_PNG_STRATEGY_RLE,
    cv2.IMWRITE_PNG_FILTER,
    cv2.IMWRITE_PNG_FILTER_AVG,
)
JPEG_OPTIONS = (cv2.IMWRITE_JPEG_QUALITY, 90)


@dataclass(frozen=True)
class LoggedImage:
    """A pair as the log stores it. `image` has the decoded pixels, which the tracker of a lossy run must use."""

    image: StereoImage
    left: bytes
    right: bytes | None
    format: str


def encode_pair(image: StereoImage, image_format: str, decode: bool = True) -> LoggedImage:
    """Encode both images; for JPEG the pixels of `LoggedImage.image` are the decoded ones.

    Args:
        image: the pair.
        image_format: one of `FORMATS`.
        decode: False skips the decoding of JPEG if the pixels are not used again.
    """
    left = encode_pixels(image.left, image_format)
    right = None if image.right is None else encode_pixels(image.right, image_format)
    if image_format == "jpeg" and decode:
        image = replace(image, left=decode_file(left), right=None if right is None else decode_file(right))
    return LoggedImage(image, left, right, image_format)


def encode_pixels(pixels: U8, image_format: str) -> bytes:
    """(H, W) u8 -> bytes of the file, or the pixels row by row for `raw`."""
    if image_format == "raw":
        return np.ascontiguousarray(pixels).tobytes()
    one_of(image_format, FORMATS, "image format")
    suffix, options = (".png", PNG_OPTIONS) if image_format == "png" else (".jpg", JPEG_OPTIONS)
    done, data = cv2.imencode(suffix, pixels, options)
    if not done:
        raise StereoSfmError(f"OpenCV cannot encode a {pixels.shape} image as {image_format}")
    return data.tobytes()


def decode_file(data: bytes) -> U8:
    """Bytes of a PNG, JPEG or any file OpenCV reads -> (H, W) u8; deeper pixels keep their upper eight bits.

    Raises:
        ValueError: not an image, or too large.
    """
    return eight_bits(decode_gray(data))


def image_message(data: bytes, size: tuple[int, int], image_format: str, frame: str) -> RawImage | CompressedImage:
    """The message of encoded pixels; the caller sets the timestamp. `size` is (width, height)."""
    if image_format == "raw":
        return RawImage(frame_id=frame, width=size[0], height=size[1], encoding="mono8", step=size[0], data=data)
    return CompressedImage(frame_id=frame, format=image_format, data=data)


def depth_message(depth: F32, frame: str) -> RawImage:
    """(H, W) metres, NaN where unknown."""
    height, width = depth.shape
    data = np.ascontiguousarray(depth, "<f4").tobytes()
    return RawImage(frame_id=frame, width=width, height=height, encoding="32FC1", step=4 * width, data=data)


# encoding -> (bytes per channel, channels, OpenCV conversion to grey)
_BAYER = {"rggb": "BG", "bggr": "RG", "gbrg": "GR", "grbg": "GB"}
_ENCODINGS: dict[str, tuple[int, int, int | None]] = {
    "mono8": (1, 1, None),
    "8uc1": (1, 1, None),
    "mono16": (2, 1, None),
    "16uc1": (2, 1, None),
    "rgb8": (1, 3, cv2.COLOR_RGB2GRAY),
    "bgr8": (1, 3, cv2.COLOR_BGR2GRAY),
    "8uc3": (1, 3, cv2.COLOR_BGR2GRAY),
    "rgba8": (1, 4, cv2.COLOR_RGBA2GRAY),
    "bgra8": (1, 4, cv2.COLOR_BGRA2GRAY),
    "yuyv": (1, 2, cv2.COLOR_YUV2GRAY_YUYV),
    "yuv422_yuy2": (1, 2, cv2.COLOR_YUV2GRAY_YUYV),
    "uyvy": (1, 2, cv2.COLOR_YUV2GRAY_UYVY),
    "yuv422": (1, 2, cv2.COLOR_YUV2GRAY_UYVY),
    "rgb16": (2, 3, cv2.COLOR_RGB2GRAY),
    "bgr16": (2, 3, cv2.COLOR_BGR2GRAY),
    "rgba16": (2, 4, cv2.COLOR_RGBA2GRAY),
    "bgra16": (2, 4, cv2.COLOR_BGRA2GRAY),
    **{f"bayer_{p}{8 * n}": (n, 1, getattr(cv2, f"COLOR_BAYER_{c}2GRAY")) for p, c in _BAYER.items() for n in (1, 2)},
    **dict.fromkeys(("nv12", "nv21", "nv24", "i420", "yuv420p"), (1, 1, None)),  # brightness first, then the colours
}


class UnknownEncoding(ValueError):
    """An encoding that is not supported: so are all images of the topic."""


def decode_raw(data: bytes, width: int, height: int, step: int, encoding: str, big_endian: bool = False) -> U8 | U16:
    """Pixels of a RawImage in any common encoding -> (H, W) grey with the encoding's depth of eight or sixteen bits.

    Raises:
        UnknownEncoding: not a known one.
        ValueError: impossible size, or too few bytes.
    """
    layout = _ENCODINGS.get(encoding.lower())
    if layout is None:
        raise UnknownEncoding(f"image encoding '{encoding}' is not supported (known: {', '.join(_ENCODINGS)})")
    depth, channels, conversion = layout
    row = width * channels * depth
    step = step or row
    if width * height > MAX_PIXELS:
        raise ValueError(f"an image of {width}x{height} has more than {MAX_PIXELS} pixels")
    if step < row or len(data) < step * (height - 1) + row:
        raise ValueError(f"an image of {width}x{height} {encoding} has only {len(data)} bytes")
    rows = np.frombuffer(data[: step * height].ljust(step * height, b"\0"), np.uint8).reshape(height, step)[:, :row]
    dtype = np.dtype(f"{'>' if big_endian else '<'}u{depth}")
    pixels = np.ascontiguousarray(rows).view(dtype).reshape(height, width, channels)
    pixels = pixels.astype(dtype.newbyteorder("="), copy=conversion is None)
    if conversion is None:
        return pixels[..., 0]
    return cv2.cvtColor(pixels if channels > 1 else pixels[..., 0], conversion).astype(pixels.dtype, copy=False)


def decode_depth(data: bytes, width: int, height: int, step: int, encoding: str) -> F32:
    """Depth image in metres: 32FC1 as it is, 16UC1 in millimetres with 0 for unknown.

    Raises:
        ValueError: another encoding.
    """
    dtypes = {"32fc1": np.dtype("<f4"), "16uc1": np.dtype("<u2"), "mono16": np.dtype("<u2")}
    dtype = dtypes.get(encoding.lower())
    if dtype is None:
        raise UnknownEncoding(f"depth encoding '{encoding}' is not supported (32FC1 or 16UC1)")
    step = step or dtype.itemsize * width
    if step < dtype.itemsize * width or len(data) < step * height:
        raise ValueError(f"a depth image of {width}x{height} {encoding} has only {len(data)} bytes")
    rows = np.frombuffer(data[: step * height], np.uint8).reshape(height, step)[:, : width * dtype.itemsize]
    values = np.ascontiguousarray(rows).view(dtype)
    return _metres(values) if dtype.kind == "u" else values.astype(np.float32)


def without_mosaic(pixels: U8 | U16, encoding: str) -> U8 | U16:
    """(H, W) grey of the pixels behind a colour filter; as they are if the encoding is not one of those (bayer_...)."""
    conversion = _ENCODINGS[encoding][2] if encoding.startswith("bayer_") and encoding in _ENCODINGS else None
    grey: Any = pixels if conversion is None else cv2.cvtColor(pixels, conversion)
    return grey.astype(pixels.dtype, copy=False)


def decode_depth_file(data: bytes, inverse: tuple[float, float] | None = None) -> F32:
    """Bytes of a sixteen-bit PNG in millimetres -> (H, W) metres, NaN for 0.

    Args:
        inverse: a and b of pixels that are a / metres + b, as ROS compresses depth in floats.

    Raises:
        ValueError: not a depth image.
    """
    try:
        image = decode(data, cv2.IMREAD_UNCHANGED)
    except ValueError as error:
        raise ValueError(f"a compressed depth image is not a sixteen-bit PNG: {error}") from None
    if image.dtype != np.uint16 or image.ndim != 2:
        raise ValueError("a compressed depth image is not a sixteen-bit PNG")
    if inverse is None:
        return _metres(image)
    with np.errstate(divide="ignore"):
        metres = np.float32(inverse[0]) / (image - np.float32(inverse[1]))
    return np.where((image > 0) & np.isfinite(metres), metres, np.float32(np.nan))


def _metres(millimetres: np.ndarray[Any, Any]) -> F32:
    out = millimetres.astype(np.float32)
    out[millimetres == 0] = np.nan
    out /= np.float32(1000)
    return out
