"""The simulated store's floor plan: gondolas with shelves on both sides and at their ends, walls, signs, pillars."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from stereo_sfm.drivers.sim import textures
from stereo_sfm.drivers.sim.atlas import Atlas
from stereo_sfm.drivers.sim.fittings import add_cart, add_doors, materials
from stereo_sfm.drivers.sim.shelves import Mix, Shop, add_shelf, board_heights, make_products
from stereo_sfm.drivers.sim.tables import Builder, Tables, make_tables

CLOTHES, HAIR, SKIN = 8, 8, 10  # of the textures that people wear: patterned cloths, then two of hair, then skin
FACING_MINUS_Y, FACING_PLUS_Y, FACING_MINUS_X, FACING_PLUS_X = 0, 1, 2, 3
DOORWAY = (1.1, 2.1)  # metres wide and high
PARTITION = 0.15  # metres, thickness of the wall of a stockroom


@dataclass(frozen=True)
class Layout:
    """A store's plan. Gondolas stand along x, aisles between them; `identical` repeats one gondola's planogram."""

    gondolas: int = 5
    gondola_length: float = 12.0
    aisle_pitch: float = 3.0  # metres from one aisle's middle to the next
    gondola_depth: float = 0.45  # one side
    margin: float = 3.0  # cross aisle at both ends, to the wall
    height: float = 3.6
    shelf_top: float = 1.9
    identical: bool = False
    products: int = 260
    fill: float = 1.0  # fraction of product rows that are present
    gaps: float = 0.0  # fraction of the single facings that are sold out
    setback: float = 0.0  # metres, largest setback of a product row from the shelf's edge
    mix: Mix = field(default_factory=Mix)
    glass: float = 0.0  # share of the shelves' length behind glass doors
    bare: float = 0.0  # share of the shelves' length that is a white wall instead
    polish: float = 0.0  # of the floor, 0: matt, 1: wet
    carts: int = 0  # shopping carts that stand in the aisles of `build_world`
    stockroom: float = 0.0  # metres of a room behind a wall with a doorway, at the end of the aisles

    def with_stock(self, densities: dict[str, float]) -> Layout:
        """With other values of those fields, of the layout or its mix."""
        mix = {f.name: densities[f.name] for f in fields(Mix) if f.name in densities}
        own: dict[str, Any] = {name: value for name, value in densities.items() if name not in mix}
        return replace(self, mix=replace(self.mix, **mix), **own)

    @property
    def room(self) -> tuple[float, float, float]:
        return self.shop_length + self.stockroom, self.aisle_pitch * (self.gondolas + 1), self.height

    @property
    def shop_length(self) -> float:
        """Metres from wall to wall along the gondolas, without the stockroom."""
        return self.gondola_length + 2 * self.margin

    @property
    def doorway(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Both ends of the stockroom's doorway on the floor, in the middle of its wall; it continues aisle 1."""
        x, y = self.shop_length + 0.5 * PARTITION, self.aisle_y(1)
        return (x, y - 0.5 * DOORWAY[0]), (x, y + 0.5 * DOORWAY[0])

    def gondola_y(self, k: int) -> float:
        """Middle of gondola k."""
        return self.aisle_pitch * (k + 1)

    def aisle_y(self, k: int) -> float:
        """Middle of aisle k, in 0..gondolas; the outermost have the wall shelves on their other side."""
        return self.aisle_pitch * (k + 0.5) + (0.2 if k == 0 else (-0.2 if k == self.gondolas else 0.0))


def add_shelf_pair(
    b: Builder,
    shop: Shop,
    plan: np.random.Generator,
    span: tuple[float, float],
    y: float,
    facing: int,
    layout: Layout,
) -> None:
    """One side of a gondola: a deeper base shelf and, set back, the upper shelves. `y` is its back.

    Of its length, a share at one end is a bare wall, and one at the other end has glass doors.
    """
    depth, toe = layout.gondola_depth, 0.1
    sign = -1 if facing == FACING_MINUS_Y else 1
    base, top = 0.52, layout.shelf_top + float(plan.choice([0.0, 0.2]))
    ends = (y, y + sign * depth)
    if layout.bare > 0:
        cut = span[1] - layout.bare * (span[1] - span[0])
        b.solid((cut, min(ends), 0.0), (span[1], max(ends), top + 0.1), [shop.plain] * 6)
        span = (span[0], cut)
    if layout.glass > 0:
        add_doors(b, shop, (span[0], span[0] + layout.glass * (span[1] - span[0])), (y, ends[1] + sign * toe), top)
    for deep, z0, z1, heights in (
        (depth + toe, 0.0, base, [0.14]),
        (depth, base, top, [z + 0.04 for z in board_heights(plan, base, top)]),
    ):
        front = y + sign * deep
        box = ((span[0], min(y, front), z0), (span[1], max(y, front), z1))
        add_shelf(b, shop, plan, box, facing, heights)


