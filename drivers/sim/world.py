"""The simulated store as tables that the compiled ray caster reads: floor plan, shelves, products, pictures."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from drivers.sim import textures
from drivers.sim.atlas import Atlas
from drivers.sim.kernels import BIN, SHELF, SOLID
from stereo_sfm.types import F64, I64, U8

CLOTHES, HAIR, SKIN = 8, 8, 10  # of the textures that people wear: patterned cloths, then two of hair, then skin
FACING_MINUS_Y, FACING_PLUS_Y, FACING_MINUS_X, FACING_PLUS_X = 0, 1, 2, 3


class Tables(NamedTuple):
    """Everything that stands still. Metres; world axes: x along the aisles, y across them, z up, floor at 0."""

    room: F64  # (3,) extent
    groups: F64  # (G, 6) lo xyz, hi xyz around several blocks
    groups_i: I64  # (G, 2) first and last + 1 block
    blocks: F64  # (B, 6) lo xyz, hi xyz
    blocks_i: I64  # (B, 10) kind, facing, first and last + 1 level, six textures
    levels: F64  # (L, 3) z of the board's bottom, the floor products stand on, the top of the slot
    levels_i: I64  # (L, 5) first and last + 1 facing, offset into bins, open above, number of bins
    # (F, 11) cell u0 u1, box u0 u1, lower box's front w and top z, upper box's, 1 / unit height, 1 / depth, 1 / width
    facings: F64
    facings_i: I64  # (F, 5) textures front, side, top; block; level
    bins: I64  # (N,) first facing whose cell reaches into a bin of BIN metres
    texels: U8  # (M,)
    textures: I64  # (T, 4) offset, log2 width, log2 height, wraps
    texture_sizes: F64  # (T, 2) metres, (0, 0) for pictures that stretch
    surfaces: I64  # (4 + SKIN + 1,) textures of floor, floor wear, ceiling, walls, then people's clothes, hair, skin


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

    @property
    def room(self) -> tuple[float, float, float]:
        return self.gondola_length + 2 * self.margin, self.aisle_pitch * (self.gondolas + 1), self.height

    def gondola_y(self, k: int) -> float:
        """Middle of gondola k."""
        return self.aisle_pitch * (k + 1)

    def aisle_y(self, k: int) -> float:
        """Middle of aisle k, in 0..gondolas; the outermost have the wall shelves on their other side."""
        return self.aisle_pitch * (k + 0.5) + (0.2 if k == 0 else (-0.2 if k == self.gondolas else 0.0))


@dataclass(frozen=True)
class Product:
    """A carton: metres, and its pictures."""

    wide: float
    high: float
    deep: float
    front: int
    side: int
    top: int


@dataclass
class _Builder:
    """Collects rows of the tables."""

    atlas: Atlas = field(default_factory=Atlas)
    groups: list[list[float]] = field(default_factory=list[list[float]])
    groups_i: list[list[int]] = field(default_factory=list[list[int]])
    blocks: list[list[float]] = field(default_factory=list[list[float]])
    blocks_i: list[list[int]] = field(default_factory=list[list[int]])
    levels: list[list[float]] = field(default_factory=list[list[float]])
    levels_i: list[list[int]] = field(default_factory=list[list[int]])
    facings: list[list[float]] = field(default_factory=list[list[float]])
    facings_i: list[list[int]] = field(default_factory=list[list[int]])
    bins: list[int] = field(default_factory=list[int])

    def end_group(self, first: int) -> None:
        """Blocks from `first` on become a group."""
        rows = np.array(self.blocks[first:])
        self.groups.append([*rows[:, :3].min(0), *rows[:, 3:].max(0)])
        self.groups_i.append([first, len(self.blocks)])

    def solid(self, lo: tuple[float, float, float], hi: tuple[float, float, float], faces: list[int]) -> None:
        """A plain box; `faces` are textures of -x, +x, -y, +y, bottom, top."""
        self.blocks.append([*lo, *hi])
        self.blocks_i.append([SOLID, 0, 0, 0, *faces])


def make_products(rng: np.random.Generator, atlas: Atlas, count: int) -> list[Product]:
    """Cartons of grocery sizes with their labels, about 1 mm a texel."""
    out: list[Product] = []
    for _ in range(count):
        wide = float(rng.uniform(0.06, 0.28))
        high = float(np.clip(wide * rng.uniform(0.6, 1.9), 0.06, 0.34))
        deep = float(rng.uniform(0.05, 0.2))
        front = textures.label(rng, int(high * 1000), int(wide * 1000))
        side = textures.side_label(rng, front, int(high * 700), int(deep * 700))
        top = textures.top_label(rng, front, max(int(deep * 400), 12), max(int(wide * 400), 12))
        out.append(Product(wide, high, deep, atlas.add(front), atlas.add(side), atlas.add(top)))
    return out


def _fill_level(
    b: _Builder,
    plan: np.random.Generator,
    stock: np.random.Generator,
    products: list[Product],
    extent: tuple[float, float],
    slot: tuple[float, float],
    swap: tuple[np.random.Generator, float],
) -> None:
    """Rows of facings on one level of the last block. `plan` chooses products, `stock` how full the shelf is.

    Args:
        extent: (width, depth) of the level. slot: (z of the floor, clear height). swap: exchanges this fraction.
    """
    (wide, deep), (floor, clear) = extent, slot
    first, u = len(b.facings), 0.012
    fitting = [p for p in products if p.high < clear - 0.02 and p.deep < deep]
    block, level = len(b.blocks) - 1, len(b.levels)
    while u < wide - 0.05:
        p = fitting[int(plan.integers(len(fitting)))]
        count = int(plan.integers(1, 7)) if p.wide < 0.16 else int(plan.integers(1, 4))
        gap = float(plan.uniform(0.002, 0.012))
        rows = max(1, min(int((clear - 0.03) / p.high), int(plan.integers(1, 5))))
        shown = p
        if swap[0].random() < swap[1]:
            shown = products[int(swap[0].integers(len(products)))]
        for _ in range(count):
            if u + p.wide + gap > wide - 0.012:
                break
            f = stock.random(6)
            front = 0.004 + 0.03 * f[0] ** 2 + (p.deep * int(1 + 2 * f[1]) if f[2] < 0.14 else 0.0)
            low = 0 if f[2] > 0.97 else max(1, rows - int(f[3] < 0.3))
            upper = rows - low if f[3] < 0.3 and low else 0
            front = min(front, deep - 0.04)
            up_front = min(front + p.deep * int(f[4] * 2) + 0.01 * f[5], deep - 0.03)
            low_top = floor + low * p.high
            up_top = low_top + upper * p.high
            u0 = u + 0.5 * gap
            cell = [u, u + p.wide + gap, u0, u0 + p.wide]
            b.facings.append([*cell, front, low_top, up_front, up_top, 1 / p.high, 1 / p.deep, 1 / p.wide])
            b.facings_i.append([shown.front, shown.side, shown.top, block, level])
            u += p.wide + gap
        else:
            continue
        break
    last, offset, n = len(b.facings), len(b.bins), int(wide / BIN) + 1
    ends = np.array([row[1] for row in b.facings[first:]])
    b.bins += (first + np.minimum(np.searchsorted(ends, np.arange(n) * BIN, "right"), last - first - 1)).tolist()
    b.levels_i.append([first, last, offset, 0, n])


@dataclass(frozen=True)
class _Shop:
    """What every shelf of a store shares."""

    products: list[Product]
    rails: list[int]
    steel: int
    back: int
    end: int
    swap: tuple[np.random.Generator, float]
    stock: np.random.Generator


def _shelf(
    b: _Builder,
    shop: _Shop,
    plan: np.random.Generator,
    box: tuple[tuple[float, float, float], tuple[float, float, float]],
    facing: int,
    heights: list[float],
) -> None:
    """A shelf block with boards at `heights` (their tops); the uppermost slot is open above."""
    lo, hi = box
    wide, deep = (hi[0] - lo[0], hi[1] - lo[1]) if facing < 2 else (hi[1] - lo[1], hi[0] - lo[0])
    first = len(b.levels)
    rail = shop.rails[int(plan.integers(len(shop.rails)))]
    b.blocks.append([*lo, *hi])
    b.blocks_i.append(
        [SHELF, facing, first, first + len(heights), rail, shop.steel, shop.back, shop.end, shop.steel, shop.steel]
    )
    for k, z in enumerate(heights):
        top_open = k == len(heights) - 1
        thick = 0.04 if k or lo[2] > 0 else z
        clear = hi[2] - z if top_open else heights[k + 1] - 0.04 - z
        _fill_level(b, plan, shop.stock, shop.products, (wide, deep), (z, clear), shop.swap)
        b.levels_i[-1][3] = int(top_open)
        b.levels.append([z - thick, z, z + clear])


def _heights(plan: np.random.Generator, bottom: float, top: float) -> list[float]:
    """Tops of the boards between bottom and top, 28 to 42 cm apart."""
    out = [bottom]
    while out[-1] + 0.55 < top:
        out.append(out[-1] + float(plan.uniform(0.28, 0.42)))
    return out


def _shelf_pair(
    b: _Builder,
    shop: _Shop,
    plan: np.random.Generator,
    span: tuple[float, float],
    y: float,
    facing: int,
    layout: Layout,
) -> None:
    """One side of a gondola: a deeper base shelf and, set back, the upper shelves. `y` is its back."""
    depth, toe = layout.gondola_depth, 0.1
    sign = -1 if facing == FACING_MINUS_Y else 1
    base, top = 0.52, layout.shelf_top + float(plan.choice([0.0, 0.2]))
    for deep, z0, z1, heights in (
        (depth + toe, 0.0, base, [0.14]),
        (depth, base, top, [z + 0.04 for z in _heights(plan, base, top)]),
    ):
        front = y + sign * deep
        box = ((span[0], min(y, front), z0), (span[1], max(y, front), z1))
        _shelf(b, shop, plan, box, facing, heights)


def _gondola(b: _Builder, shop: _Shop, seed: tuple[int, ...], k: int, layout: Layout) -> None:
    """Two sides and two end caps."""
    plan = np.random.default_rng([*seed, 1, 0 if layout.identical else k + 1])
    first, y = len(b.blocks), layout.gondola_y(k)
    x0, x1 = layout.margin, layout.margin + layout.gondola_length
    cap = 0.45
    _shelf_pair(b, shop, plan, (x0 + cap, x1 - cap), y, FACING_MINUS_Y, layout)
    _shelf_pair(b, shop, plan, (x0 + cap, x1 - cap), y, FACING_PLUS_Y, layout)
    half = layout.gondola_depth
    for facing, lo, hi in ((FACING_MINUS_X, x0, x0 + cap), (FACING_PLUS_X, x1 - cap, x1)):
        heights = [0.16, *_heights(plan, 0.56, 1.6)]
        _shelf(b, shop, plan, ((lo, y - half, 0.0), (hi, y + half, 1.75)), facing, heights)
    b.end_group(first)


def _walls(b: _Builder, shop: _Shop, seed: tuple[int, ...], layout: Layout) -> None:
    """Shelves along the long walls; posters and doors on the short ones."""
    plan = np.random.default_rng([*seed, 2])
    x1, y1, _ = layout.room
    for facing, y in ((FACING_PLUS_Y, 0.0), (FACING_MINUS_Y, y1)):
        first = len(b.blocks)
        _shelf_pair(b, shop, plan, (1.5, x1 - 1.5), y, facing, layout)
        b.end_group(first)
    for x, face in ((0.0, 1), (x1, 0)):
        first, y = len(b.blocks), 0.6
        inside = 0.03 if face else -0.03
        while y < y1 - 1.6:
            is_door = plan.random() < 0.2
            wide, high = (0.95, 2.1) if is_door else (float(plan.uniform(0.7, 1.5)), float(plan.uniform(0.8, 1.5)))
            z = 0.0 if is_door else float(plan.uniform(0.7, 1.4))
            picture = textures.door(plan) if is_door else textures.poster(plan, int(high * 260), int(wide * 260))
            k = b.atlas.add(picture)
            b.solid((min(x, x + inside), y, z), (max(x, x + inside), y + wide, z + high), [k] * 6)
            y += wide + float(plan.uniform(0.15, 0.7))
        b.end_group(first)


def _furniture(b: _Builder, shop: _Shop, seed: tuple[int, ...], layout: Layout) -> None:
    """Aisle signs under the ceiling, pillars and promotion stacks in the cross aisles."""
    plan = np.random.default_rng([*seed, 3])
    x1, _, z1 = layout.room
    pillar = b.atlas.add(textures.wall(plan, 256), (1.2, 1.2), wrap=True)
    first = len(b.blocks)
    for k in range(layout.gondolas + 1):
        number = 1 if layout.identical else k + 1
        picture = b.atlas.add(textures.sign(number, np.random.default_rng([*seed, 4, number])))
        for x in (layout.margin + 0.6, x1 - layout.margin - 0.6):
            y = layout.aisle_y(k)
            b.solid((x - 0.03, y - 0.6, z1 - 1.0), (x + 0.03, y + 0.6, z1 - 0.4), [picture, picture] + [shop.steel] * 4)
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


def build_world(layout: Layout | None = None, seed: int = 0, exchange: float = 0.0) -> Tables:
    """Build the store.

    Args:
        layout: its plan. seed: products, labels and stock.
        exchange: fraction of the product rows whose product is another one than in the same store with 0.
    """
    layout = layout or Layout()
    b, root = _Builder(), (seed, 17)
    rng = np.random.default_rng([*root, 0])
    atlas = b.atlas
    products = make_products(rng, atlas, layout.products)
    shop = _Shop(
        products,
        [atlas.add(textures.price_rail(rng), (1.8, 0.04), wrap=True) for _ in range(3)],
        atlas.add(textures.board(rng), (0.4, 0.4), wrap=True),
        atlas.add(textures.back_panel(rng), (0.4, 0.4), wrap=True),
        atlas.add(textures.wall(rng, 256), (0.9, 0.9), wrap=True),
        (np.random.default_rng([*root, 5]), exchange),
        np.random.default_rng([*root, 6]),
    )
    for k in range(layout.gondolas):
        _gondola(b, shop, root, k, layout)
    _walls(b, shop, root, layout)
    _furniture(b, shop, root, layout)
    x1, y1, _ = layout.room
    surfaces = [
        atlas.add(textures.floor_tiles(rng), (2.4, 2.4), wrap=True),
        atlas.add(textures.floor_scuffs(rng, 1024, 1024), (x1, y1), wrap=True),
        atlas.add(textures.ceiling(rng), (2.4, 2.4), wrap=True),
        atlas.add(textures.wall(rng), (1.2, 3.6), wrap=True),
    ]
    surfaces += [atlas.add(textures.cloth(rng), (0.25, 0.25), wrap=True) for _ in range(CLOTHES)]
    surfaces += [atlas.add(textures.plain(rng, grey), (0.25, 0.25), wrap=True) for grey in (35.0, 75.0, 165.0)]
    return make_tables(atlas, layout.room, surfaces, b)


def make_tables(
    atlas: Atlas, room: tuple[float, float, float], surfaces: list[int], parts: _Builder | None = None
) -> Tables:
    """Pack what was collected."""
    b = parts or _Builder()
    texels, table, sizes = atlas.pack()
    return Tables(
        np.array(room, float),
        np.array(b.groups, float).reshape(-1, 6),
        np.array(b.groups_i, np.int64).reshape(-1, 2),
        np.array(b.blocks, float).reshape(-1, 6),
        np.array(b.blocks_i, np.int64).reshape(-1, 10),
        np.array(b.levels, float).reshape(-1, 3),
        np.array(b.levels_i, np.int64).reshape(-1, 5),
        np.array(b.facings, float).reshape(-1, 11),
        np.array(b.facings_i, np.int64).reshape(-1, 5),
        np.array(b.bins, np.int64),
        texels,
        table,
        sizes,
        np.array(surfaces, np.int64),
    )
