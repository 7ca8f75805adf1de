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
            for dx in range(-RADIUS, RADIUS + 1):
                if dx * dx + dy * dy <= RADIUS * RADIUS:
                    value = int(image[v + dy, u + dx])
                    m10 += dx * value
                    m01 += dy * value
        out[k] = math.atan2(m01, m10)
    return out


def describe(image: U8, uv: F64) -> U8:
    """(N, 32) descriptors of points (N, 2) px; zero rows too near to the border."""
    descriptors = np.zeros((len(uv), 32), np.uint8)
    if len(uv) == 0:
        return descriptors
    angles = _intensity_angles(image, np.ascontiguousarray(uv))
    orb = cv2.ORB.create(nlevels=1, edgeThreshold=BORDER, patchSize=PATCH_SIZE)
    keypoints = [
        cv2.KeyPoint(float(u), float(v), float(PATCH_SIZE), math.degrees(a) % 360.0, 1.0, 0, k)
        for k, ((u, v), a) in enumerate(zip(uv, angles, strict=True))
    ]
    kept, rows = orb.compute(image, keypoints)
    if len(kept):
        descriptors[[kp.class_id for kp in kept]] = rows
    return descriptors
