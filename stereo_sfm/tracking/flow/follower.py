"""Tracking of points from one left image to the next: alignment with their first appearance, after a translation."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import TrackerConfig
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Camera
from stereo_sfm.geometry.order_statistics import median_distance
from stereo_sfm.tracking.flow import klt
from stereo_sfm.tracking.flow.coarse_rotation import CoarseRotation
from stereo_sfm.tracking.flow.frame_pose import ExpectedMotion
from stereo_sfm.tracking.flow.klt import StereoPyramids
from stereo_sfm.tracking.flow.reappearance import find_deformed, plane_warps, surfaces_around
from stereo_sfm.tracking.flow.rolling_shutter import RollingShutter
from stereo_sfm.tracking.flow.tracks import Patches, Tracks
from stereo_sfm.tracking.flow.visible_area import GRID, VisibleArea, cells_of
from stereo_sfm.tracking.flow.window_curvature import window_curvatures, window_rays
from stereo_sfm.types import F64, I64, Bool

WELL_PREDICTED_PX = 3.0  # median error of the predictions below which the search starts in the half image
ALIGNED_PX = 1.5  # the same, below which first appearances are aligned from the predictions
STORED = 4  # times max_features: points of the last image and of the reference image, and new ones of it
MIN_COARSE_NCC = 0.65  # of a window found again in the half image
CELL_POINTS = 4.0  # with which a cell counts fully
NEARER = 0.6  # of the distance of what should be in a cell: what is nearer covers it
SEARCH_STEPS = 14  # offsets of a search on either side


@dataclass
class ReferenceImage:
    """The trusted image from which tracking is recovered."""

    images: StereoPyramids
    tracks: Tracks
    pose: F64  # (4, 4) odom_T_cam
    dense: bool = False  # whether points were added for the recovery
    _surfaces: F64 | None = None
    rays: F64 = field(init=False)  # (N, 3) metres from the camera to the points tracked in it, odometry axes

    def __post_init__(self) -> None:
        self.rays = self.tracks.points() - self.pose[:3, 3]

    def surfaces(self, camera: Camera) -> F64:
        """`surfaces_around` the points, in the camera at the pose."""
        if self._surfaces is None:
            points = se3.transform(se3.inverse(self.pose), self.tracks.points())
            self._surfaces = surfaces_around(camera, self.tracks.uv, points)
        return self._surfaces

    def add(self, tracks: Tracks) -> None:
        """Replace the points by more, for the recovery."""
        self.tracks, self.dense, self._surfaces = tracks, True, None


class Follower:
    """Tracks points from the last image, with the windows of their first appearances."""

    def __init__(self, config: TrackerConfig, rig: Rig, area: VisibleArea, shutter: RollingShutter) -> None:
        self._config, self._area, self._shutter, self._camera = config, area, shutter, rig.left
        self._patches = Patches(STORED * config.max_features)
        self._last: klt.Pyramid | None = None
        self._reference: ReferenceImage | None = None
        self._view: tuple[Tracks, F64, F64, F64] | None = None  # the last result of `_seen_from`: points, pose, result
        self._coarse_rotation = CoarseRotation(rig.left, config.pyramid_levels)
        self._coarsest_level = config.pyramid_levels - 1
        self._first_level = self._coarsest_level  # of the pyramid, at which the search starts
        self._miss_px = np.inf  # median error of the predictions

    def follow(
        self, tracks: Tracks, last_pose: F64, pyramid: klt.Pyramid, expected: ExpectedMotion, blurred: bool = False
    ) -> Tracks:
        """The tracks of the last image, which has a pose (4, 4), found in the new left image, at their new pixels.

        `blurred`: points whose first appearance cannot be aligned stay where a translation from the last image ends.
        """
        guess = self._shutter.project(expected.pose, expected.velocity, tracks.points(), tracks.uv)
        guess = np.where(np.isfinite(guess), guess, tracks.uv)
        return self._find(tracks, last_pose, pyramid, expected.pose, guess, blurred)

    @property
    def reference(self) -> ReferenceImage:
        """The image from which tracking is recovered; there is one after the first trusted image."""
        assert self._reference is not None
        return self._reference

    def refer_to(self, images: StereoPyramids, tracks: Tracks, trusted: Bool, pose: F64, later: F64) -> None:
        """Keep an image with a trusted pose (4, 4) and its trusted points (N,) for recovery, if it is the better one.

        Whatever is about to cover the camera already hides a part of the last images. The better image is the one that
        shows more of what would be in view from the pose `later` (4, 4), if the robot went on unseen. Time does not
        count: who comes towards the robot hides the middle of the view for seconds.
        """
        image = ReferenceImage(images, tracks.keep(trusted), pose)
        if self._reference is None or self._in_view(image, later) >= self._in_view(self._reference, later):
            self._reference = image

    def _in_view(self, image: ReferenceImage, pose: F64) -> float:
        """How many points tracked in an image would be in view from a pose (4, 4), in no part more than make it count.

        They count by how similar they look: by the ratio of their distances and the cosine between their directions.
        """
        rays, now = image.rays, image.rays + (image.pose[:3, 3] - pose[:3, 3])
        uv = self._camera.project(now @ pose[:3, :3])
        longer = np.maximum(np.einsum("ni,ni->n", rays, rays), np.einsum("ni,ni->n", now, now))
        similarity = np.maximum(np.einsum("ni,ni->n", rays, now) / longer, 0.0)
        inside = self._area.inside(uv)
        cells = np.bincount(cells_of(uv[inside], self._camera.size), similarity[inside], math.prod(GRID))
        return float(np.minimum(cells, CELL_POINTS).sum())

    def forget(self) -> None:
        """Give up the reference image: a new odometry begins."""
        self._reference = None

    def renewed(self, reference: ReferenceImage) -> Tracks:
        """The points of the reference image, with their appearance in it instead of their first one."""
        rows, slots = self.begin(reference.images.left, reference.tracks.uv, reference.pose)
        tracks = reference.tracks.take(rows)
        tracks.slot, tracks.warp = slots, np.tile(np.eye(2), (len(rows), 1, 1))
        return tracks

    def find_again(self, pyramid: klt.Pyramid, pose: F64, reach: float, most: int) -> Tracks:
        """The reference image's points that are found from another, possibly distant pose (4, 4).

        Args:
            reach: of the search around the predicted pixels, as a share of the image's width.
            most: of the points that are looked for, evenly chosen.
        """
        tracks = self.reference.tracks
        guess, warps = self._seen_from(pose)
        rows = np.flatnonzero(self._visible(guess, warps))
        rows = rows[np.unique(np.linspace(0, len(rows) - 1, min(most, len(rows))).astype(np.int64))]
        tracks, warps = tracks.take(rows), np.ascontiguousarray(warps[:, rows])
        uv, warp = guess[rows].copy(), tracks.warp.copy()
        radius = max(round(0.5 * reach * self._camera.width), 1)
        step = math.ceil(radius / SEARCH_STEPS)
        ncc = find_deformed(
            pyramid[1], guess[rows], warps @ tracks.warp, tracks.slot, self._patches.windows.patch, radius, step, uv,
            warp,
        )  # fmt: skip
        self.search_widely()
        curvature = self._curvatures(tracks, self.reference.pose, pose)
        return self._kept(tracks, *self._align(pyramid, uv, warp, curvature, tracks.slot, ncc > MIN_COARSE_NCC))

    def recall(self, found: F64, pose: F64, seen: F64 | None = None, cells_needed: float = 1.0) -> float:
        """The share of the view from a pose (4, 4) where as many reference points are `found` (N, 2) px as should be.

        Fewer should be where their windows change much. Every cell of the image counts, not every point: a ceiling has
        many, and looks the same from lamp to lamp.

        Args:
            seen: (M, 3) metres in the camera, corners of the image: cells in which none of them is as far away as what
                should be there are covered, and do not count; if that leaves no less.
            cells_needed: number of cells of the image in which all points must be found for a recall of 1, at least.
        """
        uv, warps = self._seen_from(pose)
        visible = self._visible(uv, warps)
        cell, cells = cells_of(uv[visible], self._camera.size), math.prod(GRID)
        change = np.abs(np.log(np.linalg.norm(warps[:, visible], axis=(2, 3)) / math.sqrt(2.0)))
        wanted: F64 = np.asarray(np.bincount(cell, np.exp(-np.nanmin(change, axis=0)), cells), np.float64)
        views = [wanted]
        if seen is not None:
            distance = np.linalg.norm(se3.transform(se3.inverse(pose), self.reference.tracks.points()[visible]), axis=1)
            nearest = np.full(cells, np.inf)
            np.minimum.at(nearest, cell, distance)
            at = cells_of(self._camera.project(seen), self._camera.size)
            open_view = np.linalg.norm(seen, axis=1) >= NEARER * nearest[at]
            views.append(np.where(np.bincount(at[open_view], minlength=cells) > 0, wanted, 0.0))
        again: F64 = np.asarray(np.bincount(cells_of(found, self._camera.size), minlength=cells), np.float64)
        return max(_agreement(again, view, cells_needed) for view in views)

    def _seen_from(self, pose: F64) -> tuple[F64, F64]:
        """Pixels (N, 2) of the reference points, NaN behind the camera, and their deformations since (3, N, 2, 2)."""
        reference, tracks = self.reference, self.reference.tracks
        if self._view is None or self._view[0] is not tracks or not np.array_equal(self._view[1], pose):
            uv = self._shutter.project(pose, np.zeros(6), tracks.points(), tracks.uv)
            warps = plane_warps(self._camera, reference.surfaces(self._camera), se3.inverse(pose) @ reference.pose)
            self._view = tracks, pose, uv, warps
        return self._view[2:]

    def _visible(self, uv: F64, warps: F64) -> Bool:
        """(N,) points whose pixels (N, 2) are in the image, and one of whose deformations (3, N, 2, 2) is moderate."""
        inside = np.isfinite(uv[:, 0])
        inside[inside] = self._area.inside(uv[inside])
        return inside & np.isfinite(warps).all(axis=(2, 3)).any(axis=0)

    def _find(
        self, tracks: Tracks, last_pose: F64, pyramid: klt.Pyramid, pose: F64, guess: F64, blurred: bool
    ) -> Tracks:
        """Find points of the last image in another, taken at about a pose (4, 4), starting at guesses (N, 2) px.

        Where the predictions are good, first appearances are aligned from there; what that misses, and all points
        otherwise, is first followed by translation from the last image.
        """
        near = np.full(len(guess), self._miss_px < ALIGNED_PX)
        warp, curvature = tracks.warp, self._curvatures(tracks, last_pose, pose)
        uv, deformed, found = self._align(pyramid, guess, warp, curvature, tracks.slot, near)
        missed = np.flatnonzero(~found)
        if len(missed):
            moved, followed = self._translate(tracks.uv[missed], pyramid, guess[missed])
            aligned = self._align(pyramid, moved, warp[missed], curvature[missed], tracks.slot[missed], followed)
            uv[missed], deformed[missed], found[missed] = aligned
            if blurred:
                kept = followed & ~aligned[2]
                rows = missed[kept]
                uv[rows], deformed[rows], found[rows] = moved[kept], warp[rows], True
        self._miss_px = median_distance(uv, guess, found)
        return self._kept(tracks, uv, deformed, found)

    def _kept(self, tracks: Tracks, uv: F64, warp: F64, found: Bool) -> Tracks:
        """The tracks that are found (N,) and in view, at pixels (N, 2) with deformations (N, 2, 2)."""
        found = found & self._area.inside(uv)
        out = tracks.keep(found)
        out.uv, out.warp = uv[found], warp[found]
        return out

    def _translate(self, uv: F64, pyramid: klt.Pyramid, guess: F64) -> tuple[F64, Bool]:
        """Pixels (N, 2) of points (N, 2) px of the last image, and which of them are found."""
        assert self._last is not None
        config = self._config
        moved = klt.track_translation(
            self._last, pyramid, uv, guess, self._first_level, 0, config.min_contrast, config.min_ncc, klt.WEIGHTS
        )
        return moved, np.isfinite(moved[:, 0])

    def _curvatures(self, tracks: Tracks, last_pose: F64, pose: F64) -> F64:
        """(N, 6) the quadratic parts of the deformations in an image at a pose (4, 4); warps are of the last."""
        out, store = np.empty((len(tracks), 6)), self._patches
        last_pose, pose = np.ascontiguousarray(last_pose), np.ascontiguousarray(pose)
        window_curvatures(
            tracks.slot, store.rays, store.origin, tracks.points(), tracks.warp, last_pose, pose, self._camera.model_id,
            self._camera.params, out,
        )  # fmt: skip
        return out

    def _align(
        self, pyramid: klt.Pyramid, uv: F64, warp: F64, curvature: F64, slots: I64, wanted: Bool
    ) -> tuple[F64, F64, Bool]:
        """Align first appearances with an image: pixels (N, 2), deformations (N, 2, 2), which are found (N,)."""
        uv, warp = uv.copy(), warp.copy()
        ncc = klt.track_affine(
            pyramid[0], uv, warp, curvature, slots, wanted, self._patches.windows, 6, klt.WEIGHTS, klt.COORDINATES
        )
        return uv, warp, np.asarray(ncc > self._config.min_anchor_ncc)

    def turned(
        self, pyramid: klt.Pyramid, expected: ExpectedMotion, last_pose: F64, anywhere: bool = False
    ) -> ExpectedMotion:
        """The expected motion with the rotation that aligns the coarsest images; the search starts at the top level.

        `anywhere`: the best of all rotations, not the one near the expected.
        """
        assert self._last is not None
        if anywhere:
            cur_R_prev = self._coarse_rotation.search(self._last, pyramid)
        else:
            expected_R = expected.pose[:3, :3].T @ last_pose[:3, :3]
            cur_R_prev = self._coarse_rotation.align(self._last, pyramid, expected_R)
        self.search_widely()
        pose = se3.from_rotation_translation(last_pose[:3, :3] @ cur_R_prev.T, expected.pose[:3, 3])
        pose = se3.orthonormalize(pose)
        return replace(expected, pose=pose, moved=se3.log(se3.inverse(last_pose) @ pose))

    def search_widely(self) -> None:
        """Start the next search at the top level, for an unreliable prediction."""
        self._first_level, self._miss_px = self._coarsest_level, np.inf

    def accept(self, pyramid: klt.Pyramid, tracks: Tracks) -> None:
        """Track the next image from this one; appearances of other points are dropped."""
        self._last = pyramid
        self._first_level = 1 if self._miss_px < WELL_PREDICTED_PX else self._coarsest_level
        self.keep_only(tracks)

    def begin(self, pyramid: klt.Pyramid, uv: F64, pose: F64) -> tuple[I64, I64]:
        """Store the appearance of new points (N, 2) px in an image at a pose (4, 4).

        Returns rows (M,) of those with texture and a slot, and their slots.
        """
        store = self._patches
        slots = store.take(len(uv))
        textured = klt.make_patches(pyramid[0], uv[: len(slots)], slots, store.windows, klt.WEIGHTS, klt.COORDINATES)
        store.rays[slots] = window_rays(self._camera, uv[: len(slots)], pose[:3, :3])
        store.origin[slots] = pose[:3, 3]
        return np.flatnonzero(textured), slots[textured]

    def keep_only(self, tracks: Tracks) -> None:
        """Drop the first appearances of all points that are neither in `tracks` nor of the reference image."""
        reference = tracks.slot if self._reference is None else self._reference.tracks.slot
        self._patches.keep_only(np.concatenate([tracks.slot, reference]))


def _agreement(found: F64, wanted: F64, cells_needed: float) -> float:
    """The share of the cells (N,) in which as many points are found as wanted; one with many counts no more."""
    weight = 1.0 / np.maximum(wanted, CELL_POINTS)
    return float((weight * np.minimum(found, wanted)).sum() / max((weight * wanted).sum(), cells_needed))
