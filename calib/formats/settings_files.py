"""What the settings files of SLAM systems share: flat keys, lenses with their sizes, a right camera by its baseline."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from stereo_sfm.calib.formats.common import brown, numbers
from stereo_sfm.calib.formats.file_storage import matrix, read_storage
from stereo_sfm.calib.rig import Rig
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Camera, KannalaBrandt


def read_flat(path: Path) -> dict[str, Any]:
    """All values by their whole name: `Camera.fx` for fx under Camera; a matrix is its list of numbers, row by row.

    Raises:
        ValueError: not a settings file.
    """
    return dict(_flat("", read_storage(path)))


def _flat(prefix: str, data: dict[str, Any]) -> list[tuple[str, Any]]:
    found: list[tuple[str, Any]] = []
    for key, value in data.items():
        values = matrix(value)
        if values is None and isinstance(value, dict):
            found += _flat(f"{prefix}{key}.", {str(k): v for k, v in value.items()})
        else:
            found.append((f"{prefix}{key}", value if values is None else values))
    return found


@dataclass(frozen=True)
class Lenses:
    """How a program states lenses.

    Attributes:
        kind: key of the lens model.
        fisheye: values of that key, in lower case -> whether it is a fisheye; the first where the key is missing.
        size: keys of width and height.
    """

    kind: str
    fisheye: Mapping[str, bool]
    size: tuple[str, str]

    def of(self, data: dict[str, Any], asked: tuple[int, int] | None, *prefixes: str) -> Camera:
        """The camera of the first prefix that the file has, for images of the size asked for or stated.

        Raises:
            ValueError: another lens model, or no size.
        """
        kind = str(data.get(self.kind, next(iter(self.fisheye)))).lower()
        if kind not in self.fisheye:
            raise ValueError(f"{self.kind} '{kind}' is not supported (supported: {', '.join(self.fisheye)})")
        prefix = next((p for p in prefixes if f"{p}fx" in data), prefixes[-1])
        return _lens(data, prefix, self.fisheye[kind], image_size(data, self.size, asked))


def _lens(data: dict[str, Any], prefix: str, fisheye: bool, size: tuple[int, int]) -> Camera:
    """The camera of `prefix`fx, fy, cx, cy and k1 ..., with OpenCV's coefficients or those of a fisheye."""
    fx, fy, cx, cy = numbers([data[f"{prefix}{name}"] for name in ("fx", "fy", "cx", "cy")])
    names = KannalaBrandt.coefficients if fisheye else ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    coefficients = numbers([data.get(f"{prefix}{name}", 0.0) for name in names])
    if fisheye:
        return KannalaBrandt(*size, fx, fy, cx, cy, tuple(coefficients))
    return brown(size, (fx, fy), (cx, cy), coefficients)


def image_size(data: dict[str, Any], names: tuple[str, str], asked: tuple[int, int] | None) -> tuple[int, int]:
    """(width, height) px as asked for, else under two names.

    Raises:
        ValueError: neither.
    """
    if asked is None and any(name not in data for name in names):
        raise ValueError(f"no image size stated ({', '.join(names)}): give it, as convert-calib's --size WxH does")
    width, height = asked or numbers([data[name] for name in names])
    return int(width), int(height)


def rectified_pair(left: Camera, baseline: float, name: str) -> Rig:
    """Two equal cameras side by side.

    Raises:
        ValueError: the lens distorts, so that the images cannot be rectified ones.
    """
    if left.model != "pinhole":
        raise ValueError("it states the baseline of rectified images and a lens that distorts: there is no such pair")
    return Rig(left, left, se3.from_rotation_translation(np.eye(3), np.array([baseline, 0.0, 0.0])), name=name)
