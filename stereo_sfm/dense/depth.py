"""Depth of one view: matching, refinement, means over surfaces, standard deviations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereo_sfm.dense.matching import AGREE_PX, agreeing, match_both_ways
from stereo_sfm.dense.noise import learned_sigmas
from stereo_sfm.dense.refinement import RADIUS, refine
from stereo_sfm.dense.surface_mean import SUPPORT, surface_means
from stereo_sfm.dense.views import PairView
from stereo_sfm.geometry.cameras import Camera
from stereo_sfm.types import F32, F64, U8, ReadOnly


@dataclass(frozen=True, eq=False)
class DepthImage(ReadOnly):
    """Ranges along the rays of a virtual camera at the place of the left camera."""

    camera: Camera
    cam_R_view: F64  # (3, 3) into the left camera
    ranges: F32  # (H, W) metres, NaN where unknown
    sigmas: F32  # (H, W) metres, standard deviations
    grey: U8  # (H, W)

    def points(self) -> F32:
        """(H, W, 3) metres in the left camera."""
        return ((self.camera.bearing_grid() @ self.cam_R_view.T) * self.ranges[..., None]).astype(np.float32)


def disparities(left: U8, right: U8, count: int, step: int = 1) -> tuple[F32, F32]:
    """(H, W) px disparities of a rectified pair and their standard deviations, NaN where unknown.

    Args:
        left, right: (H, W). count: largest disparity plus one, a multiple of 16.
        step: px between the pixels that get a disparity. With 1 the right image's are refined as well, and what agrees
            is kept: fewer gross errors. More is faster by twice its square; other keyframes then tell gross errors.
    """
    start, back = match_both_ways(left, right, count)
    found, predicted = refine(left, right, start, step)
    if step == 1:
        swapped = [np.ascontiguousarray(image[:, ::-1]) for image in (right, left)]
        other = refine(swapped[0], swapped[1], np.ascontiguousarray(back[:, ::-1]))[0]
        other = np.ascontiguousarray(other[:, ::-1])
        found = agreeing(found, other, AGREE_PX)
    predicted = np.where(np.isfinite(found), predicted, np.nan).astype(np.float32)
    single = np.maximum(predicted, learned_sigmas(found, predicted, -(-(2 * RADIUS + 1) // step)))
    found, predicted = surface_means(found, single, step)
    return found, learned_sigmas(found, predicted, -(-SUPPORT // step))


def pair_depth(view: PairView, left: U8, right: U8, step: int = 1) -> DepthImage:
    """Depth of a pair of images of the view's cameras, at every `step`-th pixel of its rows and columns."""
    a, b = view.images(left, right)
    disparity, sigma = disparities(a, b, view.disparities, step)
    disparity[~view.first.mask[::step, ::step]] = np.nan
    coarse, disparity, sigma = view.every(step), disparity / np.float32(step), sigma / np.float32(step)
    ranges, sigmas = coarse.measured(disparity, sigma)
    return DepthImage(coarse.camera, view.cam_R_view, ranges, sigmas, np.ascontiguousarray(a[::step, ::step]))
