"""The tracker takes a corrected rig: what it follows is placed anew by the pixels that it has."""

from __future__ import annotations

import numpy as np

from stereo_sfm.tracking.flow.rolling_shutter import RollingShutter
from stereo_sfm.tracking.flow.stereo import StereoMatcher
from stereo_sfm.tracking.flow.tracks import Tracks
from stereo_sfm.types import F64

LEAST_RHO = 1e-4  # 1/m


def place_anew(tracks: Tracks, stereo: StereoMatcher, shutter: RollingShutter, pose: F64, velocity: F64) -> Tracks:
    """Tracks with their distances by the matcher's rig, seen from where the last image was taken.

    Args:
        tracks: of the last image. stereo: with the corrected rig.
        pose: (4, 4) odom_T_cam of the last image. velocity: (6,) tangent a second.

    Returns:
        The same tracks; those that the second camera does not see keep their places.
    """
    match = stereo.placed(tracks.uv, tracks.uv_right)
    seen = match.good
    origin, direction = shutter.rays(pose, velocity, tracks.uv[seen], match.bearing[seen])
    tracks.origin[seen], tracks.direction[seen] = origin, direction
    tracks.rho[seen] = np.maximum(match.rho[seen], LEAST_RHO)
    tracks.variance[seen] = match.variance[seen]
    tracks.mapped[seen] = False
    return tracks
