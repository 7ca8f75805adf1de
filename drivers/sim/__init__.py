"""The simulated store as a kind of source; `stereo_sfm.drivers.sim.source` renders it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from stereo_sfm.drivers.driver import Driver
from stereo_sfm.drivers.sim.options import SimOptions
from stereo_sfm.errors import one_of

if TYPE_CHECKING:
    from stereo_sfm.drivers.source import Source

# names of the scenes in stereo_sfm.drivers.sim.scenes, which is slow to import
SCENES = (
    "aisle",
    "loop",
    "identical-aisles",
    "people",
    "dark",
    "blank",
    "demo",
    "big",
    "sparse",
    "fridges",
    "glossy",
    "clutter",
    "stockroom",
    "market",
)
DEFAULT = "loop"


def _open(place: str, options: SimOptions) -> Source:
    from stereo_sfm.drivers.sim.source import open_sim

    return open_sim(place or DEFAULT, options)


def _check(place: str, options: SimOptions) -> None:
    one_of(place or DEFAULT, SCENES, "scene")


DRIVER = Driver("the simulated store, with ground truth", "SCENE", SimOptions, _open, _check)
