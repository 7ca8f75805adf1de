"""Which pixels of a recording show no world: what stays in place while the camera turns, and what is always dark.

Two images taken at headings so far apart that even the most distant scenery has moved by many pixels are compared at
the same pixels, by normalised correlation of small windows. What correlates in every such pair is fixed to the camera:
the robot's edge, a rail, dirt. Translation alone would not do, since along an aisle the distance stays in place.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import cv2
import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.types import F32, F64, U8, Bool

WIDEST = 640  # px: wider images are halved
WINDOW = 5  # px, side of the compared windows: a thin rail fills it
TURNED_DEG = 8.0  # between two compared images: many times the window, whichever the lens
MAX_IMAGES = 80  # kept of a recording
MAX_PAIRS = 120
MIN_VOTES = 10  # pairs in which a window has texture in both images
SIMILAR, ALWAYS = 0.75, 0.9  # correlation of windows that show the same, and the share of the pairs in which they do
TEXTURE = 4.0  # grey levels, standard deviation in a window: well above a sensor's noise
PLAIN_SHARE = 0.9  # of the images, in which a part of the robot without texture has none
DARK, DARK_QUANTILE = 0.12, 0.95  # of the median brightness; the share of images in which it is darker
SMALLEST = 0.0005  # of the image, below which a part is taken for chance
MARGIN_PX = 3  # around what was found: half a window


@dataclass(frozen=True, eq=False)
class FoundMask:
    """Of one camera, at the size of its images; `used` is what a `Rig` takes."""

    used: Bool  # (H, W)
    fixed: Bool  # (H, W) stays in place while the camera turns
    dark: Bool  # (H, W) always dark


class MaskSearch:
    """Collects images and rotations of a recording, then finds the masks of its cameras."""

    def __init__(self) -> None:
        self._rotations: list[F64] = []
        self._submaps: list[int] = []
        self._images: list[tuple[U8, ...]] = []
        self._seen, self._every = 0, 1
        self._sizes: list[tuple[int, int]] = []

    def add(self, images: tuple[U8, ...], world_R_cam: F64, submap_id: int = 0) -> None:
        """The images (H, W) of the cameras at one time, and the left camera's rotation (3, 3) in its submap.

        Images are kept evenly spread: when there are too many, every other one is dropped.
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
        """Kept images whose headings differ enough, spread over the recording."""
        if not self._rotations:
            return []
        axes = np.array([r[:, 2] for r in self._rotations])
        turned = np.degrees(np.arccos(np.clip(axes @ axes.T, -1, 1))) > TURNED_DEG
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
            StereoSfmError: the camera has not turned enough to tell the robot from distant scenery.
        """
        pairs = self.pairs
        if len(pairs) < MIN_VOTES:
            raise StereoSfmError(
                f"the camera turns too little in this recording to tell the robot from distant scenery: {len(pairs)} "
                f"pairs of images differ in heading by {TURNED_DEG:g} degrees; record a drive with a turn"
            )
        return [_found([images[k] for images in self._images], pairs, size) for k, size in enumerate(self._sizes)]


def masked(rig: Rig, found: list[FoundMask]) -> Rig:
    """The rig with the masks found, within those that it has.

    Raises:
        StereoSfmError: the masks leave nothing to see.
    """
    own = (rig.left_mask, rig.right_mask)
    both = [f.used if mask is None else f.used & mask for f, mask in zip(found, own, strict=False)]
    return replace(rig, left_mask=both[0], right_mask=both[1] if len(both) > 1 else None)


def _reduced(image: U8) -> U8:
    if image.shape[1] <= WIDEST:
        return image.copy()
    return np.asarray(cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), np.uint8)


def _moments(image: U8) -> tuple[F32, F32, F32]:
    """The image, and mean and standard deviation of the window around each pixel."""
    grey = image.astype(np.float32)
    mean = cv2.blur(grey, (WINDOW, WINDOW))
    variance = np.maximum(cv2.blur(grey * grey, (WINDOW, WINDOW)) - mean * mean, 0)
    return grey, np.asarray(mean, np.float32), np.sqrt(variance).astype(np.float32)


def _found(images: list[U8], pairs: list[tuple[int, int]], size: tuple[int, int]) -> FoundMask:
    moments = [_moments(image) for image in images]
    fixed = _fixed(moments, pairs)
    plain = np.mean([deviation < TEXTURE for _, _, deviation in moments], axis=0) > PLAIN_SHARE
    means = np.array([mean for _, mean, _ in moments])
    dark = np.quantile(means, DARK_QUANTILE, axis=0) < DARK * np.median(means)
    rim = cv2.dilate(dark.astype(np.uint8), np.ones((2 * WINDOW + 1,) * 2, np.uint8)) > 0
    part = _closed(fixed & ~rim, plain & ~dark)
    hidden = cv2.dilate((part | dark).astype(np.uint8), np.ones((2 * MARGIN_PX + 1,) * 2, np.uint8)) > 0
    return FoundMask(~_enlarged(hidden, size), _enlarged(part, size), _enlarged(dark, size))


def _enlarged(mask: Bool, size: tuple[int, int]) -> Bool:
    return cv2.resize(mask.astype(np.uint8), size[::-1], interpolation=cv2.INTER_NEAREST) > 0


def _fixed(moments: list[tuple[F32, F32, F32]], pairs: list[tuple[int, int]]) -> Bool:
    """(H, W) pixels whose windows correlate in nearly all pairs in which they have texture."""
    shape = moments[0][0].shape
    votes, alike = np.zeros(shape, np.int32), np.zeros(shape, np.int32)
    for i, j in pairs:
        (a, mean_a, deviation_a), (b, mean_b, deviation_b) = moments[i], moments[j]
        textured = (deviation_a > TEXTURE) & (deviation_b > TEXTURE)
        together = cv2.blur(a * b, (WINDOW, WINDOW)) - mean_a * mean_b
        votes += textured
        alike += textured & (together > SIMILAR * deviation_a * deviation_b)
    return (votes >= MIN_VOTES) & (alike > ALWAYS * votes)


def _closed(fixed: Bool, plain: Bool) -> Bool:
    """The fixed parts with the plain surfaces between them, without small ones."""
    element = np.ones((WINDOW, WINDOW), np.uint8)
    part = cv2.morphologyEx(fixed.astype(np.uint8), cv2.MORPH_CLOSE, element)
    part = np.asarray(part, np.uint8) | _enclosed(plain, part > 0)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(part)
    large = np.flatnonzero(stats[:, cv2.CC_STAT_AREA] >= SMALLEST * part.size)
    return np.isin(labels, large[large > 0]) if count > 1 else np.zeros_like(fixed)


def _enclosed(plain: Bool, part: Bool) -> U8:
    """(H, W) 1 in the plain surfaces whose outline lies along the part, for the most part of it."""
    count, labels = cv2.connectedComponents(plain.astype(np.uint8))
    element = np.ones((3, 3), np.uint8)
    outline = plain & (cv2.erode(plain.astype(np.uint8), element) == 0)
    beside = outline & (cv2.dilate(part.astype(np.uint8), element, iterations=WINDOW) > 0)
    length, along = (np.bincount(labels[m], minlength=count) for m in (outline, beside))
    enclosed = np.flatnonzero(along > 0.5 * np.maximum(length, 1))
    return np.isin(labels, enclosed[enclosed > 0]).astype(np.uint8)
