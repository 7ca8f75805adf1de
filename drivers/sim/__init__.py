"""The simulated store as a kind of source; `drivers.sim.source` renders it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from drivers.driver import Driver
from drivers.sim.options import SimOptions
from stereo_sfm.errors import one_of

if TYPE_CHECKING:
    from drivers.source import Source

# what `sim:` can show; the plans are in drivers.sim.scenes
SCENES = ("aisle", "loop", "identical-aisles", "people", "dark", "blank", "demo", "big")
DEFAULT = "loop"


def _open(place: str, options: SimOptions) -> Source:
    from drivers.sim.source import open_sim

    return open_sim(place or DEFAULT, options)


def _check(place: str, options: SimOptions) -> None:
    one_of(place or DEFAULT, SCENES, "scene")


DRIVER = Driver("the simulated store, with ground truth", "SCENE", SimOptions, _open, _check)
