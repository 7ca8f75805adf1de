"""Change of the tracker's rig: tracked points are triangulated anew from their pixels."""

from __future__ import annotations

import numpy as np

from stereo_sfm.tracking.flow.pose_solver import MIN_RHO
from stereo_sfm.tracking.flow.rolling_shutter import RollingShutter
from stereo_sfm.tracking.flow.stereo import StereoMatcher
from stereo_sfm.tracking.flow.tracks import Tracks
from stereo_sfm.types import F64


def triangulate_tracks(
    tracks: Tracks, stereo: StereoMatcher, shutter: RollingShutter, pose: F64, velocity: F64
) -> Tracks:
    """Tracks with distances by the matcher's rig, from the pose of the last image. None is taken for moving: what
    contradicted another rig need not contradict this one.

    Args:
        tracks: of the last image. stereo: with the corrected rig.
        pose: (4, 4) odom_T_cam of the last image. velocity: (6,) tangent a second.

    Returns:
        The same tracks; those that the second camera does not see keep their positions.
    """
    match = stereo.placed(tracks.uv, tracks.uv_right)
    seen = match.good
    origin, direction = shutter.rays(pose, velocity, tracks.uv[seen], match.bearing[seen])
    tracks.origin[seen], tracks.direction[seen] = origin, direction
    tracks.rho[seen] = np.maximum(match.rho[seen], MIN_RHO)
    tracks.variance[seen], tracks.right_offset[seen] = match.variance[seen], match.offset[seen]
    tracks.mapped[seen] = False
    tracks.moving[:], tracks.misses[:] = False, 0
    return tracks
