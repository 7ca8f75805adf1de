"""Masks from a recording: pixels that stay the same while the camera turns, and pixels that are always dark.

Pairs of images whose headings differ so much that even distant scenery moves by many pixels are compared at the same
pixels, by normalised correlation of small windows. What correlates in nearly all pairs is fixed to the camera: the
robot's edge, a rail, dirt. Translation alone is not enough: along an aisle, distant scenery stays in place. The windows
of a part that is plain, or thinner than they are, do not correlate, but its pixels keep their values: each part found
grows over the adjacent pixels that do.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import cv2
import numpy as np

from stereo_sfm.calib.mask import uncovered
from stereo_sfm.calib.rig import Rig
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.types import F32, F64, U8, Bool, Frame, Keyframe, StereoImage, TrackState

MAX_WIDTH = 640  # px: wider images are halved
WINDOW = 5  # px, side of the compared windows; as wide as a thin rail in the image
MIN_TURN_DEG = 8.0  # between two compared images: many times the window, with any lens
MAX_IMAGES = 80  # kept of a recording
MAX_PAIRS = 120
MIN_VOTES = 10  # pairs in which a window has texture in both images
MIN_CORRELATION = 0.75  # of windows that show the same surface
MIN_SHARE = 0.9  # of the pairs, in which the windows of a fixed part correlate
TEXTURE = 4.0  # grey levels, standard deviation in a window: well above a sensor's noise
PLAIN_SHARE = 0.9  # of the images, in which a plain part of the robot has no texture
DARK, DARK_QUANTILE = 0.12, 0.95  # of the median brightness; share of the images in which a dark pixel is below it
MIN_PART = 0.0005  # of the image; smaller parts are ignored as chance
STILL = 0.25  # of the view's median spread of a pixel's values; what is fixed to the camera varies less
STILL_QUANTILES = 0.1, 0.9  # between them lies a pixel's spread: a hand on the robot now and then is no change
CONTOUR_PX = 1  # added around the parts found: pixels that show both the part and the scene
PENUMBRA_PX = 3  # added around what is dark: an image circle ends softly


@dataclass(frozen=True, eq=False)
class FoundMask:
    """Masks of one camera, at the size of its images; `used` is the one for a `Rig`."""

    used: Bool  # (H, W) neither fixed nor dark
    fixed: Bool  # (H, W) the same while the camera turns
    dark: Bool  # (H, W) always dark


class MaskSearch:
    """Collects images and camera rotations of a recording, then finds the masks of its cameras."""

    def __init__(self) -> None:
        self._rotations: list[F64] = []
        self._submaps: list[int] = []
        self._submap_id = 0  # of the last keyframe
        self._images: list[tuple[U8, ...]] = []
        self._seen, self._every = 0, 1
        self._sizes: list[tuple[int, int]] = []

    def add_tracked(self, image: StereoImage, frame: Frame, keyframe: Keyframe | None) -> None:
        """An image with what a tracker made of it; images before and after a loss of tracking are not compared."""
        self._submap_id = self._submap_id if keyframe is None else keyframe.submap_id
        if frame.state in (TrackState.OK, TrackState.RECOVERED):
            images = (image.left,) if image.right is None else (image.left, image.right)
            self.add(images, frame.odom_T_cam[:3, :3], self._submap_id)

    def add(self, images: tuple[U8, ...], world_R_cam: F64, submap_id: int = 0) -> None:
        """Add the images (H, W) of the cameras at one time, and the left camera's rotation (3, 3) in its submap.

        At most MAX_IMAGES are kept, evenly spread: beyond that, every other one is dropped.
        """
        if self._seen % self._every == 0:
            self._sizes = [image.shape[:2] for image in images]
            self._rotations.append(world_R_cam)
            self._submaps.append(submap_id)
            self._images.append(tuple(_reduced(image) for image in images))
            if len(self._images) > MAX_IMAGES:
                self._rotations, self._submaps = self._rotations[::2], self._submaps[::2]
                self._images = self._images[::2]
                self._every *= 2
        self._seen += 1

    @property
    def pairs(self) -> list[tuple[int, int]]:
        """Indices of kept images whose headings differ by more than MIN_TURN_DEG; at most MAX_PAIRS, evenly spread."""
        if not self._rotations:
            return []
        axes = np.array([r[:, 2] for r in self._rotations])
        turned = np.degrees(np.arccos(np.clip(axes @ axes.T, -1, 1))) > MIN_TURN_DEG
        turned &= np.equal.outer(self._submaps, self._submaps)
        found = [(i, j) for i, j in itertools.combinations(range(len(axes)), 2) if turned[i, j]]
        step = max(1, -(-len(found) // MAX_PAIRS))
        return found[::step]

    @property
    def turned(self) -> bool:
        """Whether the camera has turned enough for `find`."""
        return len(self.pairs) >= MIN_VOTES

    def find(self) -> list[FoundMask]:
        """The masks, one for each camera.

        Raises:
            StereoSfmError: the camera has not turned enough to distinguish the robot from distant scenery.
        """
        pairs = self.pairs
        if len(pairs) < MIN_VOTES:
            raise StereoSfmError(
                f"the camera turns too little to distinguish the robot from distant scenery: {len(pairs)} pairs "
                f"of images differ in heading by {MIN_TURN_DEG:g} degrees; record a drive with a turn"
            )
        return [_found([images[k] for images in self._images], pairs, size) for k, size in enumerate(self._sizes)]


def masked(rig: Rig, found: list[FoundMask]) -> Rig:
    """The rig with the masks found; pixels that its own masks exclude stay excluded.

    Raises:
        StereoSfmError: the masks leave no pixel.
    """
    own = (rig.left_mask, rig.right_mask)
    both = [f.used if mask is None else f.used & mask for f, mask in zip(found, own, strict=False)]
    return replace(rig, left_mask=both[0], right_mask=both[1] if len(both) > 1 else None)


def _reduced(image: U8) -> U8:
    """The image, halved if it is wide."""
    if image.shape[1] <= MAX_WIDTH:
        return image.copy()
    return np.asarray(cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), np.uint8)


@dataclass(frozen=True, eq=False)
class Moments:
    """An image, and the mean and standard deviation of the window around each pixel; all (H, W)."""

    grey: F32
    mean: F32
    deviation: F32

    def compared(self, other: Moments, texture: float = TEXTURE) -> tuple[Bool, Bool]:
        """(H, W) whether the windows have texture in both images, and whether they also show the same surface."""
        textured = (self.deviation > texture) & (other.deviation > texture)
        covariance = cv2.blur(self.grey * other.grey, (WINDOW, WINDOW)) - self.mean * other.mean
        return textured, textured & (covariance > MIN_CORRELATION * self.deviation * other.deviation)


def moments(image: U8) -> Moments:
    """Of an image (H, W)."""
    grey = image.astype(np.float32)
    mean = cv2.blur(grey, (WINDOW, WINDOW))
    variance = np.maximum(cv2.blur(grey * grey, (WINDOW, WINDOW)) - mean * mean, 0)
    return Moments(grey, np.asarray(mean, np.float32), np.sqrt(variance).astype(np.float32))


class FixedVotes:
    """Counts in how many pairs of images each window has texture, and looks the same."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self.votes, self.matching = np.zeros(shape, np.int32), np.zeros(shape, np.int32)
        self.pairs = 0

    def add(self, textured: Bool, matching: Bool) -> None:
        """A pair, as `Moments.compared` gives it."""
        self.votes += textured
        self.matching += matching
        self.pairs += 1

    def fixed(self, min_votes: int) -> Bool:
        """(H, W) whose windows look the same in nearly all of so many pairs or more in which they have texture."""
        return (self.votes >= min_votes) & (self.matching > MIN_SHARE * self.votes)


