"""The effect of a calibration error on the trajectory and on distances."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.calib.scene_model import inverse_distances
from stereo_sfm.calib.tracks import Window
from stereo_sfm.types import F64

RANGES = (2.0, 5.0, 20.0)  # metres at which distances are compared


@dataclass(frozen=True)
class Consequences:
    """The errors of a rig's measurements if another rig is the true one."""

    disparity_px: float  # median over the matches
    depth: tuple[float, ...]  # relative error of distances at RANGES, inf where points end up behind the camera
    length: float  # relative error of the length of a trajectory tracked on points of this scene

    @property
    def text(self) -> str:
        """One readable line."""
        depths = ", ".join(f"{_percent(e)} at {r:g} m" for r, e in zip(RANGES, self.depth, strict=True))
        return f"distances off by {depths}; length of the trajectory by about {_percent(self.length)}"


def _percent(value: float) -> str:
    return f"{100 * value:+.1f} %" if abs(value) < 1 else "more than 100 %"


def consequences(rig: Rig, true: Rig, windows: list[Window]) -> Consequences:
    """The errors of `rig` for points that `true` sees at the places where the windows' points were matched.

    The error of the trajectory's length: points move by t * rho in the image (rho their inverse distance, t the
    camera's step): with rho' in its place, least squares over the points give t' = t * sum(rho rho') / sum(rho'^2).
    """
    left = np.concatenate([w.left[0] for w in windows])
    right = np.concatenate([w.right[0] for w in windows])
    bearing = true.left.unproject(left)
    seen = np.isfinite(bearing).all(1) & np.isfinite(right).all(1)
    left, right, bearing = left[seen], right[seen], bearing[seen]
    at = [_believed(rig, true, left, bearing, 1.0 / r) for r in (np.inf, *RANGES)]
    depth = [_depth_error(r, rho) for r, rho in zip(RANGES, at[1:], strict=True)]
    rho, believed = inverse_distances(true, left, right), inverse_distances(rig, left, right)
    good = np.isfinite(rho) & np.isfinite(believed) & (rho > 0) & (believed > 0)
    length = float((rho * believed)[good].sum() / max((believed[good] ** 2).sum(), 1e-12) - 1) if good.any() else 0.0
    return Consequences(float(np.nanmedian(at[0])) * rig.baseline * rig.left.fx, tuple(depth), length)


def _depth_error(distance: float, rho: F64) -> float:
    with np.errstate(divide="ignore"):
        return float(np.median(np.where(rho > 0, 1 / (distance * rho) - 1, np.inf)))


def _believed(rig: Rig, true: Rig, left: F64, bearing: F64, rho: float) -> F64:
    """(N,) inverse distances that `rig` measures for points of one true inverse distance on bearings (N, 3)."""
    assert true.right is not None
    in_right = (bearing - rho * true.left_T_right[:3, 3]) @ true.left_T_right[:3, :3]
    found = inverse_distances(rig, left, true.right.project(in_right))
    return found[np.isfinite(found)]
