"""Binary descriptors of given points: oriented BRIEF (Rublee et al., ORB, ICCV 2011) at the angle of the patch."""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false, reportMissingTypeArgument=false

from __future__ import annotations

import math

import cv2
import numpy as np

from stereo_sfm.geometry.kernels import njit
from stereo_sfm.types import F64, U8

RADIUS = 15  # px, of the disc whose brightness tells the angle, as in OpenCV's ORB
HALF_WIDTHS = np.sqrt(RADIUS**2 - np.arange(-RADIUS, RADIUS + 1) ** 2).astype(np.int32)  # of the disc's rows
BORDER = 19  # px of the image without descriptors: what the turned pattern of pairs reaches


@njit
def _intensity_angles(image, uv):
    """Direction from each point to the centroid of its disc, radians (Rosin 1999, as in ORB)."""
    out = np.zeros(len(uv), np.float32)
    h, w = image.shape
    for k in range(len(uv)):
        u, v = int(round(uv[k, 0])), int(round(uv[k, 1]))
        if u < RADIUS or v < RADIUS or u >= w - RADIUS or v >= h - RADIUS:
            continue
        m10, m01 = np.int32(0), np.int32(0)
        for dy in range(-RADIUS, RADIUS + 1):
            half = HALF_WIDTHS[dy + RADIUS]
            row = image[v + dy, u - half : u + half + 1]
            total, moment = np.int32(0), np.int32(0)
            for x in range(2 * half + 1):
                total += np.int32(row[x])
                moment += np.int32(x) * np.int32(row[x])
            m10 += moment - half * total
            m01 += np.int32(dy) * total
        out[k] = math.atan2(m01, m10)
    return out


def describe(image: U8, uv: F64) -> U8:
    """(N, 32) descriptors of points (N, 2) px; zero rows too near to the border."""
    descriptors = np.zeros((len(uv), 32), np.uint8)
    pixel = np.rint(uv.astype(np.float32))  # as OpenCV rounds where it drops points at the border
    inside = np.flatnonzero(((pixel >= BORDER) & (pixel < np.array(image.shape[::-1]) - BORDER)).all(1))
    if len(inside) == 0:
        return descriptors
    kept = np.ascontiguousarray(uv[inside])
    orb = cv2.ORB.create(nlevels=1, edgeThreshold=BORDER, patchSize=2 * RADIUS + 1)
    keypoints = cv2.KeyPoint.convert(kept.astype(np.float32), 2 * RADIUS + 1)  # pyright: ignore[reportArgumentType, reportCallIssue]
    for keypoint, angle in zip(keypoints, (np.degrees(_intensity_angles(image, kept)) % 360.0).tolist(), strict=True):
        keypoint.angle = angle
    computed, rows = orb.compute(image, keypoints)
    assert len(computed) == len(inside)
    descriptors[inside] = rows
    return descriptors
