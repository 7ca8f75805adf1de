"""The second observation of a point: the right image, or depth turned into a virtual right image."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import TrackerConfig
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.order_statistics import median, percentile
from stereo_sfm.tracking.depth_image import points_from_depth
from stereo_sfm.tracking.flow import klt
from stereo_sfm.tracking.flow.epipolar_gate import LEARNED, PERCENTILE, EpipolarGate
from stereo_sfm.tracking.flow.stereo_cameras import StereoCameras
from stereo_sfm.tracking.flow.stereo_match import search_epipolar, triangulate
from stereo_sfm.tracking.flow.surface import INTERPOLATION, fit_planes
from stereo_sfm.tracking.flow.visible_area import VisibleArea
from stereo_sfm.types import F32, F64, Bool, StereoImage

SEARCH_LEVEL = 1  # of the pyramids, for matches from nowhere: the half image, whose noise averages out
BEHIND_SIGMAS = 4.0  # by which noise may put a far point behind the camera
MIN_SIGMA_PX = 0.07  # of a disparity: least noise
MIN_MISFIT = 0.5  # lower bound of the typical misfit, in squares of the expected noise
# More than these is an edge in depth: the difference of two windows' disparities and the noise of one, over the typical
# noise, and the windows' misfit over the typical one.
EDGE_DIFFERENCE, EDGE_SIGMAS, EDGE_MISFIT = 1.5, 1.8, 8.0
MOST_FAILED = 3.0  # times the limits of the windows' tests, where matches are few


@dataclass
class StereoMatch:
    """Stereo matches; arrays of equal length, rows are usable where `good`."""

    uv_left: F64  # (N, 2) px
    uv_right: F64  # (N, 2) px
    bearing: F64  # (N, 3) unit, left camera
    rho: F64  # (N,) 1/m along the bearing
    variance: F64  # (N,)
    offset: F64  # (N, 2) px from the epipolar curve to the right pixel
    good: Bool  # (N,)


class StereoMatcher:
    """Finds points of the left image in the right one, for any camera model."""

    def __init__(self, config: TrackerConfig, rig: Rig) -> None:
        self._config = config
        self._rig = rig
        self._cameras = StereoCameras.of(rig)
        self._gate = EpipolarGate(config.max_epipolar_px / config.max_error_sigmas, config.max_error_sigmas)
        self._sigma_px, self._matches = INTERPOLATION, 0.0  # noise that is typical of the sequence; of how many matches
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
        self._gate.forget()

    def placed(self, uv: F64, uv_right: F64) -> StereoMatch:
        """Triangulate matched pixels (N, 2), NaN where unmatched, with the present rig."""
        seen = np.asarray(np.isfinite(uv_right).all(1))
        uv, uv_right = np.ascontiguousarray(uv), np.ascontiguousarray(uv_right)
        return self._triangulated(uv, uv_right, self._usual_sigma(uv), seen, gated=False)

    def prepare(self, image: StereoImage) -> klt.Pyramid | F32:
        """The second camera's input of `follow` and `match`: a pyramid, or the depth image."""
        if self._rig.depth:
            assert image.depth is not None
            return image.depth
        assert image.right is not None
        return klt.build_pyramid(image.right, self._config.pyramid_levels)

    def follow(
        self,
        left: klt.Pyramid,
        right: klt.Pyramid | F32,
        uv: F64,
        points: F64,
        predicted: F64,
        offset: F64,
        level: int = 0,
    ) -> F64:
        """Right pixels (N, 2) of tracked points (N, 3) whose left pixels are `uv`, NaN where not found.

        Args:
            predicted: (4, 4) odom_T_cam. offset: (N, 2) px, see `Tracks.right_offset`. level: of the pyramids, from
                which on they are looked for.
        """
        if not isinstance(right, tuple):
            return points_from_depth(self._rig, right, uv)[1]
        points_cam = se3.transform(se3.inverse(predicted), points)
        guess_left = self._rig.left.project(points_cam)
        assert self._rig.right is not None
        guess = self._rig.right.project(se3.transform(self._cameras.right_T_left, points_cam))
        guess += uv - guess_left + offset
        fitted, _, failed = self._on_one_surface(left, right, uv, self._moved(left, right, uv, guess, level))
        fitted[failed >= 1.0] = np.nan
        return fitted

    def match(self, left: klt.Pyramid, right: klt.Pyramid | F32, uv: F64, needed: int = 0) -> StereoMatch:
        """Stereo matches of new corners (N, 2) px.

        The tests of the windows (the match back, a narrower window, a disparity plane, noise) compare with what is
        typical of the sequence. Where fewer than `needed` matches pass, they give way: the next best follow, with
        standard deviations that are larger by as much as they fail. The epipolar curves do not.
        """
        uv = np.ascontiguousarray(uv)
        if isinstance(right, tuple):
            self._right_area.learn(right[1])
            uv_right = self._moved(left, right, uv, self._search(left, right, uv), SEARCH_LEVEL)
            back = self._moved(right, left, uv_right, uv)
            narrow = klt.track_translation(left, right, uv, uv_right, 0, 0, 0.5, 0.3, self._narrow)
            off = np.maximum(np.linalg.norm(back - uv, axis=1), np.linalg.norm(narrow - uv_right, axis=1))
            off[np.isnan(off)] = np.inf
            uv_right, sigma_px, failed = self._on_one_surface(left, right, uv, uv_right, off)
            good = failed < self._gives_way(failed, needed)
            sigma_px = sigma_px * np.clip(failed, 1.0, None)
        else:
            uv_right, sigma_px = points_from_depth(self._rig, right, uv)[1], self._usual_sigma(uv)
            good = np.isfinite(uv_right[:, 0])
        return self._triangulated(uv, uv_right, sigma_px, good, gated=isinstance(right, tuple))  # computed ones fit

    @staticmethod
    def _gives_way(failed: F64, needed: int) -> float:
        """The limit of the tests: 1, or what lets `needed` matches pass that `failed` by (N,), up to MOST_FAILED."""
        ordered = np.sort(failed)
        at = min(needed, len(ordered)) - 1
        return float(np.clip(np.nextafter(ordered[at], np.inf), 1.0, MOST_FAILED)) if at >= 0 else 1.0

    def match_coarse(self, left: klt.Pyramid, right: klt.Pyramid | F32, uv: F64) -> StereoMatch:
        """As `match`, in half the time: accurate to half a pixel, without the test for depth edges."""
        uv = np.ascontiguousarray(uv)
        if not isinstance(right, tuple):
            return self.match(left, right, uv)
        uv_right = self._moved(left, right, uv, self._search(left, right, uv), SEARCH_LEVEL, SEARCH_LEVEL)
        good = np.isfinite(uv_right[:, 0])
        return self._triangulated(uv, uv_right, self._usual_sigma(uv), good, coarse=True)

    def _search(self, left: klt.Pyramid, right: klt.Pyramid, uv: F64) -> F64:
        """Right pixels (N, 2), accurate to a pixel of the search level, NaN without a match."""
        return search_epipolar(
            left[SEARCH_LEVEL], right[SEARCH_LEVEL], uv, 2.0**SEARCH_LEVEL, self._cameras, self._min_depth,
            self._candidates,
        )  # fmt: skip

    def _usual_sigma(self, uv: F64) -> F64:
        """(N,) px along the epipolar curve for matches without an estimate of their own: noise of both images."""
        return np.full(len(uv), math.sqrt(2) * self._config.sigma_px)

    def _triangulated(
        self, uv: F64, uv_right: F64, sigma_px: F64, good: Bool, gated: bool = True, coarse: bool = False
    ) -> StereoMatch:
        """`gated`: whether the matches must be near their epipolar curves, about which the gate learns from them unless
        they are `coarse`. Noise may make the inverse distances of others negative.
        """
        bearing, rho, variance, offset = triangulate(uv, uv_right, self._cameras, sigma_px)
        least = 0.0 if coarse else -BEHIND_SIGMAS
        with np.errstate(invalid="ignore"):
            good = good & (rho > least * np.sqrt(variance)) & (rho < 1.0 / (0.5 * self._min_depth))
        if gated:
            good = self._gate.passed(self._rig, uv, uv_right, good, not coarse)
        return StereoMatch(uv, uv_right, bearing, rho, variance, offset, good)

    def _moved(
        self, before: klt.Pyramid, after: klt.Pyramid, uv: F64, guess: F64, first_level: int = 0, last_level: int = 0
    ) -> F64:
        """Where points (N, 2) px of one image are in another, NaN where not found."""
        return klt.track_translation(
            before, after, np.ascontiguousarray(uv), np.ascontiguousarray(guess), first_level, last_level,
            self._config.min_contrast, self._config.min_ncc, klt.WEIGHTS,
        )  # fmt: skip

    def _on_one_surface(
        self, left: klt.Pyramid, right: klt.Pyramid, uv: F64, uv_right: F64, off: F64 | None = None
    ) -> tuple[F64, F64, F64]:
        """Matches by their disparity planes, their standard deviations in px, and by how much they fail the tests: 1 is
        the limit, inf where there is no plane.

        A match fails by its difference from the match by the plane and by its standard deviation, over the noise that
        is typical of the sequence, and by its window's residual over the typical one: an edge in depth has larger ones.
        `off`: (N,) px, more differences; of new matches, from which is learned.
        """
        fitted, misfit, sigma_px = fit_planes(
            left[0], right[0], np.ascontiguousarray(uv), uv_right, self._cameras, klt.WEIGHTS, klt.COORDINATES
        )
        tested = np.isfinite(misfit)
        if off is not None and tested.any():
            self._learn(sigma_px[tested])
        typical = max(percentile(misfit[tested], PERCENTILE), MIN_MISFIT) if tested.any() else MIN_MISFIT
        off = np.fmax(0.0 if off is None else off, np.linalg.norm(fitted - uv_right, axis=1))
        failed = np.maximum(off / EDGE_DIFFERENCE, sigma_px / EDGE_SIGMAS) / self._sigma_px
        failed = np.maximum(failed, misfit / (EDGE_MISFIT * typical))
        failed[~(tested & self._right_area.inside(uv_right) & np.isfinite(failed))] = np.inf
        return fitted, np.maximum(sigma_px, MIN_SIGMA_PX), failed

    def _learn(self, sigma_px: F64) -> None:
        """The noise that is typical of new matches (N,)."""
        total = self._matches + len(sigma_px)
        self._sigma_px += len(sigma_px) / total * (max(median(sigma_px), INTERPOLATION) - self._sigma_px)
        self._matches = min(total, LEARNED)