def _found(images: list[U8], pairs: list[tuple[int, int]], size: tuple[int, int]) -> FoundMask:
    found = [moments(image) for image in images]
    votes = FixedVotes(found[0].grey.shape)
    for i, j in pairs:
        votes.add(*found[i].compared(found[j]))
    fixed = votes.fixed(MIN_VOTES)
    plain = np.mean([one.deviation < TEXTURE for one in found], axis=0) > PLAIN_SHARE
    means = np.array([one.mean for one in found])
    dark = np.quantile(means, DARK_QUANTILE, axis=0) < DARK * np.median(means)
    rim = ~uncovered(~dark, WINDOW)
    part = _closed(fixed & ~rim, plain & ~dark)
    part = _grown(part, _still(images, ~rim))
    used = uncovered(~part, CONTOUR_PX) & uncovered(~dark, PENUMBRA_PX)
    return FoundMask(_enlarged(used, size), _enlarged(part, size), _enlarged(dark, size))


def _enlarged(mask: Bool, size: tuple[int, ...]) -> Bool:
    """The mask of a reduced image at the size (H, W) of the original."""
    return cv2.resize(mask.astype(np.uint8), size[::-1], interpolation=cv2.INTER_NEAREST) > 0


def _still(images: list[U8], lit: Bool) -> Bool:
    """(H, W) lit pixels whose values in the images (H, W), at equal exposure, vary much less than the view's do."""
    exposure = np.array([max(float(np.median(image[lit])), 1.0) for image in images], np.float32)
    values = np.array(images, np.float32) * (np.median(exposure) / exposure)[:, None, None]
    low, high = np.quantile(values, STILL_QUANTILES, axis=0)
    spread = high - low
    return lit & (spread < STILL * np.median(spread[lit]))


def _grown(part: Bool, still: Bool) -> Bool:
    """The part with the still pixels that are connected to it."""
    labels = cv2.connectedComponents((part | still).astype(np.uint8), connectivity=4)[1]
    return np.isin(labels, np.unique(labels[part]))


def _closed(fixed: Bool, plain: Bool) -> Bool:
    """The fixed parts and the plain surfaces between them, without small parts."""
    element = np.ones((WINDOW, WINDOW), np.uint8)
    part = cv2.morphologyEx(fixed.astype(np.uint8), cv2.MORPH_CLOSE, element)
    part = np.asarray(part, np.uint8) | _enclosed(plain, part > 0)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(part)
    large = np.flatnonzero(stats[:, cv2.CC_STAT_AREA] >= MIN_PART * part.size)
    return np.isin(labels, large[large > 0]) if count > 1 else np.zeros_like(fixed)


def _enclosed(plain: Bool, part: Bool) -> U8:
    """(H, W) 1 in the plain surfaces more than half of whose outline lies along the part."""
    count, labels = cv2.connectedComponents(plain.astype(np.uint8))
    element = np.ones((3, 3), np.uint8)
    outline = plain & (cv2.erode(plain.astype(np.uint8), element) == 0)
    near_part = outline & (cv2.dilate(part.astype(np.uint8), element, iterations=WINDOW) > 0)
    length, along = (np.bincount(labels[m], minlength=count) for m in (outline, near_part))
    enclosed = np.flatnonzero(along > 0.5 * np.maximum(length, 1))
    return np.isin(labels, enclosed[enclosed > 0]).astype(np.uint8)
