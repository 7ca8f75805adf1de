"""The image pyramids of a stereo image."""

from __future__ import annotations

from dataclasses import dataclass

from stereo_sfm.tracking.flow import klt
from stereo_sfm.types import F32


@dataclass(frozen=True)
class StereoPyramids:
    """Input of the flow tracker from one stereo image."""

    left: klt.Pyramid
    right: klt.Pyramid | F32  # the second camera's pyramid, or the depth image of an RGB-D camera
