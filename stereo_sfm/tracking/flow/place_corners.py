"""Corners for place recognition: ORB features of the image, tracked or not, with their stereo depth.

Tracked points were detected in the image of their first observation; only one in eight of them is detected again when
the place is revisited. Place recognition therefore has corners of its own, detected in keyframes whose view differs
enough from the newest one with corners (`Keyframes`). A point may be a corner on several levels of the scale pyramid,
for matching from other distances.
"""

from __future__ import annotations

import cv2
import numpy as np

from stereo_sfm.calib.mask import half_size, uncovered
from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import Config
from stereo_sfm.tracking.flow.corners import corner_mask
from stereo_sfm.tracking.flow.klt import Pyramid, build_pyramid
from stereo_sfm.tracking.flow.stereo import StereoMatcher
from stereo_sfm.types import F32, F64, U8, Corners, StereoImage

LEVELS, SCALE = 4, 1.2  # of ORB in the half image; more levels add few matches
FAST_THRESHOLD = 10  # grey levels
BORDER = 15  # px of each level, without corners


class PlaceCorners:
    """Oriented FAST with rotated BRIEF (Rublee et al., ORB, ICCV 2011) on level 1 of the pyramid."""

    def __init__(self, config: Config, rig: Rig) -> None:
        self._levels = config.tracker.pyramid_levels
        self._stereo = StereoMatcher(config.tracker, rig)
        mask = corner_mask(rig.left, config.tracker.max_angle_deg)
        mask &= True if rig.left_mask is None else uncovered(half_size(rig.left_mask), BORDER)
        everywhere = mask[BORDER:-BORDER, BORDER:-BORDER].all()
        self._mask = None if everywhere else mask.astype(np.uint8)  # a mask costs time
        self._orb = cv2.ORB.create(
            config.loop.corners, SCALE, LEVELS, edgeThreshold=BORDER, fastThreshold=FAST_THRESHOLD
        )

    def use(self, rig: Rig) -> None:
        """Use another rig."""
        self._stereo.use(rig)

    @staticmethod
    def from_config(config: Config, rig: Rig) -> PlaceCorners | None:
        """The detector of a run, None without place recognition or without depth."""
        needed = config.mapper.enabled or config.loop.enabled
        return PlaceCorners(config, rig) if rig.stereo and needed else None

    def find(self, image: StereoImage) -> Corners:
        """The strongest corners of each level that both cameras see, about as many as configured."""
        return self.find_in(build_pyramid(image.left, self._levels), self._stereo.prepare(image))

    def find_in(self, left: Pyramid, right: Pyramid | F32) -> Corners:
        """As `find`, from the left image's pyramid and `StereoMatcher.prepare` of the second camera."""
        keypoints, descriptors = self._orb.detectAndCompute(left[1], self._mask)
        if not len(keypoints):
            return Corners.none()
        uv = 2.0 * np.asarray(cv2.KeyPoint.convert(keypoints), np.float64)
        return seen_by_both(self._stereo, left, right, uv, np.asarray(descriptors, np.uint8))


def seen_by_both(stereo: StereoMatcher, left: Pyramid, right: Pyramid | F32, uv: F64, descriptors: U8) -> Corners:
    """The corners (N, 2) px of the left image, with descriptors (N, 32), that have a match in the second camera.

    `left`: the image's pyramid. `right`: the result of `StereoMatcher.prepare` for the second camera.
    """
    match = stereo.match_coarse(left, right, uv)
    good = match.good
    return Corners(
        uv[good].astype(np.float32),
        match.uv_right[good].astype(np.float32),
        (match.bearing[good] / match.rho[good, None]).astype(np.float32),
        descriptors[good],
    )
