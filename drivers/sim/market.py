"""`sim:market`: a supermarket around the paths that a robot drove in a real one.

The floor plan follows from the paths: rows of gondolas stand along them, first those that border on them, then, aisle
by aisle, the rest of the floor. Fridges and shelves line the walls, with doors between them; checkouts stand where the
robot came in. The paths are those of OpenLORIS-Scene's market (`openloris_market/gt_market_1.txt` in the folder
STEREO_SFM_DATA), of the trajectory file given as `path`, or else made up: three rounds of the same size and kind.
"""

from __future__ import annotations

import functools
import logging
import os
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from scipy.ndimage import distance_transform_edt, minimum_filter1d

from stereo_sfm.drivers.sim import textures
from stereo_sfm.drivers.sim.drives import Gait
from stereo_sfm.drivers.sim.paths import RobotPath, joined, read_paths
from stereo_sfm.drivers.sim.people import Appearance, Person
from stereo_sfm.drivers.sim.shelves import Shop, add_shelf, board_heights
from stereo_sfm.drivers.sim.tables import Builder, Tables, make_tables
from stereo_sfm.drivers.sim.world import (
    FACING_MINUS_X,
    FACING_MINUS_Y,
    FACING_PLUS_X,
    FACING_PLUS_Y,
    Layout,
    add_gondola,
    add_shelf_pair,
    add_surfaces,
    open_shop,
)
from stereo_sfm.types import F64, Bool

log = logging.getLogger("stereo_sfm")

FILE = Path("openloris_market") / "gt_market_1.txt"
# The T265 of OpenLORIS-Scene's robot: 0.873 m ahead of its axle, 0.68 m above the floor, looking up.
GAIT = Gait(speed=0.0, height=0.68, pitch_deg=21.0, turn_seconds=0.5, ahead=0.873)

CELL = 0.25  # metres of the grid on which the floor is planned
CLEAR = 1.05  # metres between a path and a shelf
AISLE, CROSS = 1.9, 2.2  # metres between gondolas, side by side and in a row
DEPTH = 1.25  # metres of floor under a gondola with two sides
SHORT, LONG = 3.0, 12.0  # metres of a gondola
BORDER = 3.2  # metres from the walls to the first gondola
EDGE = 3.5  # metres from the paths to the walls
BORDERING = 0.3  # share of a row that must border on a path to be placed first
COUNTER = (2.4, 0.7, 0.95)  # metres of a checkout
FRIDGE_DOOR = 0.75  # metres from one frame to the next
STROLL = 5.0  # metres that a customer walks before turning
ASIDE = 0.15  # metres, standard deviation of a later round's offset from the path


@dataclass(frozen=True)
class Market:
    """A supermarket's plan. Gondolas stand along x; metres, a corner of the room at the origin."""

    room: tuple[float, float, float]
    gondolas: tuple[tuple[float, float, float], ...]  # from x, to x, y of the middle
    checkouts: tuple[tuple[float, float], ...]  # nearest corner
    style: Layout = field(default_factory=lambda: Layout(products=420, height=4.2))


def market_paths(path: str) -> list[RobotPath]:
    """The paths of a file, of the real market where STEREO_SFM_DATA holds it, else made-up ones."""
    if path:
        return read_paths(Path(path))
    found = Path(os.environ.get("STEREO_SFM_DATA", "")) / FILE
    return read_paths(found) if found.is_file() else made_up_paths()


