"""Places that stick to the image: projector dots, dirt on a lens, the robot's own edge, text drawn into the images.

Windows of a few images, far enough apart for the camera to have moved, are compared at the same pixels. Pairs of images
count in which most of the view changes everywhere: neither a camera at rest nor somebody who passes it does that. What
looks the same in nearly all of them belongs to the camera.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Iterable, Sequence
from dataclasses import replace

import cv2
import numpy as np

from stereo_sfm.calib.mask import half_size, uncovered
from stereo_sfm.calib.mask_search import (
    CONTOUR_PX,
    DARK,
    MIN_VOTES,
    WINDOW,
    FixedVotes,
    moments,
)
from stereo_sfm.calib.rig import Rig
from stereo_sfm.calib.start import StartFinding, exposure
from stereo_sfm.types import U8, Bool, StereoImage

IMAGES, WITHIN = 8, 150  # looked at, among so many first ones; they are denser in the beginning
MIN_S = 2.0  # from the first image to the last: in less a slow robot moves by less than a window
PAIRS_BEFORE_NOTHING = 3  # images of which so many pairs show no change, or nothing that stays, end the search
CELLS = 8  # of the image, in each direction
STRONG = 12.0  # grey levels, standard deviation in windows that tell whether the view changes: no noise hides them
CHANGED, CHANGED_CELLS = 0.02, 0.5  # of a cell's windows, and of the cells that have such windows
MIN_WINDOWS = WINDOW * WINDOW // 2  # connected, of a part: half of those that show a spot of one pixel
LEAST = 1e-3  # of the image; less than a robot's edge or a drop hides is chance
CORNER_PX, MIN_ROUND = 9, 0.1  # px, and ratio of the squared gradients across: less is an edge
MOVING = 0.75  # of the pairs, in which the view of a camera changes that does not rest for half of the images
GAP_PX = 3  # between a part and its surroundings: windows that show both
SAME_AROUND = 0.4  # of the windows around a part; as many look the same by chance and texture
MIN_LEFT = 0.3  # of the image, where a tracked window shows nothing that sticks: with less, nothing can be masked
TRACKED_PX = 7  # half of a tracked window, in the half-size image
REPEATED = 3  # images of a side that are equal to the last bit, which sensor noise does not allow
MASK = "'stereo-sfm mask SOURCE -o mask.png' writes a mask for all its recordings"


def positions(count: int | None) -> list[int]:
    """Of the images to look at, ascending; `count` is the number of images, None if it is not known."""
    last = min(count or WITHIN, WITHIN) - 1
    return sorted({round(last * (k / (IMAGES - 1)) ** 1.5) for k in range(IMAGES)})


def sticking(images: Iterable[StereoImage], masks: Sequence[Bool | None] = (None, None)) -> list[Bool]:
    """(H, W) of each camera, True where something sticks to the image; empty if nothing does, or they cannot tell.

    Args:
        images: of the same cameras, in order; no more are read than needed.
        masks: (H, W) of the cameras, True where an image is used; elsewhere nothing counts.
    """
    cameras: list[_Camera] = []
    begin_ns = end_ns = None
    for image in images:
        begin_ns, end_ns = image.stamp_ns if begin_ns is None else begin_ns, image.stamp_ns
        views = [image.left] if image.right is None else [image.left, image.right]
        cameras = cameras or [_Camera(mask) for _, mask in zip(views, masks, strict=False)]
        for camera, view in zip(cameras, views, strict=False):
            camera.add(view)
            if camera.rests:
                return []
        if all(camera.empty for camera in cameras):
            return []
    if begin_ns is None or end_ns is None or end_ns - begin_ns < MIN_S * 1e9:
        return []
    if not all(camera.moves for camera in cameras):
        return []
    parts = [camera.part() for camera in cameras]
    return parts if any(part.any() for part in parts) else []


def with_sticking(finding: StartFinding, rig: Rig, images: Iterable[StereoImage]) -> StartFinding:
    """What the start check found of a calibration, with what sticks to these images; its rig has masks of that. Nothing
    else counts if one camera stands still.

    Raises:
        StereoSfmError: of the images.
    """
    first, images = itertools.tee(images)
    side = still_side(first)
    if side:
        other = "right" if side == "left" else "left"
        return StartFinding(f"the {side} camera repeats one image while the {other} one moves: check it", shown=True)
    parts = sticking(images, (rig.left_mask, rig.right_mask))
    if not parts:
        return finding
    shares = [
        f"{100 * part.mean():.1f} % of the {side} image"
        for part, side in zip(parts, ("left", "right"), strict=False)
        if part.any()
    ]
    text = f"{' and '.join(shares)} sticks to the image while the rest moves (projector dots, dirt, the robot itself)"
    masked = without_sticking(rig, parts)
    if masked is None:
        text = f"{text}: too much to be masked: turn the projector off, or clean the lens"
    if finding.text:
        corrected = None if finding.rig is None else without_sticking(finding.rig, parts)
        text = f"{finding.text}; and {text}"
        masked = masked if corrected is not None or not finding.shown else None  # which would not mend a mistake
        return replace(finding, text=text, rig=corrected or finding.rig, shown=True, masked=masked)
    return replace(finding, text=text, shown=True, advice=MASK, masked=masked)


def still_side(images: Iterable[StereoImage]) -> str:
    """Which camera, "left" or "right", repeats one image while the other's view changes; "" if neither does.

    Args:
        images: of the same cameras, in order; no more are read than needed.
    """
    begin: list[U8] = []
    for number, image in enumerate(images, 1):
        if image.right is None:
            return ""
        views = [image.left, image.right]
        begin = begin or views
        same = [np.array_equal(a, b) for a, b in zip(begin, views, strict=True)]
        if number > 1 and same[0] == same[1]:
            return ""
        if number >= REPEATED and not exposure([views[same.index(True)]]):
            old, new = (moments(one[same.index(False)]) for one in (begin, views))
            if _view_changes(*old.compared(new, STRONG)):
                return ("left", "right")[same.index(True)]
    return ""


def without_sticking(rig: Rig, parts: Sequence[Bool]) -> Rig | None:
    """The rig with masks of these places too; None if they leave too little of an image."""
    own = (rig.left_mask, rig.right_mask)
    masks = [
        uncovered(~part, CONTOUR_PX) & (True if mask is None else mask) for part, mask in zip(parts, own, strict=False)
    ]
    if any(uncovered(half_size(mask), TRACKED_PX).mean() < MIN_LEFT for mask in masks):
        return None
    return replace(rig, left_mask=masks[0], right_mask=masks[1] if len(masks) > 1 else rig.right_mask)


class _View:
    """An image and what it is compared by."""

    def __init__(self, image: U8) -> None:
        self._image, self.moments = image, moments(image)

    @functools.cached_property
    def corners(self) -> Bool:
        """(H, W) what is no straight edge: one along the motion shows the same for as long as the camera drives."""
        eigen = np.asarray(cv2.cornerEigenValsAndVecs(self._image, CORNER_PX, 3))[..., :2]
        return eigen.min(-1) > MIN_ROUND * eigen.max(-1)


class _Camera:
    """What all counted pairs of one camera's images have in common."""

    def __init__(self, mask: Bool | None) -> None:
        self._mask, self._seen = mask, list[_View]()
        self._votes: FixedVotes | None = None

    def add(self, image: U8) -> None:
        if exposure([image]):
            return  # what sticks is all that it may show
        new = _View(image)
        self._votes = self._votes or FixedVotes(image.shape)
        for old in self._seen:
            if _view_changes(*old.moments.compared(new.moments, STRONG)):
                both = new.corners & old.corners
                textured, matching = old.moments.compared(new.moments)
                self._votes.add(textured & both, matching & both)
        self._seen.append(new)

    @property
    def empty(self) -> bool:
        """Whether enough pairs were compared to know that nothing sticks."""
        pairs = self._votes.pairs if self._votes is not None else 0
        return pairs >= PAIRS_BEFORE_NOTHING and not self.part(PAIRS_BEFORE_NOTHING).any()

    @property
    def rests(self) -> bool:
        """Whether the first images all show the same."""
        none = self._votes is None or not self._votes.pairs
        return none and len(self._seen) * (len(self._seen) - 1) // 2 >= PAIRS_BEFORE_NOTHING

    @property
    def moves(self) -> bool:
        """Whether the view changes in most pairs: something that passes a camera at rest changes it in some."""
        pairs = len(self._seen) * (len(self._seen) - 1) // 2
        return self._votes is not None and self._votes.pairs > MOVING * pairs

    def part(self, min_votes: int = MIN_VOTES) -> Bool:
        """(H, W) what the windows that stay cover, off the rim of what is masked, or dark, such as a fisheye's: no
        corners lie there; nothing if it is too small."""
        assert self._votes is not None
        brightest = np.maximum.reduce([one.moments.mean for one in self._seen])
        lit = brightest > DARK * np.median(brightest)
        lit = uncovered(lit if self._mask is None else lit & self._mask, WINDOW)
        windows = _parts(self._votes.fixed(min_votes), lit, self._votes)
        return ~uncovered(~windows, WINDOW // 2) if windows.mean() > LEAST else np.zeros_like(windows)


def _view_changes(textured: Bool, matching: Bool) -> bool:
    """Whether a part of most cells that have texture (H, W) does not match."""
    share, changed = (
        np.asarray(cv2.resize(one.astype(np.float32), (CELLS, CELLS), interpolation=cv2.INTER_AREA))
        for one in (textured, textured & ~matching)
    )
    telling = share > CHANGED
    return bool(telling.any()) and float((changed > CHANGED)[telling].mean()) > CHANGED_CELLS


def _parts(stays: Bool, lit: Bool, votes: FixedVotes) -> Bool:
    """The parts of enough windows that end sharply: around what sticks, the view changes as it does everywhere.

    Far scenery ahead of a camera that drives straight on stays, too, but its surroundings stay nearly as well.
    """
    _, labels, stats, _ = cv2.connectedComponentsWithStats((stays & lit).astype(np.uint8))
    near = uncovered(~stays, GAP_PX) & lit
    around = cv2.dilate(labels.astype(np.float32), np.ones((2 * (GAP_PX + WINDOW) + 1,) * 2, np.uint8)).astype(np.int32)
    seen, same = (
        np.bincount(around[near], weights=one[near], minlength=len(stats)) for one in (votes.votes, votes.matching)
    )
    kept = (stats[:, cv2.CC_STAT_AREA] >= MIN_WINDOWS) & (same <= SAME_AROUND * seen)
    return np.isin(labels, np.flatnonzero(kept)[np.flatnonzero(kept) > 0])
