"""Arrays for the viewer: colours, camera pyramids, and many lines at once."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pyarrow as pa
from rerun.components import LineStrip2DBatch, LineStrip3DBatch

from stereo_sfm.geometry import se3
from stereo_sfm.types import F64, I32, U8

OLD = 60  # frames after which a track's colour no longer changes
_STRIPS: dict[int, Any] = {
    2: LineStrip2DBatch(np.zeros((1, 2, 2), np.float32)).as_arrow_array().type,
    3: LineStrip3DBatch(np.zeros((1, 2, 3), np.float32)).as_arrow_array().type,
}
# A pyramid drawn in one stroke: rows of (apex, four corners of the base).
_STROKE = (0, 1, 2, 0, 3, 4, 0, 2, 3, 4, 1)
_PYRAMID: F64 = np.array([[0, 0, 0], [-0.6, -0.45, 0.7], [0.6, -0.45, 0.7], [0.6, 0.45, 0.7], [-0.6, 0.45, 0.7]])


def turbo(values: F64, low: float, high: float) -> U8:
    """(N,) -> (N, 3) RGB of Google's turbo colour map, `low` blue and `high` red."""
    scaled = np.clip((values - low) / max(high - low, 1e-9), 0, 1) * 255
    bgr = cv2.applyColorMap(scaled.astype(np.uint8)[:, None], cv2.COLORMAP_TURBO)[:, 0]
    return np.ascontiguousarray(bgr[:, ::-1], np.uint8)


def age_colors(age: I32) -> U8:
    """(N,) frames -> (N, 3) RGB: blue for new tracks, over green, to red for old ones."""
    return turbo(age.astype(float), -0.12 * OLD, OLD)


def spread_colors(values: F64) -> U8:
    """(N,) -> (N, 3) RGB from blue for the lowest to red for the highest; 3 % at each end saturate."""
    if not len(values):
        return np.zeros((0, 3), np.uint8)
    low, high = np.percentile(values, (3, 97))
    return turbo(values, float(low), float(high))


def wire_cameras(map_T_cam: F64, size: float) -> F64:
    """(K, 4, 4) poses -> (K, 11, 3) strokes of pyramids that are `size` metres large and open along the view."""
    corners = np.broadcast_to(_PYRAMID * size, (len(map_T_cam), *_PYRAMID.shape))
    return se3.transform(map_T_cam, corners)[:, list(_STROKE)]


def strips(points: F64) -> Any:
    """(N, L, 2 or 3) vertices of N lines as the Arrow array that rerun sends: no Python loop over the lines."""
    count, length, dimensions = points.shape
    kind = _STRIPS[dimensions]
    numbers = pa.array(np.ascontiguousarray(points, np.float32).reshape(-1))
    vertices = pa.FixedSizeListArray.from_arrays(numbers, type=kind.value_type)
    ends = pa.array(np.arange(count + 1, dtype=np.int32) * length)
    return pa.ListArray.from_arrays(ends, vertices, type=kind)
