"""Floor plans made by hand."""

from __future__ import annotations

import numpy as np

from stereo_sfm.export.floor_plan import FREE, FloorPlan


def plan_of(width: float, height: float, origin: tuple[float, float], resolution: float = 0.05) -> FloorPlan:
    """A free floor."""
    image = np.full((round(height / resolution), round(width / resolution)), FREE, np.uint8)
    return FloorPlan(image, resolution, origin, np.eye(4))


def fill(plan: FloorPlan, x0: float, y0: float, x1: float, y1: float, value: int) -> None:
    """A rectangle in metres."""
    rising = plan.image[::-1]
    (a, b), (c, d) = (
        (round((x - plan.origin[0]) / plan.resolution), round((y - plan.origin[1]) / plan.resolution))
        for x, y in ((x0, y0), (x1, y1))
    )
    rising[b:d, a:c] = value