def made_up_paths() -> list[RobotPath]:
    """Three rounds of 150 to 220 m in a store of 88 x 60 m, at 0.8 m/s with the sway of a robot among people."""
    rounds = (
        [(0, 15), (0, 30), (52, 30), (52, 9), (0, 9), (0, 13)],
        [(0, 25), (0, 30), (84, 30), (84, 9), (0, 9), (0, 22)],
        [(0, 28), (0, 51), (38, 51), (38, 27), (24, 27), (24, 24), (48, 24), (48, 3), (0, 3), (0, 27)],
    )
    out: list[RobotPath] = []
    for k, corners in enumerate(rounds):
        rng = np.random.default_rng([k, 97])
        route = np.array(corners, float)
        arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(route, axis=0), axis=1))])
        at = np.arange(0, arc[-1], 0.02)
        xy = np.stack([np.interp(at, arc, route[:, i]) for i in (0, 1)], -1)
        phase, waves = rng.uniform(0, 2 * np.pi, (2, 3)), np.array([7.0, 13.0, 29.0])
        xy += (0.25 * np.sin(2 * np.pi * at[:, None, None] / waves + phase)).sum(-1)
        wide = 150  # samples: corners of 3 m
        kernel = np.hanning(wide + 1) / np.hanning(wide + 1).sum()
        xy = np.stack([np.convolve(xy[:, i], kernel, "valid") for i in (0, 1)], -1)
        step = np.gradient(xy, axis=0)
        heading = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
        seconds: F64 = np.arange(len(xy), dtype=np.float64) * (0.02 / 0.8)
        out.append(RobotPath(seconds, np.column_stack([xy, heading])))
    return out


@functools.lru_cache(maxsize=2)
def plan(path: str) -> tuple[Market, tuple[RobotPath, ...]]:
    """The floor plan around the paths of `market_paths`, and the paths in it."""
    paths = market_paths(path)
    turn = -_direction(paths)
    turned = [p.moved(turn, np.zeros(2)) for p in paths]
    every = np.concatenate([p.course[:, :2] for p in turned])
    if (np.ptp(every, axis=0) * [1, -1]).sum() < 0:  # the longer side along x
        turned = [p.moved(np.pi / 2, np.zeros(2)) for p in turned]
        every = np.concatenate([p.course[:, :2] for p in turned])
    placed = [p.moved(0.0, EDGE - every.min(0)) for p in turned]
    extent = np.ptp(every, axis=0) + 2 * EDGE
    room = (float(np.ceil(extent[0])), float(np.ceil(extent[1])), 4.2)
    clearance = _clearance(room, placed)
    free = _free(clearance)
    checkouts = _place_checkouts(free, placed)
    market = Market(room, _place_gondolas(free, clearance), checkouts)
    log.info("sim:market: %.0f m2, %d gondolas, %d paths", room[0] * room[1], len(market.gondolas), len(placed))
    return market, tuple(placed)


def _direction(paths: list[RobotPath]) -> float:
    """Radians of the axis along or across which most of the path goes."""
    total = 0j
    for p in paths:
        arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(p.course[:, :2], axis=0), axis=1))])
        at = np.searchsorted(arc, np.arange(0.0, arc[-1], 1.0))
        step = np.diff(p.course[at, :2], axis=0)
        total += (np.linalg.norm(step, axis=1) * np.exp(4j * np.arctan2(step[:, 1], step[:, 0]))).sum()
    return float(np.angle(total)) / 4


def _clearance(room: tuple[float, float, float], paths: list[RobotPath]) -> F64:
    """(ny, nx) metres from each cell of the floor to the nearest path of the camera or the axle."""
    shape = round(room[1] / CELL), round(room[0] / CELL)
    away = np.ones(shape, bool)
    course = joined(paths).course
    camera = course[:, :2] + GAIT.ahead * np.column_stack([np.cos(course[:, 2]), np.sin(course[:, 2])])
    for xy in (course[:, :2], camera):
        arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(xy, axis=0), axis=1))])
        every = np.arange(0.0, arc[-1], 0.25 * CELL)
        column, row = ((np.interp(every, arc, xy[:, i]) / CELL).astype(int) for i in (0, 1))
        away[np.clip(row, 0, shape[0] - 1), np.clip(column, 0, shape[1] - 1)] = False
    return np.asarray(distance_transform_edt(away)) * CELL


