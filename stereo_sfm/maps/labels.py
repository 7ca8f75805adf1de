"""What people name on the floor plan of a store: aisles and doors, each by a line."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from stereo_sfm.types import F64


@dataclass(frozen=True)
class Label:
    """A named line, in metres of the floor plan."""

    name: str
    start: tuple[float, float]
    end: tuple[float, float]

    @property
    def length(self) -> float:
        """Metres."""
        return math.dist(self.start, self.end)


@dataclass(frozen=True)
class Aisle(Label):
    """A line along an aisle; left and right as one goes from its start to its end."""

    def place(self, xy: F64) -> tuple[F64, F64]:
        """Points (N, 2) -> metres along the aisle (N,) and to its left (N,)."""
        begin = np.array(self.start)
        along = np.array(self.end) - begin
        along /= np.linalg.norm(along)
        off = xy - begin
        return off @ along, off @ np.array([-along[1], along[0]])


@dataclass(frozen=True)
class Door(Label):
    """A line across a door."""

    @property
    def middle(self) -> F64:
        """(2,) metres."""
        return np.add(self.start, self.end) / 2
