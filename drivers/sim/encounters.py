"""Encounters of people with the robot: they approach, stop in front of it, cover its lenses, push a cart past it or
accompany it.

An encounter is a function of time: the positions of people and their things, given the robot's drive. Positions are
metres along the robot's route and aside (to its left), so that an encounter follows the aisle round a corner. All
random numbers are drawn when the encounter is planned.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from stereo_sfm.drivers.sim.drives import Drive
from stereo_sfm.drivers.sim.people import Appearance, Part, Thing, standing
from stereo_sfm.drivers.sim.world import CLOTHES, SKIN
from stereo_sfm.errors import one_of
from stereo_sfm.types import F64

FIRST_S, PAUSE_S = 4.0, 3.0  # before the first encounter, and between the end of one and the beginning of the next
STRIDE = 0.75  # metres of a step
LEFT_LENS, RIGHT_LENS = 0.0, 0.064  # metres right of the camera's origin

Things = Callable[[float], list[Thing]]  # seconds -> things present


@dataclass(frozen=True, eq=False)
class Encounter:
    """One encounter and its interval of time."""

    kind: str
    begin: float  # seconds
    end: float
    things: Things

    def at(self, seconds: float) -> list[Thing]:
        """The people and things at a time; empty outside the interval."""
        return self.things(seconds) if self.begin <= seconds <= self.end else []


def plan(words: str, drive: Drive, rng: np.random.Generator) -> list[Encounter]:
    """Encounters of the named kinds (separated by commas; `all`: every kind), in turn until the drive ends.

    Raises:
        StereoSfmError: an unknown kind.
    """
    kinds = list(KINDS) if words == "all" else [word for word in words.split(",") if word]
    for kind in kinds:
        one_of(kind, (*KINDS, "all"), "encounter")
    out: list[Encounter] = []
    begin = FIRST_S
    while kinds:
        kind = kinds[len(out) % len(kinds)]
        encounter = KINDS[kind](drive, begin, np.random.default_rng(rng.integers(2**32)))
        if encounter.end > drive.duration:
            break
        out.append(encounter)
        begin = encounter.end + PAUSE_S
    return out


def present(encounters: Sequence[Encounter], seconds: float) -> list[Thing]:
    """The people and things of all encounters at a time."""
    return [thing for encounter in encounters for thing in encounter.at(seconds)]


def _smooth(x: float) -> float:
    """0 below 0, 1 above 1, a cubic between."""
    x = min(max(x, 0.0), 1.0)
    return x * x * (3 - 2 * x)


def _person(drive: Drive, appearance: Appearance, metres: float, aside: float, towards: bool) -> Thing:
    """A person on the robot's route who walks in its direction, or towards it."""
    at, heading = drive.place(metres, aside)
    return standing(appearance, at, heading + (np.pi if towards else 0.0), metres / STRIDE * np.pi)


def _approach(drive: Drive, begin: float, rng: np.random.Generator) -> Encounter:
    """Walks up to the robot, waits at 0.24 to 0.6 m for up to a second, then passes it."""
    appearance, speed = Appearance.random(rng), float(rng.uniform(0.8, 1.3))
    middle, side = float(rng.uniform(-0.12, 0.12)), float(rng.choice([-1, 1])) * float(rng.uniform(0.36, 0.45))
    gap, hesitation = float(rng.uniform(0.24, 0.6)), float(rng.uniform(0.0, 1.0))
    met = begin + 3.0
    aside, passed = met + hesitation, met + hesitation + 0.5

    def things(seconds: float) -> list[Thing]:
        robot = drive.distance(seconds)
        metres = robot + gap
        if seconds < met:
            metres = drive.distance(met) + gap + speed * (met - seconds)
        elif seconds > passed:
            metres = drive.distance(passed) + gap - speed * (seconds - passed)
        return [_person(drive, appearance, metres, middle + (side - middle) * _smooth((seconds - aside) / 0.5), True)]

    return Encounter("approach", begin, passed + 1.5, things)


