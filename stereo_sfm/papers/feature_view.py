"""Features of one image with bearings and, where a second camera or a depth image sees them, 3D points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereo_sfm.calib.mask import uncovered
from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import FeaturesConfig
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.stereo import triangulate
from stereo_sfm.geometry.two_view import epipolar_residuals, essential_from_motion
from stereo_sfm.papers.extraction import Extractor, Features, feature_kind
from stereo_sfm.papers.matching import epipolar_inliers, match_features
from stereo_sfm.tracking.depth_image import points_from_depth
from stereo_sfm.tracking.descriptors import RADIUS
from stereo_sfm.types import F64, I32, I64, U8, Bool, Message, StereoImage


@dataclass(frozen=True, eq=False)
class FeatureView(Message):
    """Features of the left image of one frame, one row each."""

    frame_id: int
    image: U8
    features: Features
    bearings: F64  # (N, 3)
    uv_right: F64  # (N, 2) px, NaN where unseen
    points: F64  # (N, 3) metres, NaN where unknown
    sigmas: F64  # (N,) metres, standard deviation of the range, NaN where unknown
    ids: I64  # (N,) point ids, -1 where none was given yet
    ages: I32  # (N,) frames since the point was first seen

    def __len__(self) -> int:
        return len(self.bearings)


class ViewMaker:
    """Extraction, stereo matching and triangulation."""

    def __init__(self, config: FeaturesConfig, rig: Rig) -> None:
        self._config = config
        self._rig = rig
        self._left = Extractor(config)
        self._masks = _kept(rig.left_mask), _kept(rig.right_mask)
        self._norm = feature_kind(config.kind).norm
        self._threshold = config.epipolar_px * rig.pixel_angle
        right_T_left = se3.inverse(rig.left_T_right)
        self._essential = essential_from_motion(right_T_left[:3, :3], right_T_left[:3, 3]) if rig.stereo else None

    def make(self, image: StereoImage, mask: U8 | None, rng: np.random.Generator) -> FeatureView:
        """Features of the left image; with stereo only those matched in the right one (retail paper, IV-A3)."""
        features = self._left.extract(image.left, _both(self._masks[0], mask))
        bearings = self._rig.left.unproject(features.uv)
        seen = np.isfinite(bearings[:, 2])
        features, bearings = features.rows(seen), bearings[seen]
        points, right = np.full((len(features), 3), np.nan), np.full((len(features), 2), np.nan)
        if image.depth is not None:
            points, right = points_from_depth(self._rig, image.depth, features.uv)
        elif image.right is not None and self._rig.right is not None:
            points, right = self._stereo(image.right, features, bearings, rng)
        if self._rig.stereo and self._config.stereo_only:
            known = np.isfinite(points[:, 2])
            features, bearings, points, right = features.rows(known), bearings[known], points[known], right[known]
        sigmas = self._rig.range_sigmas(points, 1.0) if self._rig.stereo else np.full(len(features), np.nan)
        ids, ages = np.full(len(features), -1, np.int64), np.zeros(len(features), np.int32)
        return FeatureView(image.frame_id, image.left, features, bearings, right, points, sigmas, ids, ages)

    def _stereo(self, right_image: U8, features: Features, bearings: F64, rng: np.random.Generator) -> tuple[F64, F64]:
        """(N, 3) points and (N, 2) right pixels, NaN where unmatched."""
        assert self._rig.right is not None
        points, uv_right = np.full((len(features), 3), np.nan), np.full((len(features), 2), np.nan)
        other = self._left.extract(right_image, self._masks[1])
        matches = match_features(features, other, self._norm, self._config.ratio)
        other_bearings = self._rig.right.unproject(other.uv)
        matches = matches[np.isfinite(other_bearings[matches[:, 1], 2])]
        a, b = bearings[matches[:, 0]], other_bearings[matches[:, 1]]
        matches = matches[self._agree(a, b, rng)]
        a, b = bearings[matches[:, 0]], other_bearings[matches[:, 1]]
        found = triangulate(a, b, self._rig.left_T_right)
        turned = b @ self._rig.left_T_right[:3, :3].T
        # Below a disparity of half a pixel the depth is treated as unknown.
        enough = np.linalg.norm(np.cross(a, turned), axis=1) > 0.5 * self._rig.pixel_angle
        keep = enough & np.isfinite(found[:, 2])
        points[matches[keep, 0]] = found[keep]
        uv_right[matches[keep, 0]] = other.uv[matches[keep, 1]]
        return points, uv_right

    def _agree(self, a: F64, b: F64, rng: np.random.Generator) -> Bool:
        if self._config.stereo_check == "ransac" or self._essential is None:
            return epipolar_inliers(a, b, self._threshold, rng)
        return epipolar_residuals(self._essential[None], a, b)[0] <= self._threshold


def _kept(mask: Bool | None) -> U8 | None:
    """A camera's mask as OpenCV's detectors want it: no keypoint whose patch touches what is not used."""
    return None if mask is None else uncovered(mask, RADIUS).astype(np.uint8)


def _both(a: U8 | None, b: U8 | None) -> U8 | None:
    return a if b is None else b if a is None else np.where(a > 0, b, 0).astype(np.uint8)
