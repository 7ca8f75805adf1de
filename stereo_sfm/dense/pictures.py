"""Pictures of a reconstruction for its report: the mesh seen from a corner, and depth images."""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from stereo_sfm.dense.depth import DepthImage
from stereo_sfm.dense.surface import Surface
from stereo_sfm.geometry.kernels import njit
from stereo_sfm.maps.floor import HIGH
from stereo_sfm.types import F32, F64, I64, U8

WIDTH_PX = 1200
DOWN_DEG, AROUND_DEG = 50.0, 25.0  # direction of view: into shelves on both sides of an aisle, not only on their tops
AMBIENT = 0.55  # share of the light that reaches every face
NEAR_M, FAR_M = 0.5, 6.0  # of the colours of depth images


def write_mesh_pictures(
    folder: Path, points: Iterable[F64], parts: Iterable[tuple[F64, Surface, I64]], heights: tuple[float, float]
) -> None:
    """mesh_height.png and mesh_grey.png: the mesh below a ceiling, coloured by height and by grey level.

    Args:
        points: (N, 3) m, all of the mesh in parts of any size.
        parts: points (V, 3) m, with grey levels, and triangles (T, 3) of each cube.
        heights: m, of the lowest and the highest colour.
    """

    def drawn() -> Iterator[tuple[F64, U8, I64]]:
        for vertices, surface, triangles in parts:
            below = (vertices[triangles][:, :, 2] < HIGH).all(axis=1)
            coloured = height_colours(vertices[:, 2:], heights)[:, 0]
            plain = np.repeat(surface.grey[:, None], 3, axis=1)
            yield vertices, np.concatenate([coloured, plain], axis=1), triangles[below]

    image = render_mesh((p[p[:, 2] < HIGH] for p in points), drawn())
    if image is not None:
        _write(folder / "mesh_height.png", image[..., :3])
        _write(folder / "mesh_grey.png", image[..., 3:])


def height_colours(z: F64, heights: tuple[float, float]) -> U8:
    """(H, W, 3) blue green red. Args: (H, W) m; those of the first and the last colour."""
    low, high = heights
    share = np.clip((z - low) / max(high - low, 1e-3), 0, 1)
    return _turbo((255 * share).astype(np.uint8))


def render_mesh(points: Iterable[F64], parts: Iterable[tuple[F64, U8, I64]], width: int = WIDTH_PX) -> U8 | None:
    """(H, W, C): faces that look at the viewer, shaded, on white; None where there are none.

    Args:
        points: (N, 3) m, what the picture holds.
        parts: points (V, 3) m, their colours (V, C) and triangles (T, 3), one after the other.
    """
    down, around = math.radians(DOWN_DEG), math.radians(AROUND_DEG)
    ahead = np.array([math.cos(down) * math.cos(around), math.cos(down) * math.sin(around), -math.sin(down)])
    right = np.array([math.sin(around), -math.cos(around), 0.0])
    to_view = np.stack([right, np.cross(ahead, right), ahead], axis=1)
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for seen in (p @ to_view for p in points if len(p)):
        low, high = np.minimum(low, seen.min(axis=0)), np.maximum(high, seen.max(axis=0))
    scale = (width - 1) / max(float(high[0] - low[0]), 1e-3)
    image = depth = None
    for vertices, colours, triangles in parts:
        if not len(triangles):
            continue
        if image is None or depth is None:
            height = min(2 * width, int(scale * float(high[1] - low[1])) + 1)
            image = np.full((height, width, colours.shape[1]), 255, np.uint8)
            depth = np.full((height, width), np.inf, np.float32)
        a, b, c = (vertices[triangles[:, k]] for k in range(3))
        normals = np.cross(b - a, c - a)
        facing = -(normals @ ahead) / np.maximum(np.linalg.norm(normals, axis=1), 1e-12)
        at = (vertices @ to_view - low) * np.array([scale, scale, 1.0])
        _rasterize(image, depth, at, triangles, colours, facing)
    return image


@njit
def _rasterize(image, depth, at, triangles, colours, facing):
    h, w = depth.shape
    for t in range(len(triangles)):
        if facing[t] <= 0:
            continue
        i, j, k = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        xa, ya, xb, yb, xc, yc = at[i, 0], at[i, 1], at[j, 0], at[j, 1], at[k, 0], at[k, 1]
        area = (xb - xa) * (yc - ya) - (xc - xa) * (yb - ya)
        if abs(area) < 1e-9:
            continue
        light = AMBIENT + (1 - AMBIENT) * facing[t]
        for y in range(max(0, math.ceil(min(ya, yb, yc))), min(h - 1, math.floor(max(ya, yb, yc))) + 1):
            for x in range(max(0, math.ceil(min(xa, xb, xc))), min(w - 1, math.floor(max(xa, xb, xc))) + 1):
                p = ((xb - x) * (yc - y) - (xc - x) * (yb - y)) / area
                q = ((xc - x) * (ya - y) - (xa - x) * (yc - y)) / area
                r = 1 - p - q
                if p < 0 or q < 0 or r < 0:
                    continue
                z = p * at[i, 2] + q * at[j, 2] + r * at[k, 2]
                if z < depth[y, x]:
                    depth[y, x] = z
                    for n in range(image.shape[2]):
                        mixed = p * colours[i, n] + q * colours[j, n] + r * colours[k, n]
                        image[y, x, n] = np.uint8(light * mixed)


def write_depth_picture(path: Path, depth: DepthImage) -> None:
    """The image, its ranges (near red, far blue, unknown black) and their standard deviations, side by side."""
    parts = [np.repeat(depth.grey[..., None], 3, axis=2), coloured_ranges(depth.ranges)]
    relative = np.nan_to_num(depth.sigmas / depth.ranges, nan=0.0)
    parts.append(_turbo(np.clip(relative * 255 / 0.1, 0, 255).astype(np.uint8)))  # red: 10 % of the range
    parts[2][~np.isfinite(depth.ranges)] = 0
    _write(path, np.concatenate(parts, axis=0 if depth.grey.shape[1] > depth.grey.shape[0] else 1))


def coloured_ranges(ranges: F32) -> U8:
    """(H, W) metres -> (H, W, 3) blue green red by the inverse, as disparities look."""
    share = (1 / np.clip(ranges, NEAR_M, FAR_M) - 1 / FAR_M) / (1 / NEAR_M - 1 / FAR_M)
    out = _turbo((255 * np.nan_to_num(share, nan=0.0)).astype(np.uint8))
    out[~np.isfinite(ranges)] = 0
    return out


def _turbo(share: U8) -> U8:
    import cv2

    return np.asarray(cv2.applyColorMap(share, cv2.COLORMAP_TURBO), np.uint8)


def _write(path: Path, picture: Any) -> None:
    from stereo_sfm.pixels import write_image

    write_image(path, np.ascontiguousarray(picture))
