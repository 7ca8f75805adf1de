"""Corners for place recognition: ORB features of the image, tracked or not, with their stereo depth.

Tracked points were detected in the image of their first observation; only one in eight of them is detected again when
the place is revisited. Place recognition therefore has corners of its own, detected in keyframes whose view differs
enough from the newest one with corners (`Keyframes`). A point may be a corner on several levels of the scale pyramid,
for matching from other distances.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from stereo_sfm.calib.mask import half_size, uncovered
from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import Config, TrackerConfig
from stereo_sfm.tracking.descriptors import RADIUS
from stereo_sfm.tracking.flow.corners import corner_mask
from stereo_sfm.tracking.flow.klt import Pyramid, build_pyramid
from stereo_sfm.tracking.flow.stereo import StereoMatcher
from stereo_sfm.types import F32, F64, U8, Corners, StereoImage

LEVELS, SCALE = 4, 1.2  # of ORB in the half image; more levels add few matches
FAST_THRESHOLD = 10  # grey levels


class StereoOrb:
    """Oriented FAST with rotated BRIEF (Rublee et al., ORB, ICCV 2011), of corners that both cameras see."""

    def __init__(self, config: TrackerConfig, rig: Rig, count: int) -> None:
        self._stereo = StereoMatcher(config, rig)
        self._orb = cv2.ORB.create(count, SCALE, LEVELS, edgeThreshold=RADIUS, fastThreshold=FAST_THRESHOLD)

    def use(self, rig: Rig) -> None:
        """Use another rig."""
        self._stereo.use(rig)

    def prepare(self, image: StereoImage) -> Pyramid | F32:
        """The second camera's input of `find`: see `StereoMatcher.prepare`."""
        return self._stereo.prepare(image)

    def find(
        self, view: U8, mask: U8 | None, pixels: Callable[[F64], F64], left: Pyramid, right: Pyramid | F32
    ) -> Corners:
        """The strongest corners of each level of a view, about as many as configured, that have a match.

        Args:
            view, mask: (H, W) where corners are looked for. pixels: of (N, 2) px of the view in the left image.
            left: the image's pyramid. right: the result of `prepare` for the second camera.
        """
        keypoints, descriptors = self._orb.detectAndCompute(view, mask)
        if not len(keypoints):
            return Corners.none()
        uv = pixels(np.asarray(cv2.KeyPoint.convert(keypoints), np.float64))
        match = self._stereo.match_coarse(left, right, uv)
        good = match.good
        return Corners(
            uv[good].astype(np.float32),
            match.uv_right[good].astype(np.float32),
            (match.bearing[good] / match.rho[good, None]).astype(np.float32),
            np.asarray(descriptors, np.uint8)[good],
        )


class PlaceCorners:
    """Corners of level 1 of the pyramid."""

    def __init__(self, config: Config, rig: Rig) -> None:
        self._levels = config.tracker.pyramid_levels
        self._orb = StereoOrb(config.tracker, rig, config.loop.corners)
        mask = corner_mask(rig.left, config.tracker.max_angle_deg)
        mask &= True if rig.left_mask is None else uncovered(half_size(rig.left_mask), RADIUS)
        everywhere = mask[RADIUS:-RADIUS, RADIUS:-RADIUS].all()
        self._mask = None if everywhere else mask.astype(np.uint8)  # a mask costs time

    def use(self, rig: Rig) -> None:
        """Use another rig."""
        self._orb.use(rig)

    @staticmethod
    def from_config(config: Config, rig: Rig) -> PlaceCorners | None:
        """The detector of a run, None without place recognition or without depth."""
        needed = config.mapper.enabled or config.loop.enabled
        return PlaceCorners(config, rig) if rig.stereo and needed else None

    def find(self, image: StereoImage) -> Corners:
        """The strongest corners of each level that both cameras see, about as many as configured."""
        return self.find_in(build_pyramid(image.left, self._levels), self._orb.prepare(image))

    def find_in(self, left: Pyramid, right: Pyramid | F32) -> Corners:
        """As `find`, from the left image's pyramid and `StereoMatcher.prepare` of the second camera."""
        return self._orb.find(left[1], self._mask, lambda half: 2.0 * half, left, right)
