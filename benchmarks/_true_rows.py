"""Row errors of a calibration, without matching: where rendered points are in both images, lens errors included."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.drivers.sim.source import SimSource
from stereo_sfm.geometry import se3

STEP = 16  # pixels between the points
BORDER = 8.0  # px of the right image without points


def row_error_px(source: SimSource, believed: Rig, frame_ids: Sequence[int]) -> float:
    """Root mean square distance of right pixels from the epipolar planes of the left ones, at the left focal length."""
    true, lenses = source.renderer.rig, source.renderer.cameras
    assert true.right is not None and believed.right is not None
    width, height = true.right.size
    pixels = np.stack(np.meshgrid(np.arange(float(width)), np.arange(float(height))), -1)
    shown = (true.right.project(lenses[1].grid) - pixels).astype(np.float32)  # of a pixel, where the model expects it
    squares, count = 0.0, 0
    some = slice(STEP // 2, None, STEP)
    for frame_id in frame_ids:
        points = lenses[0].grid[some, some] * source.clean(frame_id)[0].depth[some, some, None]
        uv = true.right.project(se3.transform(se3.inverse(true.left_T_right), points.reshape(-1, 3)))
        at = uv.astype(np.float32)[None]
        uv = uv - cv2.remap(shown, at[..., 0], at[..., 1], cv2.INTER_LINEAR)[0]
        left = believed.left.unproject(pixels[some, some].reshape(-1, 2))
        right = believed.right.unproject(uv) @ believed.left_T_right[:3, :3].T
        normal = np.cross(believed.left_T_right[:3, 3], left)
        off = believed.left.fx * np.einsum("ni,ni->n", normal, right) / np.linalg.norm(normal, axis=1)
        off = off[np.isfinite(off) & true.right.inside(uv, BORDER)]
        squares, count = squares + float(np.square(off).sum()), count + len(off)
    return float(np.sqrt(squares / max(count, 1)))
