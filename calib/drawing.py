"""Drawing of a rectified pair side by side with epipolar lines and row errors in colour."""

from __future__ import annotations

from typing import Any

import numpy as np

from stereo_sfm.calib.matches import Matches
from stereo_sfm.types import U8


def side_by_side(left: U8, right: U8, matches: Matches | None = None, line_every: int = 0) -> U8:
    """Both rectified images with common row lines, and the matches coloured by row error.

    Args:
        left: (H, W). right: (H, W).
        matches: drawn as dots: green below half a pixel of row error, yellow below one, red above.
        line_every: rows between the lines; 0: about sixteen lines.

    Returns:
        (H, 2 W + gap, 3) BGR.
    """
    import cv2

    height, width = left.shape
    gap = 4
    canvas: Any = np.zeros((height, 2 * width + gap, 3), np.uint8)
    canvas[:, :width], canvas[:, width + gap :] = left[..., None], right[..., None]
    step = line_every or max(16, height // 16)
    for i, row in enumerate(range(step // 2, height, step)):
        colour = ((255, 180, 60), (90, 200, 255), (200, 255, 120))[i % 3]
        cv2.line(canvas, (0, row), (canvas.shape[1] - 1, row), colour, 1)
    if matches is not None:
        radius = max(2, height // 240)
        for a, b, error in zip(matches.left, matches.right, np.abs(matches.row_error), strict=True):
            colour = (80, 220, 60) if error < 0.5 else (40, 210, 240) if error < 1 else (50, 50, 255)
            cv2.circle(canvas, (round(a[0]), round(a[1])), radius, colour, -1, cv2.LINE_AA)
            cv2.circle(canvas, (round(b[0]) + width + gap, round(b[1])), radius, colour, -1, cv2.LINE_AA)
    return canvas


def encode_jpeg(image: U8, quality: int = 85) -> bytes:
    """JPEG bytes of an image."""
    import cv2

    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return data.tobytes()
