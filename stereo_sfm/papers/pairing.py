"""Matching of views by descriptors: input of the estimators, and ids carried over from the last keyframe."""

from __future__ import annotations

import numpy as np

from stereo_sfm.config import FeaturesConfig
from stereo_sfm.geometry.motion_only import bearing_errors
from stereo_sfm.papers.extraction import feature_kind
from stereo_sfm.papers.feature_view import FeatureView
from stereo_sfm.papers.matching import epipolar_inliers, match_features
from stereo_sfm.papers.motion_estimator import FramePair
from stereo_sfm.papers.point_ids import PointIds
from stereo_sfm.types import F64, I64

_RECOVER_PX = 4.0  # how near a keyframe's point must reproject to be taken for the same point


class Pairing:
    """Matching policy of one configuration."""

    def __init__(self, config: FeaturesConfig, pixel_rad: float) -> None:
        """`pixel_rad`: angle of a pixel at the image centre."""
        self._config = config
        self._norm = feature_kind(config.kind).norm
        self._pixel = pixel_rad

    def match(self, reference: FeatureView, view: FeatureView, rng: np.random.Generator) -> I64:
        """(M, 2) rows of both views; by configuration only those that agree with one epipolar geometry."""
        config = self._config
        rows = match_features(reference.features, view.features, self._norm, config.ratio)
        a, b = reference.bearings[rows[:, 0]], view.bearings[rows[:, 1]]
        if not config.motion_check:
            return rows
        return rows[epipolar_inliers(a, b, 2 * config.epipolar_px * self._pixel, rng)]

    def pair(self, reference: FeatureView, view: FeatureView, rows: I64) -> FramePair:
        """Matched rows (M, 2) as input of the estimators."""
        a, b = rows[:, 0], rows[:, 1]
        return FramePair(
            bearings_last=reference.bearings[a],
            bearings_now=view.bearings[b],
            points_last=reference.points[a],
            points_now=view.points[b],
            sigmas_last=reference.sigmas[a],
            sigmas_now=view.sigmas[b],
            pixel_rad=self._pixel,
            image_last=reference.image,
            image_now=view.image,
            frame_id_last=reference.frame_id,
            frame_id_now=view.frame_id,
        )

    def recover(self, keyframe: FeatureView, view: FeatureView, now_T_kf: F64, ids: PointIds) -> FeatureView:
        """Ids for points of the last keyframe that were missed in between: descriptor and position agree.

        Args:
            now_T_kf: (4, 4) by the motion just estimated.
        """
        free_kf = ~np.isin(ids.current(keyframe.ids), view.ids) & np.isfinite(keyframe.points[:, 2])
        free_now = view.ids < 0
        rows = match_features(
            keyframe.features.rows(free_kf), view.features.rows(free_now), self._norm, self._config.ratio
        )
        rows = np.stack([np.flatnonzero(free_kf)[rows[:, 0]], np.flatnonzero(free_now)[rows[:, 1]]], axis=1)
        if len(rows) == 0:
            return view
        errors = bearing_errors(now_T_kf, keyframe.points[rows[:, 0]], view.bearings[rows[:, 1]])
        return ids.inherit(view, keyframe, rows[errors < _RECOVER_PX * self._pixel])
