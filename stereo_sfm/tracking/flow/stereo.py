"""The second observation of a point: the right image, or depth turned into a virtual right image."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import TrackerConfig
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.order_statistics import percentile
from stereo_sfm.tracking.depth_image import points_from_depth
from stereo_sfm.tracking.flow import klt
from stereo_sfm.tracking.flow.epipolar_gate import on_curve
from stereo_sfm.tracking.flow.stereo_cameras import StereoCameras
from stereo_sfm.tracking.flow.stereo_match import patch_sums, search_epipolar, triangulate
from stereo_sfm.tracking.flow.surface import fit_planes
from stereo_sfm.tracking.flow.visible_area import VisibleArea
from stereo_sfm.types import F32, F64, Bool, StereoImage

SEARCH_LEVEL = 1
BEHIND_SIGMAS = 4.0  # by which noise may put a far point behind the camera
MIN_SIGMA_PX, MAX_SIGMA_PX = 0.07, 0.3  # of a disparity: least noise, and limit of acceptance
TYPICAL = 25  # percentile of the points' misfits that is typical of windows on one surface
MIN_MISFIT = 0.5  # lower bound of the typical misfit, in squares of the expected noise


@dataclass
class StereoMatch:
    """Stereo matches; arrays of equal length, rows are usable where `good`."""

    uv_left: F64  # (N, 2) px
    uv_right: F64  # (N, 2) px
    bearing: F64  # (N, 3) unit, left camera
    rho: F64  # (N,) 1/m along the bearing
    variance: F64  # (N,)
    good: Bool  # (N,)


class StereoMatcher:
    """Finds points of the left image in the right one, for any camera model."""

    def __init__(self, config: TrackerConfig, rig: Rig) -> None:
        self._config = config
        self._rig = rig
        self._cameras = StereoCameras.of(rig)
        assert rig.right is not None
        self._right_area = VisibleArea(rig.right, config.max_angle_deg, rig.right_mask)
        self._min_depth = config.min_depth_baselines * rig.baseline
        reach = rig.left.fx / config.min_depth_baselines
        self._candidates = int(np.clip(reach / 2**SEARCH_LEVEL * 1.2, 16, 160))
        narrow = np.sqrt(np.maximum(klt.WEIGHTS, 0)) ** 5  # the same Gaussian, about 0.63 times as wide
        self._narrow = (narrow / narrow.sum()).astype(np.float32)

    def use(self, rig: Rig) -> None:
        """Use another rig, whose left camera and baseline are about the same."""
        self._rig, self._cameras = rig, StereoCameras.of(rig)

    def placed(self, uv: F64, uv_right: F64) -> StereoMatch:
        """Triangulate matched pixels (N, 2), NaN where unmatched, with the present rig."""
        seen = np.asarray(np.isfinite(uv_right).all(1))
        uv, uv_right = np.ascontiguousarray(uv), np.ascontiguousarray(uv_right)
        return self._triangulated(uv, uv_right, self._usual_sigma(uv), seen, np.inf, -BEHIND_SIGMAS)

    def prepare(self, image: StereoImage) -> klt.Pyramid | F32:
        """The second camera's input of `follow` and `match`: a pyramid, or the depth image."""
        if self._rig.depth:
            assert image.depth is not None
            return image.depth
        assert image.right is not None
        return klt.build_pyramid(image.right, self._config.pyramid_levels)

    def follow(self, left: klt.Pyramid, right: klt.Pyramid | F32, uv: F64, points: F64, predicted: F64) -> F64:
        """Right pixels (N, 2) of tracked points (N, 3) whose left pixels are `uv`, NaN where not found."""
        if not isinstance(right, tuple):
            return self._from_depth(right, uv)[0]
        points_cam = se3.transform(se3.inverse(predicted), points)
        guess_left = self._rig.left.project(points_cam)
        assert self._rig.right is not None
        guess = self._rig.right.project(se3.transform(self._cameras.right_T_left, points_cam)) + uv - guess_left
        return self._on_one_surface(left, right, uv, self._refine(left, right, uv, guess, 0))[0]

    def match(self, left: klt.Pyramid, right: klt.Pyramid | F32, uv: F64) -> StereoMatch:
        """Stereo matches of new corners (N, 2) px."""
        config = self._config
        uv = np.ascontiguousarray(uv)
        if isinstance(right, tuple):
            self._right_area.learn(right[1])
            uv_right = self._refine(left, right, uv, self._search(left, right, uv), 1)
            back = uv.copy()
            status, _ = klt.track_translation(
                right, left, np.nan_to_num(uv_right, nan=-1e3), back, 0, 0, 10, config.min_contrast, config.min_ncc,
                klt.WEIGHTS,
            )  # fmt: skip
            good = (status == klt.TRACKED) & (np.linalg.norm(back - uv, axis=1) < 0.5)
            good &= self._narrow_agrees(left, right, uv, uv_right)
            uv_right, sigma_px = self._on_one_surface(left, right, uv, uv_right)
            good &= np.isfinite(uv_right[:, 0])
        else:
            uv_right, good = self._from_depth(right, uv)
            sigma_px = self._usual_sigma(uv)
        return self._triangulated(uv, uv_right, sigma_px, good, config.max_epipolar_px, -BEHIND_SIGMAS)

    def match_coarse(self, left: klt.Pyramid, right: klt.Pyramid | F32, uv: F64) -> StereoMatch:
        """As `match`, in half the time: accurate to half a pixel, without the test for depth edges."""
        uv = np.ascontiguousarray(uv)
        if not isinstance(right, tuple):
            return self.match(left, right, uv)
        uv_right = self._search(left, right, uv)
        status, _ = klt.track_translation(
            left, right, uv, uv_right, SEARCH_LEVEL, SEARCH_LEVEL, 10, self._config.min_contrast, self._config.min_ncc,
            klt.WEIGHTS,
        )  # fmt: skip
        sigma_px, good = self._usual_sigma(uv), status == klt.TRACKED
        return self._triangulated(uv, uv_right, sigma_px, good, 2 * self._config.max_epipolar_px, 0.0)

    def _search(self, left: klt.Pyramid, right: klt.Pyramid, uv: F64) -> F64:
        """Right pixels (N, 2), accurate to a pixel of the search level, NaN without a match."""
        return search_epipolar(
            left[SEARCH_LEVEL], right[SEARCH_LEVEL], patch_sums(right[SEARCH_LEVEL]), uv, 2.0**SEARCH_LEVEL,
            *self._cameras.cams, self._cameras.right_T_left, self._min_depth, self._candidates, 25.0, 1.2,
        )  # fmt: skip

    def _usual_sigma(self, uv: F64) -> F64:
        """(N,) px along the epipolar curve for matches without an estimate of their own: noise of both images."""
        return np.full(len(uv), math.sqrt(2) * self._config.sigma_px)

    def _triangulated(
        self, uv: F64, uv_right: F64, sigma_px: F64, good: Bool, max_epipolar_px: float, min_rho_sigmas: float
    ) -> StereoMatch:
        """`min_rho_sigmas`: smallest inverse distance in its standard deviations; noise may make it negative."""
        bearing, rho, variance, epipolar = triangulate(
            uv, uv_right, *self._cameras.cams, self._cameras.left_T_right, sigma_px
        )
        with np.errstate(invalid="ignore"):
            good &= on_curve(self._rig, uv, uv_right, epipolar, max_epipolar_px, good) & (
                rho > min_rho_sigmas * np.sqrt(variance)
            )
            good &= rho < 1.0 / (0.5 * self._min_depth)
        return StereoMatch(uv, uv_right, bearing, rho, variance, good)

    def _refine(self, left: klt.Pyramid, right: klt.Pyramid, uv: F64, guess: F64, level: int) -> F64:
        out = np.ascontiguousarray(guess)
        status, _ = klt.track_translation(
            left, right, np.ascontiguousarray(uv), out, level, 0, 10, self._config.min_contrast, self._config.min_ncc,
            klt.WEIGHTS,
        )  # fmt: skip
        out[status != klt.TRACKED] = np.nan
        return out

    def _narrow_agrees(self, left: klt.Pyramid, right: klt.Pyramid, uv: F64, uv_right: F64) -> Bool:
        """Whether a narrower window gives the same disparity."""
        narrow = np.nan_to_num(uv_right, nan=-1e3)
        status, _ = klt.track_translation(left, right, uv, narrow, 0, 0, 10, 0.5, 0.3, self._narrow)
        with np.errstate(invalid="ignore"):
            near = np.linalg.norm(narrow - uv_right, axis=1) < self._config.max_window_disparity_px
        return (status == klt.TRACKED) & near

    def _on_one_surface(self, left: klt.Pyramid, right: klt.Pyramid, uv: F64, uv_right: F64) -> tuple[F64, F64]:
        """Matches by their disparity planes, and their standard deviations in px.

        NaN where a window's residual is much larger than typical, where the match by the plane differs from that of the
        window, or where its standard deviation is too large.
        """
        fitted, misfit, sigma_px = fit_planes(
            left[0], right[0], np.ascontiguousarray(uv), uv_right, *self._cameras.cams[2:], self._cameras.right_T_left,
            klt.WEIGHTS, klt.COORDINATES,
        )  # fmt: skip
        tested = np.isfinite(misfit)
        typical = max(percentile(misfit[tested], TYPICAL), MIN_MISFIT) if tested.any() else MIN_MISFIT
        with np.errstate(invalid="ignore"):
            good = np.linalg.norm(fitted - uv_right, axis=1) < self._config.max_window_disparity_px
        good &= (misfit < self._config.max_surface_misfit * typical) & (sigma_px < MAX_SIGMA_PX)
        good &= self._right_area.inside(uv_right)
        fitted[~good] = np.nan
        return fitted, np.maximum(sigma_px, MIN_SIGMA_PX)

    def _from_depth(self, depth: F32, uv: F64) -> tuple[F64, Bool]:
        """Virtual right pixels from a depth image, NaN at holes and edges, and where they are finite."""
        uv_right = points_from_depth(self._rig, depth, uv)[1]
        return uv_right, np.isfinite(uv_right[:, 0])
