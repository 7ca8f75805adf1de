"""The frames of a run as columns, which a run of a day does not keep in memory."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from stereo_sfm.eval.spool import SpooledColumns
from stereo_sfm.geometry import se3
from stereo_sfm.mapping.columns import Spec
from stereo_sfm.types import F32, F64, I32, I64, Bool, Frame, TrackState

TRACKED = (TrackState.OK, TrackState.RECOVERED, TrackState.RESTARTED, TrackState.INERTIAL)


class FrameTable(SpooledColumns):
    """One row per frame, without its observations."""

    frame_id: I64
    stamp_ns: I64
    odom: F64  # (F, 3, 4) the upper rows of odom_T_cam
    kf: F64  # (F, 3, 4) those of kf_T_cam: in the reference keyframe
    reference_kf_id: I64
    inliers: I32
    state: I32  # a TrackState
    reason_id: I32  # row of `reasons`

    SPEC: ClassVar[Spec] = {
        "frame_id": (np.int64, (), -1),
        "stamp_ns": (np.int64, (), 0),
        "odom": (np.float64, (3, 4), np.eye(3, 4)),
        "kf": (np.float64, (3, 4), np.eye(3, 4)),
        "reference_kf_id": (np.int64, (), -1),
        "inliers": (np.int32, (), 0),
        "state": (np.int32, (), 0),
        "reason_id": (np.int32, (), 0),
    }

    def __init__(self) -> None:
        super().__init__()
        self.reasons: list[str] = []  # without repetition

    def add(self, frame: Frame) -> None:
        """Append a frame."""
        if frame.reason not in self.reasons:
            self.reasons.append(frame.reason)
        self.append_row(
            frame_id=frame.frame_id,
            stamp_ns=frame.stamp_ns,
            odom=frame.odom_T_cam[:3],
            kf=frame.kf_T_cam[:3],
            reference_kf_id=frame.reference_kf_id,
            inliers=int(frame.observations.inlier.sum()),
            state=int(frame.state),
            reason_id=self.reasons.index(frame.reason),
        )

    @property
    def odom_T_cam(self) -> F64:
        """(F, 4, 4)."""
        return se3.from_rotation_translation(self.odom[:, :, :3], self.odom[:, :, 3])

    @property
    def kf_T_cam(self) -> F64:
        """(F, 4, 4)."""
        return se3.from_rotation_translation(self.kf[:, :, :3], self.kf[:, :, 3])

    @property
    def tracked(self) -> Bool:
        """(F,) whether the frame has a pose of its own."""
        return np.isin(self.state, TRACKED)

    @property
    def begin_ns(self) -> int:
        """Stamp of the first frame; 0 without one."""
        return int(self.stamp_ns[0]) if len(self) else 0

    def reasons_of(self, rows: Bool | I64) -> list[str]:
        """Why there is no pose, of these rows."""
        return [self.reasons[k] for k in self.reason_id[rows].tolist()]


class TimeTable(SpooledColumns):
    """One row for each stage of each frame that ran it."""

    frame_id: I64
    stage_id: I32  # row of `stages`
    ms: F32

    SPEC: ClassVar[Spec] = {"frame_id": (np.int64, (), -1), "stage_id": (np.int32, (), 0), "ms": (np.float32, (), 0)}

    def __init__(self) -> None:
        super().__init__()
        self.stages: list[str] = []

    def add(self, frame_id: int, ms: dict[str, float]) -> None:
        """Append the times of the stages for a frame; a later value replaces an earlier one."""
        self.stages += [stage for stage in ms if stage not in self.stages]
        for stage, value in ms.items():
            self.append_row(frame_id=frame_id, stage_id=self.stages.index(stage), ms=value)

    def of_frames(self, frame_ids: I64) -> dict[str, F64]:
        """(F,) milliseconds by stage, NaN where a stage did not run; `frame_ids` (F,) ascending."""
        out = np.full((len(self.stages), len(frame_ids)), np.nan)
        rows = np.searchsorted(frame_ids, self.frame_id)
        known = np.flatnonzero(np.isin(self.frame_id, frame_ids))
        out[self.stage_id[known], rows[known]] = self.ms[known]
        return {stage: out[k] for k, stage in enumerate(self.stages)}
