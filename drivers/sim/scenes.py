"""Named scenes: a store's floor plan, a route through it, people, and the sensor's effects."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from stereo_sfm.drivers.sim.drives import Gait
from stereo_sfm.drivers.sim.effects import Effects
from stereo_sfm.drivers.sim.market import Market
from stereo_sfm.drivers.sim.people import Appearance, Person
from stereo_sfm.drivers.sim.shelves import Mix
from stereo_sfm.drivers.sim.world import CLOTHES, HAIR, Layout
from stereo_sfm.types import F64

Route = Callable[[Layout, int, bool], F64]  # (layout, session number, returns) -> polyline (N, 2) metres


@dataclass(frozen=True)
class Scene:
    """The part of a simulated recording that its name determines."""

    layout: Layout | Market
    route: Route = lambda _layout, _session, _returns: np.zeros((0, 2))  # a market's sessions are paths
    length: float = 0.0  # metres driven, if the route is as long
    effects: Effects = field(default_factory=Effects)
    gait: Gait = field(default_factory=Gait)
    people: int = 0


def _ends(layout: Layout) -> tuple[float, float]:
    """x of the middle of the two cross aisles, kept near the gondolas."""
    return layout.margin - 1.3, layout.margin + layout.gondola_length + 1.3


def _aisle(layout: Layout, session: int, returns: bool) -> F64:
    """Down one aisle; back up the same aisle when it returns."""
    k = 1 + session % (layout.gondolas - 1)
    a, b = _ends(layout)
    y = layout.aisle_y(k)
    down = [(a, y), (b, y)]
    back = [(b, y + 0.35), (a, y + 0.35)] if returns else []
    return np.array(down + back)


def _loop(layout: Layout, session: int, returns: bool) -> F64:
    """Laps around one gondola, starting in the middle of an aisle."""
    k = session % layout.gondolas if session else 1
    a, b = _ends(layout)
    y0, y1 = layout.aisle_y(k), layout.aisle_y(k + 1)
    x = a + (b - a) * (0.3 + 0.13 * (session % 4))
    lap = [(b, y0), (b, y1), (a, y1), (a, y0)]
    if session % 2:  # the other direction
        lap = [(a, y0), (a, y1), (b, y1), (b, y0)]
    return np.array([(x, y0), *(lap * (12 if returns else 1)), (x, y0)])


def _stockroom(layout: Layout, _session: int, returns: bool) -> F64:
    """Down an aisle, through the doorway at its end, once around in the stockroom; and back when it returns."""
    a, _ = _ends(layout)
    (x, _), _ = layout.doorway
    y = layout.aisle_y(1)
    near, far = x + 1.3, x + layout.stockroom - 1.4
    route = [(a, y), (far, y), (far, y + 2.6), (near, y + 2.6), (near, y)]
    return np.array([*route, (near, y - 0.01), (a, y - 0.01)] if returns else route)


def _serpentine(layout: Layout, session: int, returns: bool) -> F64:
    """Along every inner aisle in turn; then along the first two again when it returns."""
    a, b = _ends(layout)
    aisles = list(range(1, layout.gondolas))
    if session % 2:
        aisles.reverse()
    points: list[tuple[float, float]] = []
    x = a
    for k in aisles + (aisles[:2] if returns else []):
        points.append((x, layout.aisle_y(k)))
        x = a + b - x
        points.append((x, layout.aisle_y(k)))
    return np.array(points)


_STORE = Layout()
_DARK = Effects(exposure_s=0.012, gain=0.3, drift=0.2, read_noise=3.5, shot_noise=0.3, black_level=6.0)

MARKET = "market"  # its plan depends on paths: stereo_sfm.drivers.sim.market
SCENES: dict[str, Scene] = {
    "aisle": Scene(_STORE, _aisle, 14.0),
    "loop": Scene(_STORE, _loop, 42.0),
    "identical-aisles": Scene(Layout(gondolas=5, gondola_length=8.0, identical=True), _serpentine, 1000.0),
    "people": Scene(_STORE, _loop, 42.0, people=7),
    "dark": Scene(_STORE, _loop, 42.0, _DARK),
    "blank": Scene(Layout(fill=0.06), _loop, 42.0),
    "sparse": Scene(Layout(fill=0.7, gaps=0.3, setback=0.3), _loop, 42.0),
    "fridges": Scene(Layout(gaps=0.1, mix=Mix(round=0.5, glossy=0.3, clear=0.3), glass=0.7, polish=0.5), _loop, 42.0),
    "glossy": Scene(Layout(gaps=0.1, mix=Mix(round=0.3, hanging=0.1, glossy=0.8, clear=0.2), polish=1.0), _loop, 42.0),
    "clutter": Scene(
        Layout(
            fill=0.85,
            gaps=0.2,
            setback=0.25,
            mix=Mix(round=0.35, hanging=0.25, glossy=0.25, clear=0.15),
            glass=0.15,
            bare=0.15,
            polish=0.3,
            carts=12,
        ),
        _loop,
        42.0,
    ),
    "stockroom": Scene(Layout(gondolas=3, gondola_length=6.0, stockroom=5.0), _stockroom, 1000.0),
    "demo": Scene(Layout(gondolas=2, gondola_length=3.6, products=120), _loop, 21.0, gait=Gait(speed=1.05)),
    "big": Scene(Layout(gondolas=9, gondola_length=18.0, products=420), _serpentine, 1000.0),
}


def crowd(layout: Layout, count: int, rng: np.random.Generator) -> list[Person]:
    """People who walk along the aisles and across their ends."""
    out: list[Person] = []
    a, b = _ends(layout)
    for n in range(count):
        if n % 3 == 2:
            x = a - 0.3 if rng.random() < 0.5 else b + 0.3
            start, end = (x, layout.aisle_y(0)), (x, layout.aisle_y(layout.gondolas))
        else:
            y = layout.aisle_y(1 + n % 2) + float(rng.choice([-0.55, 0.55]))
            start, end = (a, y), (b, y + float(rng.uniform(-0.1, 0.1)))
        shirt, trousers = rng.choice(CLOTHES, 2, replace=False)
        hair = HAIR + int(rng.integers(2))
        speed, phase = float(rng.uniform(0.5, 1.2)), float(rng.uniform(0, 20))
        appearance = Appearance(float(rng.uniform(1.55, 1.9)), int(shirt), int(trousers), hair)
        out.append(Person(start, end, speed, phase, appearance))
    return out
