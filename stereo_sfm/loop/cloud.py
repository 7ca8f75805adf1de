"""Points around a keyframe, its own and those of connected keyframes: what a camera is matched to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.rig import Rig
from stereo_sfm.geometry import se3
from stereo_sfm.loop.absolute_pose import range_sigmas
from stereo_sfm.loop.binary import present
from stereo_sfm.types import F64, I32, I64, U8, Keyframe


@dataclass(frozen=True, eq=False)
class Cloud:
    """M described points in the frame of a centre camera; a physical point may have several rows (views)."""

    ids: I64  # (M,) point ids
    points: F64  # (M, 3) metres in the centre's camera
    sigmas: F64  # (M,) metres along the ray
    descriptors: U8  # (M, 32)
    uv_left: F64  # (M, 2) px in the image of the row's own keyframe
    uv_right: F64  # (M, 2)
    view: I64  # (M,) which keyframe that is: row of centre_T_kf
    centre_T_kf: F64  # (V, 4, 4); row 0 is the centre

    def __len__(self) -> int:
        return len(self.ids)

    def seen_by_centre(self, rows: I32) -> tuple[F64, F64]:
        """Left and right pixels (N, 2) of these rows in the centre's image, NaN for views of other keyframes."""
        own = (self.view[rows] == 0)[:, None]
        return np.where(own, self.uv_left[rows], np.nan), np.where(own, self.uv_right[rows], np.nan)


def gather(centre: Keyframe, others: Sequence[Keyframe], rig: Rig, disparity_sigma: float) -> Cloud:
    """The centre's points, then those of `others` (near in time), moved into its camera by odometry.

    Only points with depth and a descriptor are taken.
    """
    keyframes = [centre, *others]
    centre_T_kf = np.stack([se3.inverse(centre.odom_T_cam) @ k.odom_T_cam for k in keyframes])
    rows = [np.flatnonzero(np.isfinite(k.points_cam[:, 2]) & present(k.descriptors)) for k in keyframes]
    taken = list(zip(keyframes, rows, strict=True))
    points = [k.points_cam[r] for k, r in taken]
    return Cloud(
        np.concatenate([k.point_ids[r] for k, r in taken]),
        np.concatenate([se3.transform(t, p) for t, p in zip(centre_T_kf, points, strict=True)]),
        range_sigmas(np.concatenate(points), rig, disparity_sigma),
        np.concatenate([k.descriptors[r] for k, r in taken]),
        np.concatenate([k.uv_left[r] for k, r in taken]),
        np.concatenate([k.uv_right[r] for k, r in taken]),
        np.repeat(np.arange(len(taken)), [len(r) for r in rows]),
        centre_T_kf,
    )
