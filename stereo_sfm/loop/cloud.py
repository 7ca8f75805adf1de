"""Points around a keyframe, its own and those of connected keyframes: what a camera is matched to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.rig import Rig
from stereo_sfm.geometry import se3
from stereo_sfm.loop.absolute_pose import range_sigmas
from stereo_sfm.loop.binary import present
from stereo_sfm.types import F64, I64, U8, Keyframe


@dataclass(frozen=True, eq=False)
class Cloud:
    """M described points in the frame of a centre keyframe; a physical point may have several rows (views)."""

    ids: I64  # (M,) point ids
    points: F64  # (M, 3) metres in the centre's camera
    sigmas: F64  # (M,) metres along the ray
    descriptors: U8  # (M, 32)
    uv_left: F64  # (M, 2) px in the centre's image, NaN for points of the other keyframes
    uv_right: F64  # (M, 2)

    def __len__(self) -> int:
        return len(self.ids)


def keyframe_cloud(keyframe: Keyframe, rig: Rig, disparity_sigma: float) -> Cloud:
    """A keyframe's own points that have depth and a descriptor."""
    rows = np.flatnonzero(np.isfinite(keyframe.points_cam[:, 2]) & present(keyframe.descriptors))
    points = np.ascontiguousarray(keyframe.points_cam[rows])
    return Cloud(
        keyframe.point_ids[rows],
        points,
        range_sigmas(points, rig, disparity_sigma),
        keyframe.descriptors[rows],
        keyframe.uv_left[rows],
        keyframe.uv_right[rows],
    )


def gather(centre: Keyframe, others: Sequence[Keyframe], rig: Rig, disparity_sigma: float) -> Cloud:
    """The centre's points, then those of `others` (near in time), moved into its camera by odometry."""
    clouds = [keyframe_cloud(centre, rig, disparity_sigma)]
    for other in others:
        cloud = keyframe_cloud(other, rig, disparity_sigma)
        unseen = np.full((len(cloud), 2), np.nan)
        moved = se3.transform(se3.inverse(centre.odom_T_cam) @ other.odom_T_cam, cloud.points)
        clouds.append(Cloud(cloud.ids, moved, cloud.sigmas, cloud.descriptors, unseen, unseen))
    return concatenate(clouds)


def concatenate(clouds: Sequence[Cloud]) -> Cloud:
    """Rows of all, in order."""
    return Cloud(
        np.concatenate([c.ids for c in clouds]),
        np.concatenate([c.points for c in clouds]),
        np.concatenate([c.sigmas for c in clouds]),
        np.concatenate([c.descriptors for c in clouds]),
        np.concatenate([c.uv_left for c in clouds]),
        np.concatenate([c.uv_right for c in clouds]),
    )
