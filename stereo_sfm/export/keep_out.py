"""Zones that a robot must not enter, drawn in red on the floor plan in any image editor.

`keepout.png` shows the floor plan in grey and the zones in red, `keepout.yaml` says where its pixels lie. A new plan
takes the zones over from the drawing to a new one of its own extent, so that they stay across updates of the map.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.export.floor_plan import FREE, MAX_CELLS, OCCUPIED, UNKNOWN, FloorPlan, description, in_robots_map
from stereo_sfm.input_file import read_bytes, read_yaml
from stereo_sfm.pixels import decode, write_image
from stereo_sfm.types import F64, U8, Bool

DRAWING, ABOUT, MASK = "keepout.png", "keepout.yaml", "keepout_mask"
RED = (40, 40, 220)  # blue, green, red
ROUNDED = 1e-6  # of a pixel
STANDS_OUT = 60  # by which red exceeds green and blue where something is drawn


def read_zones(folder: Path, plan: FloorPlan) -> Bool:
    """(H, W) the zones of the drawing in a folder, in the pixels of a plan; none without a drawing.

    Raises:
        StereoSfmError: the drawing or its description is damaged.
    """
    zones = np.zeros(plan.image.shape, bool)
    found = _drawn(folder)
    if found is None:
        return zones
    low, resolution = found[0] - plan.origin, found[1]
    first, last = (np.round(low / plan.resolution).astype(int), np.round((low + resolution) / plan.resolution))
    height, width = plan.image.shape[:2]
    for (x0, y0), (x1, y1) in zip(first.tolist(), np.maximum(last, first + 1).astype(int).tolist(), strict=True):
        zones[max(y0, 0) : max(min(y1, height), 0), max(x0, 0) : max(min(x1, width), 0)] = True
    return zones[::-1]


def _drawn(folder: Path) -> tuple[F64, float] | None:
    """(N, 2) metres in the floor's frame, the corner of each red pixel with the least x and y; the pixels' side."""
    import cv2

    if not (folder / DRAWING).is_file():
        return None
    try:
        drawn = decode(read_bytes(folder / DRAWING), cv2.IMREAD_COLOR)
    except (OSError, ValueError):
        raise StereoSfmError(f"{folder / DRAWING} is not an image: remove it to begin with an empty drawing") from None
    try:
        about: Any = read_yaml(folder / ABOUT)
        resolution, origin = float(about["resolution"]), np.array(about["origin"][:2], float)
    except (OSError, KeyError, TypeError, ValueError):
        raise StereoSfmError(f"{folder / ABOUT} does not say where the drawing lies: remove {DRAWING} too") from None
    blue, green, red = (drawn[..., k].astype(int) for k in range(3))
    rows, columns = np.nonzero((red - np.maximum(blue, green) > STANDS_OUT)[::-1])  # the first row has the least y
    return np.asarray(origin + np.column_stack([columns, rows]) * resolution, float), resolution


def write_zones(folder: Path, plan: FloorPlan, zones: Bool, base_T_left: F64) -> None:
    """The drawing to go on with, and the mask for Nav2's keepout filter (occupied: keep out) in the robot's map.

    `base_T_left`: (4, 4) of the rig.
    """
    import cv2

    picture = cv2.cvtColor(plan.image, cv2.COLOR_GRAY2BGR)
    picture[zones] = RED
    painted: U8 = np.where(zones, OCCUPIED, FREE).astype(np.uint8)
    mask = in_robots_map(replace(plan, image=painted), base_T_left, FREE)
    write_image(folder / f"{MASK}.pgm", mask.image)
    (folder / f"{MASK}.yaml").write_text(description(mask, f"{MASK}.pgm"), encoding="utf-8")
    drawing, about = folder / f".{DRAWING}", folder / f".{ABOUT}"
    write_image(drawing, picture)
    about.write_text(description(plan, DRAWING), encoding="utf-8")
    drawing.replace(folder / DRAWING)  # one after the other at once: both say where the zones lie
    about.replace(folder / ABOUT)


def covering(plan: FloorPlan, folder: Path) -> FloorPlan:
    """The plan, with unknown floor around it where zones of the drawing in a folder lie beyond.

    Raises:
        StereoSfmError: the drawing or its description is damaged.
    """
    found = _drawn(folder)
    if found is None or not len(found[0]):
        return plan
    low, resolution = found
    size = np.array(plan.image.shape[::-1])
    first = np.floor((low.min(0) - plan.origin) / plan.resolution + ROUNDED).astype(int)
    last = np.ceil((low.max(0) + resolution - plan.origin) / plan.resolution - ROUNDED).astype(int)
    before, after = np.maximum(-first, 0), np.maximum(last - size, 0)
    if (size + before + after).prod() > MAX_CELLS:
        raise StereoSfmError(f"{folder / DRAWING} has zones far from the map: remove them, or the drawing")
    image = np.pad(plan.image, ((after[1], before[1]), (before[0], after[0])), constant_values=UNKNOWN)
    corner = np.array(plan.origin) - before * plan.resolution
    return replace(plan, image=image, origin=(float(corner[0]), float(corner[1])))
