"""Tracking of points from one left image to the next: by translation, then alignment with their first appearance."""

from __future__ import annotations

from dataclasses import dataclass

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

WELL_PREDICTED_PX = 3.0  # median error of the predictions below which the search starts in the half image
MAX_SCALE_CHANGE = 1.25  # of the distance to a point, within which its window still matches


@dataclass
class Held:
    """The last trusted image, from which tracking is recovered."""

    pyramid: klt.Pyramid
    tracks: Tracks
    pose: F64  # (4, 4) odom_T_cam


class Follower:
    """Tracks points from the last image, with the windows of their first appearances."""

    def __init__(self, config: TrackerConfig, rig: Rig, area: VisibleArea, shutter: RollingShutter) -> None:
        self._config, self._area, self._shutter = config, area, shutter
        self._patches = Patches(2 * config.max_features)
        self._last: klt.Pyramid | None = None
        self._held: Held | None = None
        self._coarse_rotation = CoarseRotation(rig.left, config.pyramid_levels)
        self._coarsest_level = config.pyramid_levels - 1
        self._first_level = self._coarsest_level  # of the pyramid, at which the search starts
        self._miss_px = np.inf  # median error of the predictions

    def follow(self, tracks: Tracks, pyramid: klt.Pyramid, expected: ExpectedMotion) -> Tracks:
        """The tracks found in the new left image, at their new pixels."""
        assert self._last is not None
        guess = self._shutter.project(expected.pose, expected.velocity, tracks.points(), tracks.uv)
        guess = np.where(np.isfinite(guess), guess, tracks.uv)
        return self._find(self._last, tracks, pyramid, guess, tracks.warp)

    def hold(self, pyramid: klt.Pyramid, tracks: Tracks, pose: F64) -> None:
        """Keep an image with a trusted pose (4, 4) and its points for recovery."""
        self._held = Held(pyramid, tracks, pose)

    def find_again(self, pyramid: klt.Pyramid, expected: ExpectedMotion) -> Tracks:
        """The held points that are found from another, possibly distant pose."""
        assert self._held is not None
        guess, nearer = self._from(expected.pose)
        ahead = np.isfinite(guess[:, 0])
        tracks, guess, nearer = self._held.tracks.keep(ahead), guess[ahead], nearer[ahead]
        self.search_widely()
        return self._find(self._held.pyramid, tracks, pyramid, guess, tracks.warp * nearer[:, None, None])

    def expected_again(self, pose: F64) -> int:
        """Number of held points that should be found from a pose (4, 4): visible, at a similar distance."""
        guess, nearer = self._from(pose)
        similar = (nearer < MAX_SCALE_CHANGE) & (nearer > 1 / MAX_SCALE_CHANGE)
        return int((similar & self._area.inside(guess)).sum())

    def _from(self, pose: F64) -> tuple[F64, F64]:
        """Pixels (N, 2) of the held points, NaN behind the camera, and the ratio (N,) of old to new distance."""
        assert self._held is not None
        tracks, points = self._held.tracks, self._held.tracks.points()
        uv = self._shutter.project(pose, np.zeros(6), points, tracks.uv)
        before, now = (np.linalg.norm(points - at, axis=1) for at in (self._held.pose[:3, 3], pose[:3, 3]))
        return uv, before / np.maximum(now, 1e-6)

    def _find(self, last: klt.Pyramid, tracks: Tracks, pyramid: klt.Pyramid, guess: F64, warp: F64) -> Tracks:
        """Find points of one image in another, starting at guesses (N, 2) px and deformations (N, 2, 2)."""
        config = self._config
        uv = guess.copy()
        status, _ = klt.track_translation(
            last, pyramid, tracks.uv, uv, self._first_level, 0, 10, config.min_contrast, config.min_ncc, klt.WEIGHTS
        )
        found = status == klt.TRACKED
        self._miss_px = float(np.median(np.linalg.norm(uv - guess, axis=1)[found])) if found.any() else np.inf
        warp = warp.copy()
        ncc = klt.track_affine(
            pyramid[0], uv, warp, tracks.slot, found, self._patches.patch, self._patches.gradients,
            self._patches.inverse_normal, self._patches.contrast, 6, klt.WEIGHTS, klt.COORDINATES,
        )  # fmt: skip
        found &= (ncc > config.min_anchor_ncc) & self._area.inside(uv)
        out = tracks.keep(found)
        out.uv, out.warp = uv[found], warp[found]
        return out

    def turned(self, pyramid: klt.Pyramid, expected: ExpectedMotion, last_pose: F64) -> ExpectedMotion:
        """The expected motion with the rotation that aligns the coarsest images; the search starts at the top level."""
        assert self._last is not None
        cur_R_prev = expected.pose[:3, :3].T @ last_pose[:3, :3]
        cur_R_prev = self._coarse_rotation.align(self._last, pyramid, cur_R_prev)
        self.search_widely()
        pose = se3.from_rotation_translation(last_pose[:3, :3] @ cur_R_prev.T, expected.pose[:3, 3])
        return ExpectedMotion(pose, se3.log(se3.inverse(last_pose) @ pose), expected.seconds)

    def search_widely(self) -> None:
        """Start the next search at the top level, for an unreliable prediction."""
        self._first_level = self._coarsest_level

    def accept(self, pyramid: klt.Pyramid, tracks: Tracks) -> None:
        """Track the next image from this one; appearances of other points are dropped."""
        self._last = pyramid
        self._first_level = 1 if self._miss_px < WELL_PREDICTED_PX else self._coarsest_level
        self.keep_only(tracks)

    def begin(self, pyramid: klt.Pyramid, uv: F64) -> tuple[I64, I64]:
        """Store the appearance of new points (N, 2) px: rows (M,) of those with texture and a slot, their slots."""
        store = self._patches
        slots = store.take(len(uv))
        textured = klt.make_patches(
            pyramid, uv[: len(slots)], slots, klt.WEIGHTS, klt.COORDINATES, store.patch, store.gradients,
            store.inverse_normal, store.contrast,
        )  # fmt: skip
        return np.flatnonzero(textured), slots[textured]

    def keep_only(self, tracks: Tracks) -> None:
        """Drop the first appearances of all points that are neither in `tracks` nor held."""
        held = tracks.slot if self._held is None else self._held.tracks.slot
        self._patches.keep_only(np.concatenate([tracks.slot, held]))
