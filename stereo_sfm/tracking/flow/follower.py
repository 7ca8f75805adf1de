"""Points followed from one left image to the next: by translation, then aligned with their first appearance."""

from __future__ import annotations

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import TrackerConfig
from stereo_sfm.geometry import se3
from stereo_sfm.tracking.flow import klt
from stereo_sfm.tracking.flow.coarse_rotation import CoarseRotation
from stereo_sfm.tracking.flow.frame_pose import ExpectedMotion
from stereo_sfm.tracking.flow.rolling_shutter import RollingShutter
from stereo_sfm.tracking.flow.tracks import Patches, Tracks
from stereo_sfm.tracking.flow.visible_area import VisibleArea
from stereo_sfm.types import F64, I64

WELL_PREDICTED_PX = 3.0  # median distance of points from where they were expected; below, the half image is enough


class Follower:
    """Knows the last image and how its points looked when they were first seen."""

    def __init__(self, config: TrackerConfig, rig: Rig, area: VisibleArea, shutter: RollingShutter) -> None:
        self._config, self._area, self._shutter = config, area, shutter
        self._patches = Patches(2 * config.max_features)
        self._last: klt.Pyramid | None = None
        self._coarse_rotation = CoarseRotation(rig.left, config.pyramid_levels)
        self._coarsest_level = config.pyramid_levels - 1
        self._first_level = self._coarsest_level  # of the pyramid, from which the search begins
        self._miss_px = np.inf  # median distance of points from where they were expected

    def follow(self, tracks: Tracks, pyramid: klt.Pyramid, expected: ExpectedMotion) -> Tracks:
        """Tracks that are found in the new left image, moved there."""
        config = self._config
        assert self._last is not None
        guess = self._shutter.project(expected.pose, expected.velocity, tracks.points(), tracks.uv)
        guess = np.where(np.isfinite(guess), guess, tracks.uv)
        uv = guess.copy()
        status, _ = klt.track_translation(
            self._last, pyramid, tracks.uv, uv, self._first_level, 0, 10, config.min_contrast, config.min_ncc,
            klt.WEIGHTS,
        )  # fmt: skip
        found = status == klt.TRACKED
        self._miss_px = float(np.median(np.linalg.norm(uv - guess, axis=1)[found])) if found.any() else np.inf
        warp = tracks.warp.copy()
        ncc = klt.track_affine(
            pyramid[0], uv, warp, tracks.slot, found, self._patches.patch, self._patches.gradients,
            self._patches.inverse_normal, self._patches.contrast, 6, klt.WEIGHTS, klt.COORDINATES,
        )  # fmt: skip
        found &= (ncc > config.min_anchor_ncc) & self._area.inside(uv)
        out = tracks.keep(found)
        out.uv, out.warp = uv[found], warp[found]
        return out

    def turned(self, pyramid: klt.Pyramid, expected: ExpectedMotion, last_pose: F64) -> ExpectedMotion:
        """The expected motion with the rotation that aligns the whole images; the search begins at the top level."""
        assert self._last is not None
        cur_R_prev = expected.pose[:3, :3].T @ last_pose[:3, :3]
        cur_R_prev = self._coarse_rotation.align(self._last, pyramid, cur_R_prev)
        self.search_widely()
        pose = se3.from_rotation_translation(last_pose[:3, :3] @ cur_R_prev.T, expected.pose[:3, 3])
        return ExpectedMotion(pose, se3.log(se3.inverse(last_pose) @ pose), expected.seconds)

    def search_widely(self) -> None:
        """The next search begins at the top level: the prediction cannot be trusted."""
        self._first_level = self._coarsest_level

    def accept(self, pyramid: klt.Pyramid, tracks: Tracks) -> None:
        """Follow the next image from this one; what other points looked like is forgotten."""
        self._last = pyramid
        self._first_level = 1 if self._miss_px < WELL_PREDICTED_PX else self._coarsest_level
        self._patches.keep_only(tracks.slot)

    def begin(self, pyramid: klt.Pyramid, uv: F64) -> tuple[I64, I64]:
        """Remember how new points (N, 2) px look: rows (M,) of those with texture that found a place, their slots."""
        store = self._patches
        slots = store.take(len(uv))
        textured = klt.make_patches(
            pyramid, uv[: len(slots)], slots, klt.WEIGHTS, klt.COORDINATES, store.patch, store.gradients,
            store.inverse_normal, store.contrast,
        )  # fmt: skip
        return np.flatnonzero(textured), slots[textured]

    def keep_only(self, tracks: Tracks) -> None:
        """Drop the first appearances of all other points."""
        self._patches.keep_only(tracks.slot)
