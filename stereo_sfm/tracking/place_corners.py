"""What a keyframe is recognised by: ORB corners of the whole image, tracked or not, with their stereo depth.

The points that flow follows were corners where they were first seen. Where they are now, a detector finds others, and
when the place is seen again a third choice: one in eight comes back. So place recognition has corners of its own. One
spot may be a corner on several levels: that is what makes it known again from nearer or farther away.
"""

from __future__ import annotations

import cv2
import numpy as np

from stereo_sfm.tracking.flow import Pyramid
from stereo_sfm.tracking.stereo import StereoMatcher
from stereo_sfm.types import F32, Bool, Corners

LEVELS, SCALE = 4, 1.2  # of ORB in the half image: more levels cost more than they find again
FAST_THRESHOLD = 10  # grey levels


class PlaceCorners:
    """Oriented FAST with rotated BRIEF (Rublee et al., ORB, ICCV 2011) on level 1 of the pyramid.

    Args:
        count: so many, the strongest of each level (more where equals end the list); 0: none.
        mask: (H/2, W/2) where they may lie.
    """

    def __init__(self, count: int, mask: Bool, stereo: StereoMatcher) -> None:
        self._count, self._stereo = count, stereo
        self._mask = mask.astype(np.uint8)
        self._orb = cv2.ORB.create(count, SCALE, LEVELS, edgeThreshold=15, fastThreshold=FAST_THRESHOLD)

    def find(self, left: Pyramid, right: Pyramid | F32) -> Corners:
        """Those that both eyes see."""
        if not self._count:
            return Corners.none()
        keypoints, descriptors = self._orb.detectAndCompute(left[1], self._mask)
        if not len(keypoints):
            return Corners.none()
        uv = 2.0 * np.array([k.pt for k in keypoints], np.float64)
        match = self._stereo.match_coarse(left, right, uv)
        return Corners(
            uv[match.good].astype(np.float32),
            match.uv_right[match.good].astype(np.float32),
            (match.bearing[match.good] / match.rho[match.good, None]).astype(np.float32),
            np.asarray(descriptors, np.uint8)[match.good],
        )
