"""The statistics of a frame as flat numbers, which every viewer can plot."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import ClassVar

import numpy as np

from stereo_sfm.messages import Topic
from stereo_sfm.types import Frame

NAN = float("nan")


@dataclass(frozen=True)
class TrackStats:
    """Statistics of one frame as flat numbers, which every viewer can plot; NaN where not available."""

    TOPIC: ClassVar[Topic] = Topic("/stats", "every frame: flat numbers to plot")

    frame_id: int
    state: int
    keyframe: bool
    map_version: int
    observations: int
    inlier_observations: int
    stereo_observations: int
    position_sigma: float  # metres
    rotation_sigma: float  # radians
    tracked: float = NAN
    inliers: float = NAN
    right: float = NAN
    error: float = NAN
    features: float = NAN
    matches: float = NAN
    parallax_deg: float = NAN
    pure_rotation: float = NAN
    line_share: float = NAN
    vp_sigma_deg: float = NAN
    other: dict[str, float] = field(default_factory=dict[str, float])


_NAMED = {f.name for f in fields(TrackStats)} - {"other"}


def track_stats(frame: Frame) -> TrackStats:
    """The numbers of a frame; what has no field of its own goes to `other`."""
    obs = frame.observations
    named = {k: v for k, v in frame.stats.items() if k in _NAMED}
    sigma = np.sqrt(np.maximum(np.diag(frame.covariance), 0.0))
    return TrackStats(
        frame_id=frame.frame_id,
        state=int(frame.state),
        keyframe=frame.is_keyframe,
        map_version=frame.map_version,
        observations=len(obs),
        inlier_observations=int(obs.inlier.sum()),
        stereo_observations=int(np.isfinite(obs.uv_right[:, 0]).sum()),
        position_sigma=float(np.linalg.norm(sigma[:3])),
        rotation_sigma=float(np.linalg.norm(sigma[3:])),
        other={k: v for k, v in frame.stats.items() if k not in _NAMED},
        **named,
    )
