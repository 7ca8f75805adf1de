"""The living part of a map as copies, and how each of its columns is stored in files (`maps.saved_map`)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from stereo_sfm.types import F32, F64, I64, U8, Bool, Corners, Keyframe


@dataclass(frozen=True)
class Column:
    """One array of a table; an index column refers to rows of another table."""

    table: str
    dtype: str  # in files
    shape: tuple[int, ...] = ()  # of one row
    index: str = ""  # the table it refers to
    ascending: bool = False
    unknown: bool = False  # NaN means not observed


@dataclass(frozen=True, eq=False)
class MapSnapshot:
    """The living part of a map as copies: keyframes and points in order of their ids, observations by keyframe.

    Corners, for place recognition, are those of `Keyframe.corners` and then of `Keyframe.sides` of each keyframe.
    """

    kf_ids: Annotated[I64, Column("keyframes", "int64", ascending=True)]  # (K,)
    frame_ids: Annotated[I64, Column("keyframes", "int64")]  # (K,)
    stamp_ns: Annotated[I64, Column("keyframes", "int64")]  # (K,)
    submap_ids: Annotated[I64, Column("keyframes", "int64")]  # (K,)
    map_T_kf: Annotated[F64, Column("keyframes", "float64", (4, 4))]  # (K, 4, 4)
    down: Annotated[F64, Column("keyframes", "float64", (3,))]  # (K, 3) see `Keyframe.down`
    down_sigma: Annotated[F64, Column("keyframes", "float64")]  # (K,)
    pt_ids: Annotated[I64, Column("points", "int64", ascending=True)]  # (P,)
    points: Annotated[F64, Column("points", "float64", (3,))]  # (P, 3)
    anchors: Annotated[I64, Column("points", "int64", index="keyframes")]  # (P,)
    seen: Annotated[I64, Column("points", "int64")]  # (P,)
    expected: Annotated[I64, Column("points", "int64")]  # (P,)
    obs_kf: Annotated[I64, Column("observations", "int64", index="keyframes")]  # (M,)
    obs_pt: Annotated[I64, Column("observations", "int64", index="points")]  # (M,)
    uv_left: Annotated[F64, Column("observations", "float32", (2,))]  # (M, 2) px
    uv_right: Annotated[F64, Column("observations", "float32", (2,), unknown=True)]  # (M, 2) px
    descriptors: Annotated[U8, Column("observations", "uint8", (32,))]  # (M, 32)
    corner_kf: Annotated[I64, Column("corners", "int64", index="keyframes")]  # (C,) ascending
    corner_uv_left: Annotated[F32, Column("corners", "float32", (2,))]  # (C, 2) px
    corner_uv_right: Annotated[F32, Column("corners", "float32", (2,), unknown=True)]  # (C, 2) px
    corner_points: Annotated[F32, Column("corners", "float32", (3,), unknown=True)]  # (C, 3) metres, in the camera
    corner_descriptors: Annotated[U8, Column("corners", "uint8", (32,))]  # (C, 32)
    corner_side: Annotated[Bool, Column("corners", "bool")]  # (C,) of `Keyframe.sides`

    def keyframes(self) -> list[Keyframe]:
        """Keyframes as from a tracker, with poses and points of the map."""
        rows = np.arange(len(self.kf_ids) + 1)
        seen, corners = np.searchsorted(self.obs_kf, rows), np.searchsorted(self.corner_kf, rows)
        return [
            self._keyframe(k, slice(seen[k], seen[k + 1]), slice(corners[k], corners[k + 1]))
            for k in rows[:-1].tolist()
        ]

    def _corners(self, rows: slice) -> Corners:
        return Corners(
            self.corner_uv_left[rows], self.corner_uv_right[rows], self.corner_points[rows],
            self.corner_descriptors[rows],
        )  # fmt: skip

    def _keyframe(self, k: int, seen: slice, corners: slice) -> Keyframe:
        points, pose = self.obs_pt[seen], self.map_T_kf[k]
        sides = corners.stop - int(self.corner_side[corners].sum())
        return Keyframe(
            kf_id=int(self.kf_ids[k]),
            frame_id=int(self.frame_ids[k]),
            stamp_ns=int(self.stamp_ns[k]),
            odom_T_cam=pose.copy(),
            point_ids=self.pt_ids[points],
            uv_left=self.uv_left[seen],
            uv_right=self.uv_right[seen],
            points_cam=(self.points[points] - pose[:3, 3]) @ pose[:3, :3],
            descriptors=self.descriptors[seen],
            submap_id=int(self.submap_ids[k]),
            corners=self._corners(slice(corners.start, sides)),
            sides=self._corners(slice(sides, corners.stop)),
            down=self.down[k],
            down_sigma=float(self.down_sigma[k]),
        )