def _stop(drive: Drive, begin: float, rng: np.random.Generator) -> Encounter:
    """Blocks the robot's route and steps aside when the robot is near."""
    appearance, speed, side = Appearance.random(rng), float(rng.uniform(0.8, 1.3)), float(rng.choice([-1, 1]))
    middle, near = float(rng.uniform(-0.15, 0.15)), float(rng.uniform(0.5, 0.9))
    sway = rng.uniform(0, 2 * np.pi, 2)
    stopped = begin + 2.0
    at = drive.distance(stopped) + float(rng.uniform(2.2, 3.4))
    aside = drive.when(at - near)
    end = max(aside + 1.0, drive.when(at + 0.5))

    def things(seconds: float) -> list[Thing]:
        metres = at + speed * max(stopped - seconds, 0.0)
        moved = middle + (side * 0.6 - middle) * _smooth((seconds - aside) / 0.7)
        swayed = 0.02 * np.sin(2 * np.pi * 0.35 * seconds + sway)
        place, heading = drive.place(metres + float(swayed[0]), moved + float(swayed[1]))
        return [standing(appearance, place, heading + np.pi, (metres + moved) / STRIDE * np.pi)]

    return Encounter("stop", begin, end, things)


def _covering(drive: Drive, begin: float, rng: np.random.Generator, kind: str) -> Encounter:
    """Covers the lenses for 0.5 to 3 s: both with a bag, or one with a hand."""
    lasts, approach = float(rng.uniform(0.5, 3.0)), float(rng.uniform(0.15, 0.35))  # seconds
    corner = float(rng.uniform(0, 2 * np.pi))  # direction from which it comes
    lens_x, cloth = float(rng.choice([LEFT_LENS, RIGHT_LENS])), int(rng.integers(CLOTHES))
    phase, lens = rng.uniform(0, 2 * np.pi, 3), kind == "lens"
    parts = _hand() if lens else _bag(cloth, rng)
    held = np.array([lens_x if lens else 0.5 * (LEFT_LENS + RIGHT_LENS), 0.0, 0.026 if lens else 0.12])
    away = np.array([np.cos(corner), np.sin(corner), 0.12]) * (0.5 if lens else 1.2)
    opened = begin + approach + lasts
    end = opened + approach

    def things(seconds: float) -> list[Thing]:
        off = 1.0 - _smooth((seconds - begin) / approach) + _smooth((seconds - opened) / approach)
        tremble = 0.004 * np.sin(2 * np.pi * np.array([1.1, 1.7, 0.8]) * seconds + phase)
        world_T_cam = drive.steady(np.array([seconds]))[0]
        return [Thing(parts, world_T_cam[:3, :3] @ _roll(corner), _moved(world_T_cam, held + off * away + tremble))]

    return Encounter(kind, begin, end, things)


def _moved(world_T_cam: F64, point: F64) -> F64:
    return world_T_cam[:3, :3] @ point + world_T_cam[:3, 3]