def add_gondola(
    b: Builder, shop: Shop, plan: np.random.Generator, span: tuple[float, float], y: float, layout: Layout
) -> None:
    """Two sides and two end caps, from x to x around the middle y."""
    first = len(b.blocks)
    x0, x1 = span
    cap = 0.45
    add_shelf_pair(b, shop, plan, (x0 + cap, x1 - cap), y, FACING_MINUS_Y, layout)
    add_shelf_pair(b, shop, plan, (x0 + cap, x1 - cap), y, FACING_PLUS_Y, layout)
    half = layout.gondola_depth
    for facing, lo, hi in ((FACING_MINUS_X, x0, x0 + cap), (FACING_PLUS_X, x1 - cap, x1)):
        heights = [0.16, *board_heights(plan, 0.56, 1.6)]
        add_shelf(b, shop, plan, ((lo, y - half, 0.0), (hi, y + half, 1.75)), facing, heights)
    b.end_group(first)


def _walls(b: Builder, shop: Shop, seed: tuple[int, ...], layout: Layout) -> None:
    """Shelves along the long walls; posters and doors on the short ones."""
    plan = np.random.default_rng([*seed, 2])
    x1, y1 = layout.shop_length, layout.room[1]
    for facing, y in ((FACING_PLUS_Y, 0.0), (FACING_MINUS_Y, y1)):
        first = len(b.blocks)
        add_shelf_pair(b, shop, plan, (1.5, x1 - 1.5), y, facing, layout)
        b.end_group(first)
    for x, deep in ((0.0, 0.03), (x1, -0.03)):
        _hang(b, plan, (x, deep), y1, layout.doorway if layout.stockroom and x > 0 else None)


def _hang(
    b: Builder,
    plan: np.random.Generator,
    face: tuple[float, float],
    y1: float,
    doorway: tuple[tuple[float, float], tuple[float, float]] | None,
) -> None:
    """Posters and doors along a wall. `face`: x of the wall, and how far they stand out; none where a doorway is."""
    first, y = len(b.blocks), 0.6
    x, deep = face
    while y < y1 - 1.6:
        is_door = plan.random() < 0.2
        wide, high = (0.95, 2.1) if is_door else (float(plan.uniform(0.7, 1.5)), float(plan.uniform(0.8, 1.5)))
        z = 0.0 if is_door else float(plan.uniform(0.7, 1.4))
        image = textures.door(plan) if is_door else textures.poster(plan, int(high * 260), int(wide * 260))
        k = b.atlas.add(image)
        if doorway is None or y >= doorway[1][1] or y + wide <= doorway[0][1]:
            b.solid((min(x, x + deep), y, z), (max(x, x + deep), y + wide, z + high), [k] * 6)
        y += wide + float(plan.uniform(0.15, 0.7))
    b.end_group(first)


def _stockroom(b: Builder, shop: Shop, seed: tuple[int, ...], layout: Layout) -> None:
    """The wall between shop and stockroom with its doorway and posters, and shelves along the wall behind."""
    plan = np.random.default_rng([*seed, 13])
    (middle, y_low), (_, y_high) = layout.doorway
    x0, x1 = middle - 0.5 * PARTITION, middle + 0.5 * PARTITION
    far, y1, z1 = layout.room
    panel = b.atlas.add(textures.wall(plan, 256), (1.2, 1.2), wrap=True)
    first = len(b.blocks)
    for lo, hi in (((0.0, 0.0), (y_low, z1)), ((y_high, 0.0), (y1, z1)), ((y_low, DOORWAY[1]), (y_high, z1))):
        b.solid((x0, lo[0], lo[1]), (x1, hi[0], hi[1]), [panel] * 6)
    b.end_group(first)
    _hang(b, plan, (x1, 0.03), y1, layout.doorway)
    first, deep = len(b.blocks), layout.gondola_depth
    heights = [0.14, *board_heights(plan, 0.5, layout.shelf_top)]
    add_shelf(b, shop, plan, ((far - deep, 0.3, 0.0), (far, y1 - 0.3, layout.shelf_top)), FACING_MINUS_X, heights)
    b.end_group(first)


