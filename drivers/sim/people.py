"""Customers: figures of ellipsoids in patterned clothes that walk to and fro, legs and arms swinging."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drivers.sim.render import NOTHING, Moving
from drivers.sim.tables import Tables
from drivers.sim.world import SKIN
from stereo_sfm.types import F64


@dataclass(frozen=True)
class Person:
    """Walks between two points on the floor, there and back."""

    start: tuple[float, float]
    end: tuple[float, float]
    speed: float
    phase: float  # metres already walked at time 0
    height: float
    shirt: int  # index of a cloth
    trousers: int
    hair: int  # and shoes


def _pose(person: Person, seconds: float) -> tuple[F64, float, float]:
    """Position (2,), heading, phase of the step."""
    a, b = np.array(person.start), np.array(person.end)
    span = float(np.linalg.norm(b - a))
    walked = person.phase + person.speed * seconds
    lap = walked % (2 * span)
    forward = lap < span
    s = lap / span if forward else 2 - lap / span
    way = (b - a) if forward else (a - b)
    return a + s * (b - a), float(np.arctan2(way[1], way[0])), walked / 0.75 * np.pi


def _limbs(person: Person, step: float) -> list[tuple[F64, F64, float, int]]:
    """Ellipsoids in the person's axes (x ahead, z up): centre, half sizes, lean (radians about y), cloth."""
    h, swing = person.height, 0.45 * np.sin(step)
    skin = SKIN
    out = [
        (np.array([0.012, 0.0, 0.925 * h]), np.array([0.095, 0.08, 0.12]), 0.0, skin),
        (np.array([-0.012, 0.0, 0.955 * h]), np.array([0.1, 0.088, 0.09]), -0.35, person.hair),
        (np.array([0.0, 0.0, 0.85 * h]), np.array([0.05, 0.055, 0.09]), 0.0, skin),
        (np.array([0.0, 0.0, 0.79 * h]), np.array([0.09, 0.225, 0.075]), 0.0, person.shirt),
        (np.array([0.0, 0.0, 0.68 * h]), np.array([0.13, 0.21, 0.33]), 0.04, person.shirt),
        (np.array([0.0, 0.0, 0.5 * h]), np.array([0.125, 0.185, 0.16]), 0.0, person.trousers),
    ]
    for side, sign in ((-1, 1.0), (1, -1.0)):
        lean = sign * swing
        hip = np.array([0.0, side * 0.095, 0.49 * h])
        knee = hip + 0.245 * h * np.array([np.sin(lean), 0, -np.cos(lean)])
        bend = lean - 0.35 * max(0.0, sign * float(np.cos(step)))
        foot = knee + 0.235 * h * np.array([np.sin(bend), 0, -np.cos(bend)])
        out.append((0.5 * (hip + knee), np.array([0.085, 0.085, 0.15 * h]), -lean, person.trousers))
        out.append((0.5 * (knee + foot), np.array([0.06, 0.06, 0.145 * h]), -bend, person.trousers))
        toe = foot + np.array([0.06, 0.0, 0.03])
        out.append((toe, np.array([0.135, 0.048, 0.045]), 0.0, person.hair))
        shoulder = np.array([0.0, side * 0.235, 0.8 * h])
        arm = -0.8 * lean
        hand = shoulder + 0.33 * h * np.array([np.sin(arm), 0, -np.cos(arm)])
        out.append((0.5 * (shoulder + hand), np.array([0.055, 0.055, 0.19 * h]), -arm, person.shirt))
        out.append((hand, np.array([0.045, 0.03, 0.085]), -arm, skin))
    return out


def figures(world: Tables, people: list[Person], seconds: float) -> Moving:
    """Everybody as they are at a time."""
    if not people:
        return NOTHING
    boxes: list[F64] = []
    ranges: list[list[int]] = []
    rows: list[F64] = []
    cloths: list[int] = []
    for person in people:
        at, heading, step = _pose(person, seconds)
        c, s = np.cos(heading), np.sin(heading)
        turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
        lo, hi, first = np.full(3, np.inf), np.full(3, -np.inf), len(rows)
        for centre, half, lean, cloth in _limbs(person, step):
            cl, sl = np.cos(lean), np.sin(lean)
            axes = turn @ np.array([[cl, 0, sl], [0, 1.0, 0], [-sl, 0, cl]])
            middle = turn @ centre + [at[0], at[1], 0]
            extent = np.sqrt(((axes * half) ** 2).sum(1))
            lo, hi = np.minimum(lo, middle - extent), np.maximum(hi, middle + extent)
            rows.append(np.concatenate([middle, (axes / half).T.ravel(), [0.5 * (half[0] + half[1]), half[2]]]))
            cloths.append(int(world.surfaces[4 + cloth]))
        boxes.append(np.concatenate([lo, hi]))
        ranges.append([first, len(rows)])
    return NOTHING._replace(
        persons=np.array(boxes),
        persons_i=np.array(ranges, np.int64),
        ellipsoids=np.array(rows),
        ellipsoids_i=np.array(cloths, np.int64),
    )
