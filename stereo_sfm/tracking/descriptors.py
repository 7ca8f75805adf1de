"""Binary descriptors of given points: oriented BRIEF (Rublee et al., ORB, ICCV 2011) at the angle of the patch."""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false, reportMissingTypeArgument=false

from __future__ import annotations

import math

import cv2
import numpy as np

from stereo_sfm.geometry.kernels import njit
from stereo_sfm.types import F64, U8

PATCH_SIZE = 31
RADIUS = 15
HALF_WIDTHS = np.sqrt(RADIUS**2 - np.arange(-RADIUS, RADIUS + 1) ** 2).astype(np.int64)  # of the disc's rows
BORDER = 19  # of the image, where no descriptor is computed


@njit
def _intensity_angles(image, uv):
    """Direction from each point to the centroid of its disc, radians (Rosin 1999, as in ORB)."""
    out = np.zeros(len(uv), np.float32)
    h, w = image.shape
    for k in range(len(uv)):
        u, v = int(round(uv[k, 0])), int(round(uv[k, 1]))
        if u < RADIUS or v < RADIUS or u >= w - RADIUS or v >= h - RADIUS:
            continue
        m10, m01 = 0, 0
        for dy in range(-RADIUS, RADIUS + 1):
            half, total = HALF_WIDTHS[dy + RADIUS], 0
            for dx in range(-half, half + 1):
                value = int(image[v + dy, u + dx])
                m10 += dx * value
                total += value
            m01 += dy * total
        out[k] = math.atan2(m01, m10)
    return out


def describe(image: U8, uv: F64) -> U8:
    """(N, 32) descriptors of points (N, 2) px; zero rows too near to the border."""
    descriptors = np.zeros((len(uv), 32), np.uint8)
    if len(uv) == 0:
        return descriptors
    angles = np.degrees(_intensity_angles(image, np.ascontiguousarray(uv))) % 360.0
    orb = cv2.ORB.create(nlevels=1, edgeThreshold=BORDER, patchSize=PATCH_SIZE)
    points = uv.astype(np.float32)
    keypoints = cv2.KeyPoint.convert(points, PATCH_SIZE)  # pyright: ignore[reportArgumentType, reportCallIssue]
    for row, (keypoint, angle) in enumerate(zip(keypoints, angles.tolist(), strict=True)):
        keypoint.angle, keypoint.class_id = angle, row
    kept, rows = orb.compute(image, keypoints)
    if len(kept):
        descriptors[[keypoint.class_id for keypoint in kept]] = rows
    return descriptors