def _free(clearance: F64) -> Bool:
    """(ny, nx) cells of the floor on which gondolas may stand."""
    free = clearance > CLEAR + CELL
    edge = round(BORDER / CELL)
    free[:edge], free[-edge:], free[:, :edge], free[:, -edge:] = False, False, False, False
    return free


def _place_checkouts(free: Bool, paths: list[RobotPath]) -> tuple[tuple[float, float], ...]:
    """Counters beside each other near the first path's start, taken out of the free floor."""
    out: list[tuple[float, float]] = []
    nx, ny = (round(v / CELL) for v in COUNTER[:2])
    start = paths[0].course[0, :2] / CELL
    rows, columns = np.nonzero(free[: -ny or None, : -nx or None])
    for k in np.argsort(np.hypot(columns - start[0], 0.4 * (rows - start[1])), kind="stable").tolist():
        i, j = int(rows[k]), int(columns[k])
        if free[i : i + ny, j : j + nx].all():
            out.append((j * CELL, i * CELL))
            _take(free, i, j, ny, nx, round(1.2 / CELL), round(AISLE / CELL))
        if len(out) == 8:
            break
    return tuple(out)


def _take(free: Bool, i: int, j: int, ny: int, nx: int, gap_y: int, gap_x: int) -> None:
    """Rows i.. and columns j.. are used, with gaps around them."""
    free[max(i - gap_y, 0) : i + ny + gap_y, max(j - gap_x, 0) : j + nx + gap_x] = False


def _place_gondolas(free: Bool, clearance: F64) -> tuple[tuple[float, float, float], ...]:
    """Rows along x on the free floor: those that border on a path first, the longest of these first; then the rest."""
    deep, gap_y, gap_x = round(DEPTH / CELL), round(AISLE / CELL), round(CROSS / CELL)
    near = clearance < CLEAR + 3 * CELL
    out: list[tuple[float, float, float]] = []
    for share in (BORDERING, 0.0):
        above, below = np.roll(near, -deep, 0), np.roll(near, 1, 0)  # the rows beside a gondola that begins at a row
        beside = (_rows(free, deep) & (above | below)).sum(1) if share else np.zeros(len(free))
        for i in np.argsort(-beside, kind="stable").tolist():
            for first, last in _runs(_rows(free, deep)[i]):
                if (above | below)[i, first:last].mean() < share:
                    continue
                for j, n in _pieces(first, last):
                    if free[i : i + deep, j : j + n].all():
                        out.append((j * CELL, (j + n) * CELL, (i + 0.5 * deep) * CELL))
                        _take(free, i, j, deep, n, gap_y, gap_x)
    return tuple(sorted(out, key=lambda g: (g[2], g[0])))


