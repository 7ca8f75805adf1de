"""What one stereo image becomes before it is tracked."""

from __future__ import annotations

from dataclasses import dataclass

from stereo_sfm.tracking.flow import klt
from stereo_sfm.types import F32


@dataclass(frozen=True)
class StereoPyramids:
    """Both cameras' images as flow wants them."""

    left: klt.Pyramid
    right: klt.Pyramid | F32  # the second camera's pyramid, or the depth image of an RGB-D camera
