"""Keypoints and descriptors: ORB, SIFT and AKAZE behind one function, with the thesis's keypoint mask."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from stereo_sfm.config import FeaturesConfig
from stereo_sfm.errors import one_of
from stereo_sfm.types import F32, F64, U8, Bool, Message


@dataclass(frozen=True, eq=False)
class Features(Message):
    """Keypoints of one image, in the detector's order."""

    uv: F64  # (N, 2) px
    descriptors: U8 | F32  # (N, D): bits in bytes (ORB, AKAZE) or floats (SIFT)

    def __len__(self) -> int:
        return len(self.uv)

    def rows(self, rows: Bool) -> Features:
        """Only some rows."""
        return Features(self.uv[rows], self.descriptors[rows])


@dataclass(frozen=True)
class FeatureKind:
    """One row of the table: how to make the detector, and how its descriptors are compared."""

    create: Callable[[int], Any]  # maximum of keypoints (0: OpenCV's default) -> cv2.Feature2D
    norm: int  # cv2.NORM_*
    width: int  # descriptor length

    def empty(self) -> U8 | F32:
        """(0, width) descriptors."""
        return (
            np.zeros((0, self.width), np.uint8)
            if self.norm == cv2.NORM_HAMMING
            else np.zeros((0, self.width), np.float32)
        )


# The thesis compares all of them by l2; binary descriptors are compared by Hamming distance here, as they are meant to.
TABLE: dict[str, FeatureKind] = {
    "orb": FeatureKind(lambda count: cv2.ORB.create(count or 500), cv2.NORM_HAMMING, 32),
    "sift": FeatureKind(lambda count: cv2.SIFT.create(count), cv2.NORM_L2, 128),
    "akaze": FeatureKind(lambda count: cv2.AKAZE.create(max_points=count or -1), cv2.NORM_HAMMING, 61),
}


def feature_kind(name: str) -> FeatureKind:
    """Row of the table.

    Raises:
        StereoSfmError: unknown name.
    """
    return TABLE[one_of(name, TABLE, "features")]


class Extractor:
    """Detects and describes; one object per tracker."""

    def __init__(self, config: FeaturesConfig) -> None:
        self._kind = feature_kind(config.kind)
        self._detector = self._kind.create(config.count)

    def extract(self, image: U8, mask: U8 | None = None) -> Features:
        """Image (H, W), mask (H, W) non-zero where to look -> features, one per position and orientation."""
        keypoints, descriptors = self._detector.detectAndCompute(image, mask)
        if not keypoints:
            return Features(np.zeros((0, 2)), self._kind.empty())
        uv = np.array([k.pt for k in keypoints], np.float64)
        return Features(uv, descriptors)


def circle_mask(shape: tuple[int, int], centres: F64, radius_px: float) -> U8:
    """(H, W) mask that is 255 within `radius_px` of any of the (N, 2) centres (thesis, section IV-A2)."""
    mask = np.zeros(shape, np.uint8)
    for u, v in np.rint(centres).astype(int):
        cv2.circle(mask, (int(u), int(v)), round(radius_px), 255, -1)
    return mask
