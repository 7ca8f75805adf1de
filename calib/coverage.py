"""Which image regions, distances and tilts a set of views covers, and which views to take next."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereo_sfm.calib.targets import Detection
from stereo_sfm.types import F64, I64

GRID = (5, 5)  # rows and columns of regions
MIN_VIEWS = 4  # in a region
_ROWS = ("top", "upper", "middle", "lower", "bottom")
_COLUMNS = ("left", "centre left", "centre", "centre right", "right")


@dataclass(frozen=True, eq=False)
class Coverage:
    """What a set of views covers, and what is missing."""

    views: I64  # (5, 5) views with corners in each region
    near: int  # views in which the target fills more than a sixth of the image
    far: int  # views in which it fills less than a fifteenth
    tilted: int  # views in which opposite sides differ by more than an eighth
    total: int

    @property
    def fraction(self) -> float:
        """Share of the regions seen in at least two views."""
        return float((self.views >= 2).mean())

    @property
    def advice(self) -> list[str]:
        """Instructions for the missing views; empty when nothing is missing."""
        out: list[str] = []
        thin = np.argwhere(self.views < MIN_VIEWS)
        names = [f"{_ROWS[r]} {_COLUMNS[c]}" for r, c in thin]
        if names:
            more = f" and {len(names) - 5} more" if len(names) > 5 else ""
            out.append(f"move the target to these parts of the image: {', '.join(names[:5])}{more}")
        if self.near < 3:
            out.append("move the target closer: fewer than 3 views fill a sixth of the image")
        if self.far < 3:
            out.append("move the target away: fewer than 3 views fill less than a fifteenth of the image")
        if self.tilted < 5:
            out.append("tilt the target: fewer than 5 views are oblique")
        if self.total < 12:
            out.append(f"take more views: {self.total} so far, at least 12 are needed")
        return out


def coverage(detections: list[Detection], size: tuple[int, int]) -> Coverage:
    """The coverage of one camera's views; empty detections do not count."""
    views = np.zeros(GRID, np.int64)
    near = far = tilted = total = 0
    for detection in detections:
        if not len(detection):
            continue
        total += 1
        cell = np.floor(detection.uv / np.array(size) * GRID[::-1]).astype(int)
        cell = np.clip(cell, 0, np.array(GRID[::-1]) - 1)
        seen = np.unique(cell, axis=0)
        views[seen[:, 1], seen[:, 0]] += 1
        share = _hull_area(detection.uv) / (size[0] * size[1])
        near, far = near + (share > 1 / 6), far + (share < 1 / 15)
        tilted += _asymmetry(detection.uv) > 0.06
    return Coverage(views, int(near), int(far), int(tilted), total)


def _hull_area(uv: F64) -> float:
    import cv2

    return float(cv2.contourArea(cv2.convexHull(uv.astype(np.float32))))


def _asymmetry(uv: F64) -> float:
    """Third moment of the corners along their axes: zero for a target seen frontally, larger when it is oblique."""
    centred = uv - uv.mean(0)
    _, _, axes = np.linalg.svd(centred, full_matrices=False)
    along = centred @ axes.T
    scale = along.std(0) + 1e-9
    mixed = np.stack([along[:, 0] * along[:, 1] ** 2, along[:, 0] ** 2 * along[:, 1], *(along.T**3)])
    return float(np.abs(mixed.mean(1) / (scale.prod() ** 1.5)).max())


def is_new(detection: Detection, kept: list[Detection], width: int, least: float = 0.05) -> bool:
    """Whether a view differs from all kept ones by a mean corner shift of at least `least` of the image width."""
    for other in kept:
        common, a, b = np.intersect1d(detection.ids, other.ids, return_indices=True)
        if len(common) >= 4:
            shift = np.linalg.norm(detection.uv[a] - other.uv[b], axis=1).mean()
            if shift < least * width:
                return False
    return True
