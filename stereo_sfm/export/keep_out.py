"""Zones that a robot must not enter, drawn in red on the floor plan in any image editor.

`keepout.png` shows the floor plan in grey and the zones in red, `keepout.yaml` says where its pixels lie. A new plan
takes the zones over from the drawing to a new one of its own extent, so that they stay across updates of the map.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.export.floor_plan import FREE, OCCUPIED, FloorPlan, description
from stereo_sfm.input_file import read_bytes, read_yaml
from stereo_sfm.pixels import decode, write_image
from stereo_sfm.types import U8, Bool

DRAWING, ABOUT, MASK = "keepout.png", "keepout.yaml", "keepout_mask"
RED = (40, 40, 220)  # blue, green, red
STANDS_OUT = 60  # by which red exceeds green and blue where something is drawn


def read_zones(folder: Path, plan: FloorPlan) -> Bool:
    """(H, W) the zones of the drawing in a folder, in the pixels of a plan; none without a drawing.

    Raises:
        StereoSfmError: the drawing or its description is damaged.
    """
    import cv2

    zones = np.zeros(plan.image.shape, bool)
    if not (folder / DRAWING).is_file():
        return zones
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
    low = origin + np.column_stack([columns, rows]) * resolution - plan.origin  # metres from the plan's corner
    first, last = (np.round(low / plan.resolution).astype(int), np.round((low + resolution) / plan.resolution))
    height, width = plan.image.shape[:2]
    for (x0, y0), (x1, y1) in zip(first.tolist(), np.maximum(last, first + 1).astype(int).tolist(), strict=True):
        zones[max(y0, 0) : max(min(y1, height), 0), max(x0, 0) : max(min(x1, width), 0)] = True
    return zones[::-1]


def write_zones(folder: Path, plan: FloorPlan, zones: Bool) -> None:
    """The drawing to go on with, and the mask for Nav2's keepout filter (occupied: keep out)."""
    import cv2

    picture = cv2.cvtColor(plan.image, cv2.COLOR_GRAY2BGR)
    picture[zones] = RED
    mask: U8 = np.where(zones, OCCUPIED, FREE).astype(np.uint8)
    for name, image in ((DRAWING, picture), (f"{MASK}.pgm", mask)):
        write_image(folder / name, image)
    (folder / ABOUT).write_text(description(plan, DRAWING), encoding="utf-8")
    (folder / f"{MASK}.yaml").write_text(description(plan, f"{MASK}.pgm"), encoding="utf-8")
