"""What makes a store harder to see: glass doors, shopping carts, and the materials of what shines."""

from __future__ import annotations

import numpy as np

from stereo_sfm.drivers.sim.shelves import Shop
from stereo_sfm.drivers.sim.tables import Builder

DOOR = 0.8  # metres wide
FRAME = 0.03  # metres, half a door frame and its depth
ROD = 0.004  # metres, half a cart's rod
MESH = 0.05  # metres between the rods of a cart


def materials(polish: float, shines: bool) -> list[list[float]]:
    """Rows of Tables.materials; none where neither the floor nor anything else mirrors.

    Reflectances straight on: 0.04 of varnish, plastic and glass (index of refraction 1.5), 0.08 of both faces of a
    pane, a third of metallised film.
    """
    if polish == 0 and not shines:
        return []
    return [
        [0.04, polish, 0.004 + 0.02 * (1 - polish), 0.0, 0.0],  # floor
        [0.0, 0.0, 0.0, 0.0, 0.0],  # matt
        [0.04, 1.0, 0.01, 0.0, 0.0],  # glossy
        [0.35, 1.0, 0.03, 0.12, 0.0],  # foil
        [0.04, 1.0, 0.002, 0.02, 0.75],  # clear
        [0.08, 1.0, 0.0, 0.0, 0.92],  # glass
    ]


def add_doors(b: Builder, shop: Shop, span: tuple[float, float], ys: tuple[float, float], top: float) -> None:
    """Glass doors in their frames before shelves along x, and a roof; `ys`: back and front of the shelves."""
    (x0, x1), (back, front) = span, ys
    out = front + (FRAME if front > back else -FRAME)
    near, far = min(front, out), max(front, out)
    posts = np.linspace(x0, x1, max(2, round((x1 - x0) / DOOR) + 1)).tolist()
    for x in posts:
        b.solid((x - FRAME, near, 0.1), (x + FRAME, far, top), [shop.steel] * 6)
    for z in (0.1, top - 2 * FRAME):
        b.solid((x0, near, z), (x1, far, z + 2 * FRAME), [shop.steel] * 6)
    b.solid((x0, min(back, out), top), (x1, max(back, out), top + 0.12), [shop.end] * 6)
    middle = 0.5 * (near + far)
    b.panes.append([x0, middle, 0.1, x1, middle, top])


def add_cart(b: Builder, shop: Shop, rng: np.random.Generator, x: float, y: float) -> None:
    """A shopping cart that stands along x, its middle at (x, y): a mesh of rods, wheels, a handle and some goods."""
    first = len(b.blocks)
    half, side, low, high = 0.42, 0.26, 0.45, 0.95

    def box(lo: tuple[float, float, float], hi: tuple[float, float, float], texture: int) -> None:
        b.solid((x + lo[0], y + lo[1], lo[2]), (x + hi[0], y + hi[1], hi[2]), [texture] * 6)

    for z in np.linspace(low, high, 5).tolist():
        for v in (-side, side):
            box((-half, v - ROD, z - ROD), (half, v + ROD, z + ROD), shop.steel)
        for u in (-half, half):
            box((u - ROD, -side, z - ROD), (u + ROD, side, z + ROD), shop.steel)
    for u in np.arange(-half, half, MESH).tolist():
        for v in (-side, side):
            box((u - ROD, v - ROD, low), (u + ROD, v + ROD, high), shop.steel)
    for v in np.arange(-side, side, MESH).tolist():
        for u in (-half, half):
            box((u - ROD, v - ROD, low), (u + ROD, v + ROD, high), shop.steel)
    for u in (-0.8 * half, 0.8 * half):
        for v in (-0.8 * side, 0.8 * side):
            box((u - 0.012, v - 0.012, 0.0), (u + 0.012, v + 0.012, low), shop.steel)
    box((half, -side, high), (half + 0.04, side, high + 0.04), shop.end)
    for _ in range(int(rng.integers(0, 5))):
        p = shop.products[int(rng.integers(len(shop.products)))]
        u, v = float(rng.uniform(-half, half - p.wide)), float(rng.uniform(-side, max(side - p.deep, -side + 0.01)))
        faces = [p.side, p.side, p.front, p.front, p.top, p.top]
        b.solid((x + u, y + v, low), (x + u + p.wide, y + v + p.deep, low + p.high), faces)
    b.end_group(first)