def _furniture(b: Builder, shop: Shop, seed: tuple[int, ...], layout: Layout) -> None:
    """Aisle signs under the ceiling, pillars and promotion stacks in the cross aisles."""
    plan = np.random.default_rng([*seed, 3])
    x1, z1 = layout.shop_length, layout.height
    pillar = b.atlas.add(textures.wall(plan, 256), (1.2, 1.2), wrap=True)
    first = len(b.blocks)
    for k in range(layout.gondolas + 1):
        number = 1 if layout.identical else k + 1
        texture = b.atlas.add(textures.sign(number, np.random.default_rng([*seed, 4, number])))
        for x in (layout.margin + 0.6, x1 - layout.margin - 0.6):
            y = layout.aisle_y(k)
            b.solid((x - 0.03, y - 0.6, z1 - 1.0), (x + 0.03, y + 0.6, z1 - 0.4), [texture, texture] + [shop.steel] * 4)
    b.end_group(first)
    for x in (0.55, x1 - 0.95):
        first = len(b.blocks)
        for k in range(layout.gondolas):
            y = layout.gondola_y(k)
            if k % 2 == 0:
                b.solid((x, y - 0.2, 0.0), (x + 0.4, y + 0.2, z1), [pillar] * 6)
                continue
            for n in range(int(plan.integers(2, 5))):
                p = shop.products[int(plan.integers(len(shop.products)))]
                dy, z = float(plan.uniform(-0.05, 0.05)), 0.3 * n
                faces = [p.front, p.front, p.side, p.side, p.top, p.top]
                b.solid((x, y - 0.3 + dy, z), (x + 0.4, y + 0.3 + dy, z + 0.3), faces)
        b.end_group(first)


def _carts(b: Builder, shop: Shop, seed: tuple[int, ...], layout: Layout) -> None:
    """Shopping carts along the gondolas, on one side of each inner aisle."""
    plan = np.random.default_rng([*seed, 12])
    for n in range(layout.carts):
        y = layout.gondola_y(n % max(layout.gondolas - 1, 1)) + layout.gondola_depth + 0.42
        x = layout.margin + float(plan.uniform(0.3, layout.gondola_length - 0.3))
        add_cart(b, shop, plan, x, y)


def build_world(layout: Layout | None = None, seed: int = 0, exchange: float = 0.0, nights: int = 0) -> Tables:
    """Build the store.

    Args:
        layout: its plan. seed: products, labels and stock.
        exchange: fraction of the product rows with another product than at 0.
        nights: in each of which that fraction is exchanged; 0: once.
    """
    layout = layout or Layout()
    b, root = Builder(), (seed, 17)
    rng = np.random.default_rng([*root, 0])
    shop = open_shop(b, rng, root, layout, (exchange, nights))
    for k in range(layout.gondolas):
        plan = np.random.default_rng([*root, 1, 0 if layout.identical else k + 1])
        span = (layout.margin, layout.margin + layout.gondola_length)
        add_gondola(b, shop, plan, span, layout.gondola_y(k), layout)
    _walls(b, shop, root, layout)
    _furniture(b, shop, root, layout)
    _carts(b, shop, root, layout)
    if layout.stockroom:
        _stockroom(b, shop, root, layout)
    return make_tables(b.atlas, layout.room, add_surfaces(b.atlas, rng, layout.room), b)


def open_shop(
    b: Builder, rng: np.random.Generator, root: tuple[int, ...], layout: Layout, changes: tuple[float, int]
) -> Shop:
    """The products and textures that all shelves of a store have in common; `root` seeds its generators.

    `changes`: exchange and nights as of `build_world`.
    """
    atlas = b.atlas
    products = make_products(rng, atlas, layout.products)
    b.materials = materials(layout.polish, layout.glass > 0 or layout.mix != Mix())
    return Shop(
        products if layout.mix == Mix() else layout.mix.applied(products, np.random.default_rng([*root, 10])),
        [atlas.add(textures.price_rail(rng), (1.8, 0.04), wrap=True) for _ in range(3)],
        atlas.add(textures.board(rng), (0.4, 0.4), wrap=True),
        atlas.add(textures.back_panel(rng), (0.4, 0.4), wrap=True),
        atlas.add(textures.wall(rng, 256), (0.9, 0.9), wrap=True),
        atlas.add(textures.plain(np.random.default_rng([*root, 11]), 215.0), (0.25, 0.25), wrap=True)
        if layout.bare > 0
        else -1,
        np.random.default_rng([*root, 6]),
        np.random.default_rng([*root, 5]),
        changes[0],
        layout.fill,
        np.random.default_rng([*root, 8]),
        layout.gaps,
        layout.setback,
        changes[1],
        (*root, 9),
    )


def add_surfaces(
    atlas: Atlas, rng: np.random.Generator, room: tuple[float, float, float], scuffs: int = 1024
) -> list[int]:
    """Floor, ceiling, walls, and what people wear; `scuffs`: texels along the sides of the floor's wear."""
    x1, y1, _ = room
    surfaces = [
        atlas.add(textures.floor_tiles(rng), (2.4, 2.4), wrap=True),
        atlas.add(textures.floor_scuffs(rng, scuffs, scuffs), (x1, y1), wrap=True),
        atlas.add(textures.ceiling(rng), (2.4, 2.4), wrap=True),
        atlas.add(textures.wall(rng), (1.2, 3.6), wrap=True),
    ]
    surfaces += [atlas.add(textures.cloth(rng), (0.25, 0.25), wrap=True) for _ in range(CLOTHES)]
    surfaces += [atlas.add(textures.plain(rng, grey), (0.25, 0.25), wrap=True) for grey in (35.0, 75.0, 165.0)]
    return surfaces
