"""Images from a caller: converted to what the stages take, or rejected with a one-line error.

The stages take (H, W) 8-bit grey images of the calibration's size, contiguous in memory. A caller may also hand over
colour in OpenCV's order (blue, green, red), 16-bit grey, and floats from 0 to 1 or from 0 to 255.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereo_sfm.calib.rig import Rig
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry.cameras import Camera
from stereo_sfm.pixels import BitsSoFar, eight_bits
from stereo_sfm.types import F32, U8, ImuSamples, StereoImage, WheelSamples


class ImageInput:
    """Converts successive images; the white level of 16-bit and float images is determined from them."""

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self._bits = BitsSoFar()
        self._white = 0.0  # of floats: 1 or 255; 0 before the first
        self._last_ns: int | None = None
        self._count = 0

    def image(
        self,
        left: ArrayLike,
        right: ArrayLike | None,
        stamp_ns: int,
        depth: ArrayLike | None = None,
        imu: ImuSamples | None = None,
        wheel: WheelSamples | None = None,
    ) -> StereoImage:
        """The next image of a sequence, numbered in order.

        Args:
            left, right: of the rig's two cameras; `right` is None for one camera and for RGB-D.
            stamp_ns: whole nanoseconds, later than the last.
            depth: (H, W) metres along the left optical axis, NaN or 0 where unknown (RGB-D).
            imu, wheel: samples since the image before.

        Raises:
            StereoSfmError: not an image of this rig, or a stamp that is not later than the last.
        """
        pixels = _array(left, "left"), _optional(right), _metres(depth)
        image = self.checked(StereoImage(self._count, self._later(stamp_ns), *pixels, imu=imu, wheel=wheel))
        self._last_ns = image.stamp_ns
        self._count += 1
        return image

    def checked(self, image: StereoImage) -> StereoImage:
        """An image of any source with pixels as the stages take them; the same object if they already are.

        Raises:
            StereoSfmError: not an image of this rig.
        """
        rig = self._rig
        if rig.second_camera is not None and image.right is None:
            raise StereoSfmError(f"frame {image.frame_id} has no right image, but the calibration is for two cameras")
        if rig.depth and image.depth is None:
            raise StereoSfmError(
                f"frame {image.frame_id} has no depth image, but the calibration is for an RGB-D camera"
            )
        left = self._grey(image.left, rig.left, "left")
        right = None if image.right is None or rig.right is None else self._grey(image.right, rig.right, "right")
        if image.depth is not None:
            _check_size(image.depth, rig.left, "depth")
        same = left is image.left and right is image.right
        return image if same else replace(image, left=left, right=right)

    def _later(self, stamp_ns: Any) -> int:
        if isinstance(stamp_ns, bool) or not isinstance(stamp_ns, int | np.integer):
            raise StereoSfmError(f"stamp_ns takes whole nanoseconds, got {stamp_ns!r}: multiply seconds by 1e9")
        if self._last_ns is not None and stamp_ns <= self._last_ns:
            raise StereoSfmError(f"stamp_ns is {stamp_ns}, not later than the last one, {self._last_ns}")
        return int(stamp_ns)  # pyright: ignore[reportUnknownArgumentType]

    def _grey(self, pixels: NDArray[Any], camera: Camera, side: str) -> U8:
        """(H, W) or (H, W, channels) of any meaningful kind -> (H, W) u8, contiguous."""
        if pixels.dtype == np.uint8 and pixels.ndim == 2 and pixels.flags.c_contiguous:
            _check_size(pixels, camera, side)
            return pixels
        if pixels.ndim not in (2, 3) or (pixels.ndim == 3 and pixels.shape[2] not in (1, 3, 4)):
            raise StereoSfmError(
                f"the {side} image has the shape {pixels.shape}: expected (H, W) grey or (H, W, 3) colour"
            )
        _check_size(pixels, camera, side)
        grey = self._in_bytes(pixels, side)
        if grey.ndim == 3:
            codes = {3: cv2.COLOR_BGR2GRAY, 4: cv2.COLOR_BGRA2GRAY}
            code = codes.get(grey.shape[2])
            grey = grey[..., 0] if code is None else cv2.cvtColor(grey, code)
        return np.ascontiguousarray(grey, np.uint8)

    def _in_bytes(self, pixels: NDArray[Any], side: str) -> U8:
        if pixels.dtype == np.uint8:
            return np.ascontiguousarray(pixels)
        if pixels.dtype == np.uint16:
            return eight_bits(np.ascontiguousarray(pixels), self._bits.including([pixels]))
        if np.issubdtype(pixels.dtype, np.floating):
            return self._of_floats(pixels, side)
        raise StereoSfmError(f"the {side} image has {pixels.dtype} pixels: expected uint8, uint16 or floats")

    def _of_floats(self, pixels: NDArray[Any], side: str) -> U8:
        low, high = float(pixels.min()), float(pixels.max())
        if not (np.isfinite(low) and np.isfinite(high)):
            raise StereoSfmError(f"the {side} image contains values that are not finite")
        if not self._white:
            self._white = 1.0 if high <= 1.0 else 255.0
        if low < 0 or high > self._white:
            raise StereoSfmError(
                f"the {side} image has values from {low:g} to {high:g}: expected 0 to {self._white:g} as in the first"
            )
        return np.round(pixels * (255.0 / self._white)).astype(np.uint8)


def _array(pixels: ArrayLike, side: str) -> NDArray[Any]:
    try:
        return np.array(pixels)  # a copy: the caller may write the next image into its own
    except (ValueError, TypeError):
        raise StereoSfmError(f"the {side} image is not an array of numbers") from None


def _optional(right: ArrayLike | None) -> NDArray[Any] | None:
    return None if right is None else _array(right, "right")


def _metres(depth: ArrayLike | None) -> F32 | None:
    """(H, W) metres, NaN where 0 or negative."""
    if depth is None:
        return None
    pixels = _array(depth, "depth")
    if not np.issubdtype(pixels.dtype, np.floating):
        raise StereoSfmError(f"the depth image has {pixels.dtype} pixels: expected floats in metres")
    metres = np.ascontiguousarray(pixels, np.float32)
    return np.where(metres > 0, metres, np.float32(np.nan))


def _check_size(pixels: NDArray[Any], camera: Camera, side: str) -> None:
    height, width = pixels.shape[:2]
    if (width, height) != (camera.width, camera.height):
        raise StereoSfmError(
            f"the {side} image is {width}x{height}, but the calibration is for {camera.width}x{camera.height}"
        )
