"""Shelves and their products: rows of facings, several of each product side by side, stacked and set back."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from stereo_sfm.drivers.sim import labels
from stereo_sfm.drivers.sim.atlas import Atlas
from stereo_sfm.drivers.sim.kernels import BIN, BOTTLE, CAN, CARTON, HUNG, SHELF
from stereo_sfm.drivers.sim.optics import CLEAR, FOIL, GLOSSY, MATT
from stereo_sfm.drivers.sim.tables import Builder


@dataclass(frozen=True)
class Product:
    """Its size in metres and its textures."""

    wide: float
    high: float
    deep: float
    front: int
    side: int
    top: int
    form: int = CARTON
    material: int = MATT


@dataclass(frozen=True)
class Mix:
    """Shares of a store's products."""

    round: float = 0.0  # cans and bottles
    hanging: float = 0.0  # bags on hooks
    glossy: float = 0.0  # varnished, or of foil
    clear: float = 0.0  # of the round ones

    def applied(self, products: list[Product], rng: np.random.Generator) -> list[Product]:
        """The products, so many of them in other forms and materials."""
        draws = rng.random((len(products), 3))
        return [self._changed(p, *d) for p, d in zip(products, draws.tolist(), strict=True)]

    def _changed(self, p: Product, form: float, material: float, kind: float) -> Product:
        if form < self.round:
            wide = 0.055 + 0.3 * (p.wide - 0.06)
            form_of = BOTTLE if p.high > 2 * wide else CAN
            shine = CLEAR if material < self.clear else (GLOSSY if kind < self.glossy else MATT)
            return replace(p, wide=wide, deep=wide, form=form_of, material=shine)
        if form < self.round + self.hanging:
            return replace(p, deep=0.06, form=HUNG, material=FOIL if material < self.glossy else MATT)
        return replace(p, material=(FOIL if kind < 0.3 else GLOSSY) if material < self.glossy else MATT)


@dataclass(frozen=True)
class Shop:
    """Common to all shelves of a store."""

    products: list[Product]
    rails: list[int]  # textures
    steel: int
    back: int
    end: int
    plain: int
    stock: np.random.Generator  # how full the shelves are
    changes: np.random.Generator  # which product rows are exchanged
    exchange: float  # fraction of product rows
    fill: float  # fraction of product rows that are present
    order: np.random.Generator  # which facings are sold out, and how far the others are set back
    gaps: float  # fraction of facings that are sold out
    setback: float  # metres, largest setback of a product row
    nights: int = 0  # in each of which that fraction of the rows is exchanged; 0: once
    night_seed: tuple[int, ...] = ()


def _shown(shop: Shop, p: Product, row: int) -> Product:
    """The product whose textures a row of facings planned for `p` shows."""
    if not shop.nights:
        if shop.changes.random() < shop.exchange:
            return shop.products[int(shop.changes.integers(len(shop.products)))]
        return p
    draws = np.random.default_rng([*shop.night_seed, row]).random((shop.nights, 2))  # a longer time begins the same
    exchanged = np.flatnonzero(draws[:, 0] < shop.exchange)
    return shop.products[int(draws[exchanged[-1], 1] * len(shop.products))] if len(exchanged) else p


def make_products(rng: np.random.Generator, atlas: Atlas, count: int) -> list[Product]:
    """Cartons of grocery sizes with their labels, about 1 mm a texel."""
    out: list[Product] = []
    for _ in range(count):
        wide = float(rng.uniform(0.06, 0.28))
        high = float(np.clip(wide * rng.uniform(0.6, 1.9), 0.06, 0.34))
        deep = float(rng.uniform(0.05, 0.2))
        front = labels.label(rng, int(high * 1000), int(wide * 1000))
        side = labels.side_label(rng, front, int(high * 700), int(deep * 700))
        top = labels.top_label(rng, front, max(int(deep * 400), 12), max(int(wide * 400), 12))
        out.append(Product(wide, high, deep, atlas.add(front), atlas.add(side), atlas.add(top)))
    return out


