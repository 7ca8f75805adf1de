"""Moving objects of the store: things made of ellipsoids, and customers in patterned clothes."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from stereo_sfm.drivers.sim.render import NO_OBJECTS, Moving
from stereo_sfm.drivers.sim.tables import Tables
from stereo_sfm.drivers.sim.world import CLOTHES, HAIR, SKIN
from stereo_sfm.types import F64

Part = tuple[F64, F64, float, int]  # an ellipsoid: centre (3,), half sizes (3,), lean (radians about y), cloth


@dataclass(frozen=True, eq=False)
class Thing:
    """Ellipsoids that move together."""

    parts: list[Part]  # in axes of their own
    turn: F64  # (3, 3) from these axes to the world's
    at: F64  # (3,) metres, where their origin is


@dataclass(frozen=True)
class Appearance:
    """Size and clothes of a person."""

    height: float
    shirt: int  # index of a cloth
    trousers: int
    hair: int  # and shoes

    @staticmethod
    def random(rng: np.random.Generator) -> Appearance:
        """Two different cloths, one of two hair colours, the height of an adult."""
        shirt, trousers = rng.choice(CLOTHES, 2, replace=False)
        return Appearance(float(rng.uniform(1.55, 1.9)), int(shirt), int(trousers), HAIR + int(rng.integers(2)))


@dataclass(frozen=True)
class Person:
    """Walks between two points on the floor, there and back."""

    start: tuple[float, float]
    end: tuple[float, float]
    speed: float
    phase: float  # metres along the lap at time 0
    appearance: Appearance


def _pose(person: Person, seconds: float) -> tuple[F64, float, float]:
    """Position (2,), heading, phase of the step."""
    a, b = np.array(person.start), np.array(person.end)
    span = float(np.linalg.norm(b - a))
    distance = person.phase + person.speed * seconds
    lap = distance % (2 * span)
    forward = lap < span
    s = lap / span if forward else 2 - lap / span
    direction = (b - a) if forward else (a - b)
    return a + s * (b - a), float(np.arctan2(direction[1], direction[0])), distance / 0.75 * np.pi


def _limbs(person: Appearance, step: float) -> list[Part]:
    """Ellipsoids in the person's axes (x ahead, z up), legs and arms swinging with the phase of the step."""
    h, swing = person.height, 0.45 * np.sin(step)
    skin = SKIN
    out: list[Part] = [
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


def standing(appearance: Appearance, at: F64, heading: float, step: float) -> Thing:
    """A person at a place on the floor (2,), facing `heading` (radians), in the middle of a step."""
    c, s = np.cos(heading), np.sin(heading)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    return Thing(_limbs(appearance, step), turn, np.array([at[0], at[1], 0]))


def crowd_at(people: Iterable[Person], seconds: float) -> list[Thing]:
    """All people at a time in seconds."""
    return [standing(person.appearance, *_pose(person, seconds)) for person in people]


def moving(world: Tables, things: list[Thing]) -> Moving:
    """Things in the renderer's arrays."""
    if not things:
        return NO_OBJECTS
    boxes: list[F64] = []
    ranges: list[list[int]] = []
    rows: list[F64] = []
    cloths: list[int] = []
    for thing in things:
        lo, hi, first = np.full(3, np.inf), np.full(3, -np.inf), len(rows)
        for centre, half, lean, cloth in thing.parts:
            cl, sl = np.cos(lean), np.sin(lean)
            axes = thing.turn @ np.array([[cl, 0, sl], [0, 1.0, 0], [-sl, 0, cl]])
            middle = thing.turn @ centre + thing.at
            extent = np.sqrt(((axes * half) ** 2).sum(1))
            lo, hi = np.minimum(lo, middle - extent), np.maximum(hi, middle + extent)
            rows.append(np.concatenate([middle, (axes / half).T.ravel(), [0.5 * (half[0] + half[1]), half[2]]]))
            cloths.append(int(world.surfaces[4 + cloth]))
        boxes.append(np.concatenate([lo, hi]))
        ranges.append([first, len(rows)])
    return NO_OBJECTS._replace(
        persons=np.array(boxes),
        persons_i=np.array(ranges, np.int64),
        ellipsoids=np.array(rows),
        ellipsoids_i=np.array(cloths, np.int64),
    )
