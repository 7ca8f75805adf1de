"""Recordings with people painted over them: encounters in images of a real camera or another renderer.

A person or a bag is a flat cut-out with a texture, posed in space and painted into both images through their camera
models, so that its disparities are those of its distance. It is lit, blurred a little and noisy like what is behind it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.drivers.source import Source, Stamps
from stereo_sfm.drivers.wrapped import WrappedSource
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Pinhole
from stereo_sfm.types import F64, U8, StereoImage

TEXELS = 400  # a metre
NOISE = 2.0  # grey levels
SHARE_STEP = 8  # px between the rays by which the covered share is counted
SMOOTHED_S = 0.5  # of the camera's path on either side, for the path of those who walk with it
FIRST_S, PAUSE_S = 2.0, 1.2  # before the first encounter, and from the end of one to the next
KINDS = "cover", "approach", "stop", "beside"


@dataclass(frozen=True, eq=False)
class Cutout:
    """A textured silhouette in its own plane, x right, y down, metres from its middle."""

    texture: F64  # (H, W) grey levels
    alpha: F64  # (H, W) 0 to 1

    @property
    def half(self) -> F64:
        """(2,) half its width and height in metres."""
        return 0.5 * np.array(self.alpha.shape[::-1]) / TEXELS


@dataclass(frozen=True, eq=False)
class PaintedEncounter:
    """A cut-out in front of the camera for some time."""

    kind: str
    begin: float  # seconds since the first image
    end: float
    cutout: Cutout
    at: Callable[[float], F64]  # seconds -> (3,) its middle, in the axes of the camera or of its course
    held: bool = False  # moves with the camera; else along its course, with the axes that the camera had at `begin`

    def present(self, seconds: float) -> bool:
        """Whether it is in front of the camera."""
        return self.begin <= seconds <= self.end


def person(rng: np.random.Generator) -> Cutout:
    """Head, trunk and legs in patterned clothes, 0.5 m by 1.75 m."""
    h, w = int(1.75 * TEXELS), int(0.56 * TEXELS)
    y, x = np.mgrid[:h, :w] / TEXELS
    x -= 0.28
    head = np.square(x / 0.1) + np.square((y - 0.14) / 0.14) < 1
    trunk = (np.abs(x) < 0.26 - 0.08 * np.clip(0.35 - y, 0, 0.1) / 0.1) & (y > 0.28) & (y < 0.95)
    legs = (np.abs(np.abs(x) - 0.11) < 0.09) & (y >= 0.95)
    texture = np.where(head, 150.0, np.where(legs, _cloth(rng, (h, w)), _cloth(rng, (h, w))))
    return Cutout(texture, cv2.GaussianBlur((head | trunk | legs).astype(np.float64), (0, 0), 2.0))


def bag(rng: np.random.Generator) -> Cutout:
    """1.6 m by 1.2 m of cloth."""
    shape = int(1.2 * TEXELS), int(1.6 * TEXELS)
    return Cutout(_cloth(rng, shape), np.ones(shape))


def _cloth(rng: np.random.Generator, shape: tuple[int, int]) -> F64:
    """Patches, stripes and fibres."""
    out = np.full(shape, float(rng.uniform(60, 140)))
    for metres, depth in ((0.2, 20.0), (0.04, 25.0), (0.012, 15.0)):
        cells = [max(int(n / (metres * TEXELS)) + 2, 2) for n in shape]
        out += depth * cv2.resize(rng.normal(size=cells), shape[::-1], interpolation=cv2.INTER_CUBIC)
    stripes = np.sin(2 * np.pi * np.arange(shape[0]) / TEXELS / float(rng.uniform(0.05, 0.12)))
    return np.clip(out + float(rng.uniform(0, 25)) * stripes[:, None], 5, 250)


def plan(kind: str, seconds: float, rng: np.random.Generator) -> list[PaintedEncounter]:
    """Encounters of a kind one after the other, as many as end before `seconds`."""
    out: list[PaintedEncounter] = []
    begin = FIRST_S
    while True:
        encounter = {"cover": _cover, "approach": _approach, "stop": _stop, "beside": _beside}[kind](begin, rng)
        if encounter.end + 0.6 > seconds:
            return out
        out.append(encounter)
        begin = encounter.end + PAUSE_S


def _smooth(x: float) -> float:
    x = min(max(x, 0.0), 1.0)
    return x * x * (3 - 2 * x)


def _cover(begin: float, rng: np.random.Generator) -> PaintedEncounter:
    """A bag held before both lenses for 0.5 to 2 s."""
    lasts, moves = float(rng.uniform(0.5, 2.0)), float(rng.uniform(0.15, 0.3))
    corner = float(rng.uniform(0, 2 * np.pi))
    away = 2.2 * np.array([np.cos(corner), np.sin(corner), 0.0])
    opened, held = begin + moves + lasts, np.array([0.03, 0.0, 0.13])

    def at(seconds: float) -> F64:
        off = 1 - _smooth((seconds - begin) / moves) + _smooth((seconds - opened) / moves)
        return held + off * away + 0.004 * np.sin(2 * np.pi * np.array([1.1, 1.7, 0.8]) * seconds)

    return PaintedEncounter("cover", begin, opened + moves, bag(rng), at, True)


def _approach(begin: float, rng: np.random.Generator) -> PaintedEncounter:
    """Walks up to 0.25 to 0.45 m, waits for up to a second, steps past."""
    near, waits = float(rng.uniform(0.25, 0.45)), float(rng.uniform(0.2, 1.0))
    side, middle, sway = float(rng.choice([-1, 1])), float(rng.uniform(-0.1, 0.1)), rng.uniform(0, 6, 2)
    there, left = begin + 2.0, begin + 2.0 + waits

    def at(seconds: float) -> F64:
        ahead = near + 1.1 * max(there - seconds, 0.0)
        aside = middle + side * 1.8 * _smooth((seconds - left) / 1.2) + 0.02 * np.sin(2.2 * seconds + sway[0])
        return np.array([aside, 0.35 + 0.015 * np.sin(11.0 * seconds + sway[1]), ahead])

    return PaintedEncounter("approach", begin, left + 1.2, person(rng), at)


def _stop(begin: float, rng: np.random.Generator) -> PaintedEncounter:
    """Steps in at 0.5 to 1.3 m, sways there for 1 to 3 s, steps out."""
    near, waits = float(rng.uniform(0.5, 1.3)), float(rng.uniform(1.0, 3.0))
    side, middle, sway = float(rng.choice([-1, 1])), float(rng.uniform(-0.2, 0.2)), rng.uniform(0, 6, 2)
    left = begin + 0.8 + waits

    def at(seconds: float) -> F64:
        aside = side * (_smooth((seconds - begin) / 0.8) - 1) + side * _smooth((seconds - left) / 0.8)
        swayed = 0.02 * np.sin(2.2 * seconds + sway)
        return np.array([middle + 2.5 * aside + swayed[0], 0.35, near + swayed[1]])

    return PaintedEncounter("stop", begin, left + 0.8, person(rng), at)


def _beside(begin: float, rng: np.random.Generator) -> PaintedEncounter:
    """Walks along, 0.9 to 1.4 m ahead and to one side, for 3 s."""
    near, side, phase = float(rng.uniform(0.9, 1.4)), float(rng.choice([-1, 1])), float(rng.uniform(0, 6))
    aside = float(rng.uniform(0.3, 0.5))

    def at(seconds: float) -> F64:
        away = 1 - _smooth((seconds - begin) / 0.8) + _smooth((seconds - begin - 2.6) / 0.8)
        swayed = 0.06 * np.sin(0.8 * seconds + phase)
        return np.array([side * (aside + 1.6 * away) + swayed, 0.35 + 0.02 * np.sin(11.0 * seconds), near + swayed])

    return PaintedEncounter("beside", begin, begin + 3.4, person(rng), at)


class PinholeView(WrappedSource):
    """What a narrower camera without distortion at the same place would see (bilinear)."""

    def __init__(self, source: Source, size: tuple[int, int] = (640, 400), focal_px: float = 300.0) -> None:
        super().__init__(source)
        camera = Pinhole(*size, focal_px, focal_px, 0.5 * (size[0] - 1), 0.5 * (size[1] - 1))
        rays, rig = camera.bearing_grid(), source.rig
        assert rig.right is not None
        self._maps = [lens.project(rays).astype(np.float32) for lens in (rig.left, rig.right)]
        self._rig = replace(rig, left=camera, right=camera, left_mask=None, right_mask=None)

    @property
    def rig(self) -> Rig:
        return self._rig

    def stamps(self) -> Stamps | None:
        return self.source.stamps()

    def __iter__(self) -> Iterator[StereoImage]:
        for image in self.source:
            pair = (image.left, image.right)
            left, right = (
                np.asarray(cv2.remap(pixels, uv[..., 0], uv[..., 1], cv2.INTER_LINEAR), np.uint8)
                for pixels, uv in zip(pair, self._maps, strict=True)
                if pixels is not None
            )
            yield replace(image, left=left, right=right)


class Painted(WrappedSource):
    """A recording with exact poses, and encounters painted into its images."""

    def __init__(self, source: Source, kind: str, seed: int) -> None:
        super().__init__(source)
        assert source.ground_truth is not None
        stamps = source.stamps()
        assert stamps is not None
        self._stamp_ns = stamps.stamp_ns
        self._rng = np.random.default_rng([seed, 7])
        self.seed = seed
        self.encounters = plan(kind, 1e-9 * float(self._stamp_ns[-1] - self._stamp_ns[0]), self._rng) if kind else []
        self._rays = [_rays(source.rig, k, 1) for k in range(2)]
        self._few_rays = [_rays(source.rig, k, SHARE_STEP) for k in range(2)]

    @property
    def rate(self) -> float:
        """Images a second."""
        return 1e9 / float(np.median(np.diff(self._stamp_ns)))

    def pose(self, frame: int) -> F64:
        """world_T_cam0 (4, 4) of the image at a position."""
        truth = self.source.ground_truth
        assert truth is not None
        stamp = int(self._stamp_ns[frame])
        k = int(np.clip(np.searchsorted(truth.stamp_ns, stamp), 1, len(truth) - 1))
        first, last = (int(truth.stamp_ns[i]) for i in (k - 1, k))
        return se3.interpolate(
            truth.poses[k - 1], truth.poses[k], float(np.clip((stamp - first) / (last - first), 0, 1))
        )

    def moving_share(self, frame: int) -> F64:
        """The share (2,) of each camera's view that is painted over."""
        valid = [np.isfinite(rays[..., 2]) for rays in self._few_rays]
        return np.array([self._layer(frame, k, self._few_rays[k])[1][valid[k]].mean() for k in range(2)])

    def __iter__(self) -> Iterator[StereoImage]:
        for position, image in enumerate(self.source):
            left, right = (
                self._paint(position, k, pixels)
                for k, pixels in enumerate((image.left, image.right))
                if pixels is not None
            )
            yield replace(image, left=left, right=right)

    def _paint(self, frame: int, side: int, image: U8) -> U8:
        colour, alpha = self._layer(frame, side, self._rays[side])
        if not alpha.any():
            return image
        rng = np.random.default_rng([self.seed, frame, side])
        colour = colour + rng.normal(0.0, NOISE, colour.shape)
        return np.clip(np.rint(alpha * colour + (1 - alpha) * image), 0, 255).astype(np.uint8)

    def _layer(self, frame: int, side: int, rays: F64) -> tuple[F64, F64]:
        """Grey levels and opacity (H, W) of what is before one camera."""
        colour, alpha = np.zeros(rays.shape[:2]), np.zeros(rays.shape[:2])
        seconds = 1e-9 * float(self._stamp_ns[frame] - self._stamp_ns[0])
        for encounter in self.encounters:
            if encounter.present(seconds):
                cam_T_left = np.eye(4) if side == 0 else se3.inverse(self.rig.left_T_right)
                left_T_cutout = np.eye(4)
                left_T_cutout[:3, 3] = encounter.at(seconds)
                if not encounter.held:
                    left_T_cutout = se3.inverse(self.pose(frame)) @ self._course(encounter, frame) @ left_T_cutout
                colour, alpha = _seen(encounter.cutout, cam_T_left @ left_T_cutout, rays)
        return colour, alpha

    def _course(self, encounter: PaintedEncounter, frame: int) -> F64:
        """world_T_course (4, 4): the camera's path, smoothed, with its axes when the encounter began."""
        around = round(SMOOTHED_S * self.rate)
        near = range(max(frame - around, 0), min(frame + around, len(self._stamp_ns) - 1) + 1)
        out = self.pose(round(encounter.begin * self.rate)).copy()
        out[:3, 3] = np.mean([self.pose(k)[:3, 3] for k in near], axis=0)
        return out


def _rays(rig: Rig, side: int, step: int) -> F64:
    camera = rig.left if side == 0 else rig.right
    assert camera is not None
    return camera.bearing_grid(step)


def _seen(cutout: Cutout, cam_T_cutout: F64, rays: F64) -> tuple[F64, F64]:
    """Grey levels and opacity (H, W) of a cut-out along rays (H, W, 3)."""
    normal, at = cam_T_cutout[:3, 2], cam_T_cutout[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = (normal @ at) / (rays @ normal)
        points = rays * reach[..., None] - at
    points[~(reach > 0)] = np.nan
    where = np.stack([points @ cam_T_cutout[:3, k] for k in (0, 1)], axis=-1)
    texel = np.nan_to_num((where + cutout.half) * TEXELS, nan=-9.0).clip(-9, 1e5).astype(np.float32)
    small = cv2.GaussianBlur(cutout.texture, (0, 0), 1.0)
    colour, alpha = (
        np.asarray(cv2.remap(layer, texel[..., 0], texel[..., 1], cv2.INTER_LINEAR, borderValue=0.0), np.float64)
        for layer in (small, cutout.alpha)
    )
    return colour, alpha