def _facing(shop: Shop, p: Product, rows: int, deep: float, floor: float) -> list[float]:
    """Columns 4 to 10 of a facing: fronts and tops of its lower and upper box, and the product's sizes inverted."""
    f = shop.stock.random(6)
    low = 0 if f[2] > 0.97 else max(1, rows - int(f[3] < 0.3))
    upper = rows - low if f[3] < 0.3 and low else 0
    front = 0.004 + 0.03 * f[0] ** 2 + (p.deep * int(1 + 2 * f[1]) if f[2] < 0.14 else 0.0)
    front = min(front, deep - 0.04)
    up_front = min(front + p.deep * int(f[4] * 2) + 0.01 * f[5], deep - 0.03)
    low_top = floor + low * p.high
    return [front, low_top, up_front, low_top + upper * p.high, 1 / p.high, 1 / p.deep, 1 / p.wide]


def _hung(p: Product, boxes: list[float], deep: float, top: float) -> list[float]:
    """The boxes of a facing whose goods hang from `top`: nothing, and above it the front of the bags."""
    front, *_, x, y, z = boxes
    return [deep, top - p.high, front, top, x, y, z]


def _disorder(shop: Shop, boxes: list[float], back: float, deep: float, floor: float) -> list[float]:
    """The boxes of a facing, sold out or set back by about `back` metres."""
    sold_out, shift = shop.order.random(2)
    front, low_top, up_front, top, *inverses = boxes
    if sold_out < shop.gaps:
        return [front, floor, up_front, floor, *inverses]
    shift = back + 0.06 * shop.setback * float(shift)
    front, up_front = (min(w + shift, deep - 0.03) for w in (front, up_front))
    return [front, low_top, up_front, top, *inverses]


def _fill_level(
    b: Builder, shop: Shop, plan: np.random.Generator, extent: tuple[float, float], slot: tuple[float, float]
) -> None:
    """Rows of facings on one level of the last block; `plan` chooses the products.

    Args:
        extent: (width, depth) of the level. slot: (z of the floor, clear height).
    """
    (wide, deep), (floor, clear) = extent, slot
    first, u, end = len(b.facings), 0.012, wide - 0.012
    fitting = [p for p in shop.products if p.high < clear - 0.02 and p.deep < deep]
    while u < wide - 0.05:
        p = fitting[int(plan.integers(len(fitting)))]
        count = int(plan.integers(1, 7)) if p.wide < 0.16 else int(plan.integers(1, 4))
        gap = float(plan.uniform(0.002, 0.012))
        rows = max(1, min(int((clear - 0.03) / p.high), int(plan.integers(1, 5))))
        rows = 1 if p.form in (BOTTLE, HUNG) else rows
        shown = _shown(shop, p, len(b.facings))
        pitch = p.wide + gap
        fits = min(count, int((end - u) / pitch))
        missing = shop.fill < 1 and plan.random() >= shop.fill
        back = float(shop.order.random()) * min(shop.setback, deep - p.deep) if shop.setback > 0 else 0.0
        for k in range(0 if missing else fits):
            u0 = u + k * pitch
            cell = [u0, u0 + pitch, u0 + 0.5 * gap, u0 + 0.5 * gap + p.wide]
            boxes = _facing(shop, p, rows, deep, floor)
            if p.form == HUNG:
                boxes = _hung(p, boxes, deep, floor + clear - 0.015)
            if shop.gaps > 0 or back > 0:
                boxes = _disorder(shop, boxes, back, deep, floor)
            b.facings.append([*cell, *boxes])
            places = [len(b.blocks) - 1, len(b.levels)]
            b.facings_i.append([shown.front, shown.side, shown.top, *places, p.form, p.material])
        u += fits * pitch
        if fits < count:
            break
    _index_level(b, first, wide)


def _index_level(b: Builder, first: int, wide: float) -> None:
    """Bins that map each BIN metres of a level to a facing, and the level's row."""
    last, offset, n = len(b.facings), len(b.bins), int(wide / BIN) + 1
    ends = np.array([row[1] for row in b.facings[first:]])
    found = np.minimum(np.searchsorted(ends, np.arange(n) * BIN, "right"), max(last - first - 1, 0))
    b.bins += (first + found).tolist()
    b.levels_i.append([first, last, offset, 0, n])


def add_shelf(
    b: Builder,
    shop: Shop,
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
        _fill_level(b, shop, plan, (wide, deep), (z, clear))
        b.levels_i[-1][3] = int(top_open)
        b.levels.append([z - thick, z, z + clear])


def board_heights(plan: np.random.Generator, bottom: float, top: float) -> list[float]:
    """Tops of the boards between bottom and top, 28 to 42 cm apart."""
    out = [bottom]
    while out[-1] + 0.55 < top:
        out.append(out[-1] + float(plan.uniform(0.28, 0.42)))
    return out
