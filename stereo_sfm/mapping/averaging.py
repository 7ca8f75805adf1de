"""Transformation averaging (retail paper, section IV-C3): the loop's error, spread evenly over the keyframes.

Translation and rotation error are spread separately and linearly, as the paper does. It is exact only where the error
grew evenly and the path is straight: turning a keyframe in place does not swing the ones after it.
"""

from __future__ import annotations

import numpy as np

from stereo_sfm.geometry import se3
from stereo_sfm.types import F64


def average_correction(poses: F64, first: int, last: int, corrected: F64) -> F64:
    """New poses (K, 4, 4) when keyframe row `last` must be at `corrected` (4, 4) and row `first` stays.

    Rows up to `first` keep their poses, rows after `last` move with it as a rigid body.
    """
    out = poses.copy()
    count = last - first
    if count <= 0:
        return out
    shift = corrected[:3, 3] - poses[last, :3, 3]
    turn = se3.so3_log(corrected[:3, :3] @ poses[last, :3, :3].T)
    share = np.arange(1, count + 1) / count
    rows = np.arange(first + 1, last + 1)
    out[rows, :3, 3] += share[:, None] * shift
    out[rows, :3, :3] = se3.so3_exp(share[:, None] * turn) @ poses[rows, :3, :3]
    out[last + 1 :] = corrected @ se3.inverse(poses[last]) @ poses[last + 1 :]
    return out