def _rows(free: Bool, deep: int) -> Bool:
    """(ny, nx) whether `deep` rows from each on are free."""
    ahead = minimum_filter1d(free, deep, axis=0, origin=-(deep // 2), mode="constant", cval=0)
    return np.asarray(ahead, bool)


def _runs(row: Bool) -> list[tuple[int, int]]:
    """Spans of true cells that are long enough for a gondola."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], row.astype(np.int8), [0]])))
    spans = zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)
    return [(a, b) for a, b in spans if (b - a) * CELL >= SHORT]


def _pieces(first: int, last: int) -> list[tuple[int, int]]:
    """First cell and number of cells of equally long gondolas with cross aisles between them."""
    gap, most = round(CROSS / CELL), round(LONG / CELL)
    count = -(-(last - first + gap) // (most + gap))
    each = (last - first + gap) // count - gap
    return [(first + k * (each + gap), each) for k in range(count)] if each * CELL >= SHORT else []


def session_path(paths: tuple[RobotPath, ...], walk: int, length: float, rng: np.random.Generator) -> RobotPath:
    """The path of a session; a drive longer than it goes on with the next, and rounds after all of them lie beside.

    Args:
        walk: number of the session. length: metres driven, 0: the session's own.
    """
    chosen = [paths[walk % len(paths)]]
    while sum(p.length for p in chosen) < length:
        chosen.append(paths[(walk + len(chosen)) % len(paths)])
    path = joined(chosen)
    if walk < len(paths):
        return path
    side = np.column_stack([-np.sin(path.course[:, 2]), np.cos(path.course[:, 2])])
    offset = float(np.clip(rng.normal(0, ASIDE), -2 * ASIDE, 2 * ASIDE))
    return replace(path, course=path.course + np.column_stack([offset * side, np.zeros(len(side))]))


def shoppers(paths: tuple[RobotPath, ...], count: int, rng: np.random.Generator) -> list[Person]:
    """People who walk to and fro along pieces of the paths, beside the robot."""
    out: list[Person] = []
    for n in range(count):
        course = paths[n % len(paths)].course
        arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(course[:, :2], axis=0), axis=1))])
        begin = rng.uniform(0, max(arc[-1] - STROLL, 0.1))
        first, last = np.minimum(np.searchsorted(arc, [begin, begin + STROLL]), len(arc) - 1)
        heading, beside = course[first, 2], float(rng.choice([-0.6, 0.6]))
        side = beside * np.array([-np.sin(heading), np.cos(heading)])
        ends = [(float(x), float(y)) for x, y in (course[k, :2] + side for k in (first, last))]
        speed, phase = float(rng.uniform(0.5, 1.2)), float(rng.uniform(0, 20))
        out.append(Person(ends[0], ends[1], speed, phase, Appearance.random(rng)))
    return out


def build_market(market: Market, seed: int = 0, exchange: float = 0.0, nights: int = 0) -> Tables:
    """Build the store; arguments as of `world.build_world`."""
    b, root = Builder(), (seed, 19)
    rng = np.random.default_rng([*root, 0])
    shop = open_shop(b, rng, root, market.style, (exchange, nights))
    for k, (x0, x1, y) in enumerate(market.gondolas):
        add_gondola(b, shop, np.random.default_rng([*root, 1, k + 1]), (x0, x1), y, market.style)
        _signs(b, shop, (*root, 4, k), k + 1, (x0, x1), y)
    for k, (x, y) in enumerate(market.checkouts):
        _checkout(b, shop, np.random.default_rng([*root, 7, k]), x, y)
    _walls(b, shop, np.random.default_rng([*root, 2]), market)
    return make_tables(b.atlas, market.room, add_surfaces(b.atlas, rng, market.room, 2048), b)


def _signs(b: Builder, shop: Shop, seed: tuple[int, ...], number: int, span: tuple[float, float], y: float) -> None:
    """The gondola's number above both its ends."""
    first = len(b.blocks)
    texture = b.atlas.add(textures.sign(number, np.random.default_rng(seed)))
    for x in (span[0] + 0.3, span[1] - 0.3):
        b.solid((x - 0.03, y - 0.6, 2.6), (x + 0.03, y + 0.6, 3.2), [texture, texture] + [shop.steel] * 4)
    b.end_group(first)


def _checkout(b: Builder, shop: Shop, plan: np.random.Generator, x: float, y: float) -> None:
    """A counter with a rack of products at its end and a lamp with a number."""
    first = len(b.blocks)
    wide, deep, high = COUNTER
    panel = b.atlas.add(textures.poster(plan, 200, 400))
    b.solid((x, y, 0.0), (x + wide - 0.5, y + deep, high), [shop.end, shop.end, panel, panel, shop.steel, shop.steel])
    for facing, (y0, y1) in ((FACING_MINUS_Y, (y, y + 0.5 * deep)), (FACING_PLUS_Y, (y + 0.5 * deep, y + deep))):
        box = ((x + wide - 0.45, y0, 0.0), (x + wide, y1, 1.45))
        add_shelf(b, shop, plan, box, facing, [0.2, *board_heights(plan, 0.55, 1.3)])
    lamp = b.atlas.add(textures.poster(plan, 96, 96))
    b.solid((x + 0.2, y + 0.2, 1.9), (x + 0.5, y + 0.5, 2.25), [lamp] * 6)
    b.solid((x + 0.33, y + 0.33, high), (x + 0.37, y + 0.37, 1.9), [shop.steel] * 6)
    b.end_group(first)


def _walls(b: Builder, shop: Shop, plan: np.random.Generator, market: Market) -> None:
    """Along the long walls shelves and fridges by turns, along the short ones posters; doors in all of them."""
    x1, y1, _ = market.room
    for facing, back in ((FACING_PLUS_Y, 0.0), (FACING_MINUS_Y, y1)):
        x, cold = 1.5, False
        while x + 4.0 < x1:
            end = min(x + float(plan.uniform(7.0, 12.0)), x1 - 1.5)
            first = len(b.blocks)
            if cold:
                _fridge(b, shop, plan, (x, end), back, facing)
            else:
                add_shelf_pair(b, shop, plan, (x, end), back, facing, market.style)
            b.end_group(first)
            cold = not cold
            _hang(b, plan, (end + 0.2, back), 1.0, facing, door=True)
            x = end + 1.4
    for facing, x in ((FACING_PLUS_X, 0.0), (FACING_MINUS_X, x1)):
        y = 0.8
        while y < y1 - 2.0:
            wide = float(plan.uniform(0.8, 1.6))
            _hang(b, plan, (x, y), wide, facing, door=plan.random() < 0.25)
            y += wide + float(plan.uniform(0.15, 0.7))


def _hang(b: Builder, plan: np.random.Generator, at: tuple[float, float], wide: float, facing: int, door: bool) -> None:
    """A door or a poster on a wall, from `at` on along it."""
    first = len(b.blocks)
    high, z = (2.1, 0.0) if door else (float(plan.uniform(0.8, 1.5)), float(plan.uniform(0.7, 1.4)))
    wide = 0.95 if door else wide
    image = textures.door(plan) if door else textures.poster(plan, int(high * 200), int(wide * 200))
    k, deep = b.atlas.add(image), 0.03 if facing in (FACING_PLUS_X, FACING_PLUS_Y) else -0.03
    along_x = facing in (FACING_PLUS_Y, FACING_MINUS_Y)
    ends = (at[0] + (wide if along_x else deep), at[1] + (deep if along_x else wide))
    lo, hi = (tuple(f(a, e) for a, e in zip(at, ends, strict=True)) for f in (min, max))
    b.solid((lo[0], lo[1], z), (hi[0], hi[1], z + high), [k] * 6)
    b.end_group(first)


def _fridge(
    b: Builder, shop: Shop, plan: np.random.Generator, span: tuple[float, float], back: float, facing: int
) -> None:
    """A tall shelf behind the frames of its doors, with a header."""
    sign, deep, high = (1 if facing == FACING_PLUS_Y else -1), 0.75, 2.15
    front = back + sign * deep
    box = ((span[0], min(back, front), 0.0), (span[1], max(back, front), 2.0))
    add_shelf(b, shop, plan, box, facing, [0.22, *board_heights(plan, 0.6, 1.95)])
    y0, y1 = min(front, front + sign * 0.04), max(front, front + sign * 0.04)
    for x in np.linspace(span[0], span[1], max(2, round((span[1] - span[0]) / FRIDGE_DOOR) + 1)).tolist():
        b.solid((x - 0.03, y0, 0.1), (x + 0.03, y1, 2.0), [shop.steel] * 6)
    b.panes.append([span[0], 0.5 * (y0 + y1), 0.1, span[1], 0.5 * (y0 + y1), 2.0])
    head = b.atlas.add(textures.poster(plan, 64, 1024))
    b.solid(
        (span[0], min(back, front), 2.0),
        (span[1], max(back, front), high),
        [shop.end, shop.end, head, head, shop.end, shop.end],
    )
