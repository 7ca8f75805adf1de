"""A lens model that the images contradict: the same numbers under the name of another model, or no numbers at all.

The epipolar curves of a wrong model are right in the middle of the images and wrong further out, so the row errors of
the outer half of the matches judge it. Each other model is tried for both cameras and for one of them. It is found if
it at least halves these errors in every pair; noise of the matches alone is the same under all models.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.calib.tracks import MIN_POINTS, Window
from stereo_sfm.calib.wrong_rig import LIMIT_PX, MIN_GAIN, row_errors
from stereo_sfm.geometry.cameras import Camera, KannalaBrandt, Pinhole, RadTan
from stereo_sfm.types import F64


@dataclass(frozen=True, eq=False)
class OtherLens:
    """Lenses that the images fit better than those of the calibration."""

    text: str
    rig: Rig
    known: bool  # whether their coefficients are the given ones; False: there are none, so that this is a guess
    fits: bool = True  # the rows, as a tracker needs it; False: much better than the given ones, and yet not well


@dataclass(frozen=True)
class _Reading:
    """Another way to read the numbers of a lens."""

    name: str
    lens: Camera
    known: bool  # it uses all given coefficients


def other_lens(rig: Rig, windows: Sequence[Window]) -> OtherLens | None:
    """Lenses with which the rows of these pairs fit much better; None if there are none, or too few matches.

    Args:
        rig: two cameras. windows: of one moment each, with matches found with this rig.
    """
    parts = [part for window in windows for part in _outer_halves(rig, window)]
    if not parts or rig.right is None:
        return None
    given = _medians(rig, parts)
    tried = [(one, _medians(one.rig, parts)) for one in _others(rig)]
    fitting = [
        (one, float(px.max()))
        for one, px in tried
        if (px < given / MIN_GAIN).all() and (px.max() < LIMIT_PX or not one.known)  # a guess is only said
    ]
    if not fitting:
        return None
    best, best_px = min(fitting, key=lambda found: found[1] * (1.0 if found[0].known else MIN_GAIN))
    text = (
        f"the images contradict the lens model {rig.left.model}: away from their middle, rows are off by "
        f"{given.max():.2f} px, and by {best_px:.2f} px if {best.text}"
    )
    return replace(best, text=text, fits=best_px < LIMIT_PX)


def _others(rig: Rig) -> Iterator[OtherLens]:
    """The rig with other lenses, in both cameras and in one of them."""
    left, right = rig.left, rig.right
    assert right is not None
    for one, two in zip(_readings(left), _readings(right), strict=False):
        if one.name == two.name:
            both = replace(rig, left=one.lens, right=two.lens)
            yield OtherLens(f"they are {one.name}", both, one.known and two.known)
    for one, side in itertools.chain(((r, "left") for r in _readings(left)), ((r, "right") for r in _readings(right))):
        lenses = {"left": left, "right": right, side: one.lens}
        yield OtherLens(f"the {side} one is {one.name}", replace(rig, **lenses), one.known)


def _readings(camera: Camera) -> list[_Reading]:
    """Other models with the numbers of this lens, and those without distortion."""
    d, found = camera.distortion, list[tuple[str, type[Camera], tuple[float, ...]]]()
    if isinstance(camera, RadTan) and any(d[:4]):
        found.append(("fisheyes (Kannala-Brandt) with these coefficients", KannalaBrandt, d[:4]))
    if isinstance(camera, RadTan) and len(d) == 5:
        found.append(("radtan with k3 before p1 and p2", RadTan, (*d[:2], *d[3:], d[2])))
    if isinstance(camera, KannalaBrandt) and any(d):
        found.append(("radtan with these coefficients", RadTan, d))
    if any(d):
        found.append(("without distortion", Pinhole, ()))
    found.append(("fisheyes", KannalaBrandt, ()))
    numbers = (*camera.size, camera.fx, camera.fy, camera.cx, camera.cy)
    return [
        _Reading(name, model(*numbers, kept), any(kept) and sum(map(bool, kept)) == sum(map(bool, d)))
        for name, model, kept in found
    ]


def _outer_halves(rig: Rig, window: Window) -> list[Window]:
    """The matches in the outer half of the image, even and odd ones; none if they are too few."""
    radius = np.linalg.norm(window.left[0] - (rig.left.cx, rig.left.cy), axis=1)
    outer = np.flatnonzero(radius > np.median(radius)) if len(radius) else np.zeros(0, int)
    if len(outer) < MIN_POINTS:
        return []
    return [
        Window(window.left[:, at], window.right[:, at], window.right_velocity[:, at], window.rows)
        for at in (outer[0::2], outer[1::2])
    ]


def _medians(rig: Rig, parts: Sequence[Window]) -> F64:
    """(P,) median absolute row errors; infinite where the lenses do not see half of the matches."""
    errors = [np.nan_to_num(np.abs(row_errors(rig, part)), nan=np.inf) for part in parts]
    return np.array([np.median(part) for part in errors])
