"""A single stereo image as a keyframe, with the corners, stereo matches and descriptors of tracking."""

from __future__ import annotations

import dataclasses

from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import Config
from stereo_sfm.tracking.factory import make_tracker
from stereo_sfm.types import Keyframe, StereoImage


def still_keyframe(
    image: StereoImage, rig: Rig, max_features: int = 1000, config: Config | None = None
) -> Keyframe | None:
    """The keyframe of a tracker that starts at this image (pose identity); None with too few points."""
    config = config or Config()
    sides = 2 * config.loop.side_corners  # a keyframe has fewer: others in its place complete it
    config = dataclasses.replace(
        config,
        tracker=dataclasses.replace(config.tracker, max_features=max_features),
        loop=dataclasses.replace(config.loop, side_corners=sides),
    )
    tracker = make_tracker(config, rig)
    keyframe = tracker.step(image)[1]
    return None if keyframe is None else tracker.describe(keyframe)