def _roll(angle: float) -> F64:
    """(3, 3) from axes whose x points to the edge of the image at `angle` into the camera's."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])


def _bag(cloth: int, rng: np.random.Generator) -> list[Part]:
    """A shopping bag with a hand and an arm in front of the camera (camera axes)."""
    return [
        (np.zeros(3), np.array([0.48, float(rng.uniform(0.42, 0.48)), 0.1]), 0.0, cloth),
        (np.array([0.42, 0.0, -0.02]), np.array([0.09, 0.05, 0.04]), 0.0, SKIN),
        (np.array([0.72, 0.0, 0.0]), np.array([0.3, 0.05, 0.05]), 0.0, (cloth + 3) % CLOTHES),
    ]


def _hand() -> list[Part]:
    """Palm, fingers and forearm in front of one lens (camera axes, the arm along x)."""
    fingers: list[Part] = [
        (np.array([-0.07, 0.021 * k, 0.002 * abs(k)]), np.array([0.055, 0.0125, 0.012]), 0.0, SKIN)
        for k in (-1.5, -0.5, 0.5, 1.5)
    ]
    return [
        (np.zeros(3), np.array([0.075, 0.055, 0.018]), 0.0, SKIN),
        *fingers,
        (np.array([0.25, 0.0, 0.01]), np.array([0.22, 0.045, 0.045]), 0.0, 1),
    ]


def _cart(drive: Drive, begin: float, rng: np.random.Generator) -> Encounter:
    """A person with a full cart who passes close to the robot, towards it or overtaking it."""
    appearance, towards = Appearance.random(rng), bool(rng.random() < 0.5)
    aside = float(rng.choice([-1, 1])) * float(rng.uniform(0.55, 0.68))
    speed = -float(rng.uniform(0.6, 1.0)) if towards else float(rng.uniform(1.3, 1.7))
    parts = _cart_parts(rng)
    met = begin + 3.0
    end = met + (2.0 if towards else 5.0)

    def things(seconds: float) -> list[Thing]:
        metres = drive.distance(met) + speed * (seconds - met)
        person = _person(drive, appearance, metres, aside, towards)
        cart_at, heading = drive.place(metres + (-0.75 if towards else 0.75), aside)
        heading += np.pi if towards else 0.0
        c, s = np.cos(heading), np.sin(heading)
        turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
        return [person, Thing(parts, turn, np.array([cart_at[0], cart_at[1], 0.0]))]

    return Encounter("cart", begin, end, things)


def _cart_parts(rng: np.random.Generator) -> list[Part]:
    """A shopping cart: rods around a basket, a handle and goods (x ahead)."""
    rods: list[Part] = [
        (np.array([0.0, y, z]), np.array([0.46, 0.012, 0.012]), 0.0, CLOTHES + 1)
        for y in (-0.25, 0.25)
        for z in (0.45, 0.6, 0.75, 0.9)
    ]
    rods += [
        (np.array([x, 0.0, z]), np.array([0.012, 0.27, 0.012]), 0.0, CLOTHES + 1)
        for x in (-0.42, 0.42)
        for z in (0.45, 0.6, 0.75, 0.9)
    ]
    rods += [
        (np.array([x, y, 0.5]), np.array([0.012, 0.012, 0.46]), 0.0, CLOTHES + 1)
        for x in (-0.42, -0.14, 0.14, 0.42)
        for y in (-0.25, 0.25)
    ]
    rods.append((np.array([-0.5, 0.0, 1.0]), np.array([0.02, 0.28, 0.02]), 0.0, CLOTHES))
    goods: list[Part] = [
        (
            np.array([rng.uniform(-0.3, 0.3), rng.uniform(-0.14, 0.14), rng.uniform(0.5, 0.95)]),
            rng.uniform(0.06, 0.16, 3),
            0.0,
            int(rng.integers(CLOTHES)),
        )
        for _ in range(9)
    ]
    return rods + goods


def _accompany(drive: Drive, begin: float, rng: np.random.Generator) -> Encounter:
    """Walks ahead and to one side, at the robot's speed, for 20 s."""
    appearance, side = Appearance.random(rng), float(rng.choice([-1, 1]))
    ahead, aside = float(rng.uniform(0.8, 1.6)), float(rng.uniform(0.3, 0.55))
    phase = rng.uniform(0, 2 * np.pi, 2)
    end = begin + 20.0

    def things(seconds: float) -> list[Thing]:
        away = 2.5 * (1.0 - _smooth((seconds - begin) / 2.5) + _smooth((seconds - end + 2.0) / 2.0))
        metres = drive.distance(seconds) + ahead + away + 0.12 * np.sin(2 * np.pi * 0.11 * seconds + phase[0])
        return [_person(drive, appearance, metres, side * aside + 0.06 * np.sin(0.8 * seconds + phase[1]), False)]

    return Encounter("beside", begin, end, things)


def _group(drive: Drive, begin: float, rng: np.random.Generator) -> Encounter:
    """Three to five people on one half of the aisle: the robot catches up, follows for 2 to 5 s, then they walk off."""
    side, count = float(rng.choice([-1, 1])), int(rng.integers(3, 6))
    people = [Appearance.random(rng) for _ in range(count)]
    aside = side * np.linspace(-0.2, 0.7, count) + rng.uniform(-0.05, 0.05, count)
    ahead, sway = float(rng.uniform(0.35, 0.5)) + rng.uniform(0.0, 0.25, count), rng.uniform(0, 2 * np.pi, count)
    follows = float(rng.uniform(2.0, 5.0))
    near, leaving = begin + 3.0, begin + 3.0 + follows
    end = leaving + 3.0

    def things(seconds: float) -> list[Thing]:
        away = 3.0 * (
            1.0 - _smooth((seconds - begin) / (near - begin)) + _smooth((seconds - leaving) / (end - leaving))
        )
        robot = drive.distance(seconds)
        return [
            _person(
                drive,
                appearance,
                robot + ahead[k] + away + 0.08 * np.sin(1.3 * seconds + sway[k]),
                float(aside[k]),
                False,
            )
            for k, appearance in enumerate(people)
        ]

    return Encounter("group", begin, end, things)


KINDS: dict[str, Callable[[Drive, float, np.random.Generator], Encounter]] = {
    "approach": _approach,
    "stop": _stop,
    "cover": lambda drive, begin, rng: _covering(drive, begin, rng, "cover"),
    "lens": lambda drive, begin, rng: _covering(drive, begin, rng, "lens"),
    "cart": _cart,
    "beside": _accompany,
    "group": _group,
}
