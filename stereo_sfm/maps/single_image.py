"""A single stereo image as a keyframe: the same corners, stereo matches and descriptors that tracking makes."""

from __future__ import annotations

import dataclasses

from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import Config
from stereo_sfm.tracking.factory import make_tracker
from stereo_sfm.types import Keyframe, StereoImage


def still_keyframe(
    image: StereoImage, rig: Rig, max_features: int = 1000, config: Config | None = None
) -> Keyframe | None:
    """What a tracker that starts at this image makes of it (pose identity); None where it sees too little."""
    config = config or Config()
    config = dataclasses.replace(config, tracker=dataclasses.replace(config.tracker, max_features=max_features))
    return make_tracker(config, rig).step(image)[1]
