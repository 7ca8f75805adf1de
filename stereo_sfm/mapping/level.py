"""Gravity in bundle adjustment and pose graph: it holds roll and pitch of the keyframes that measured it.

Gravity points in one direction d of the map, which is not known beforehand: the mean of what all keyframes of a submap
measured. A keyframe with rotation R that measured m in its camera has the error R^T d - m. Where the mean follows the
keyframes, a rotation of all of them costs nothing: gravity adds no constraint to the map's own frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereo_sfm.mapping.map import Map
from stereo_sfm.types import F64, I64, Bool

HUBER = 2.0  # sigmas where the loss becomes linear: of one of twenty right ones


@dataclass(frozen=True, eq=False)
class Level:
    """What the keyframes of a bundle measured of gravity."""

    seen: F64  # (K, 3) unit vectors in their cameras; zero where nothing was measured
    weight: F64  # (K,) 1/rad^2, zero where nothing was measured
    group: I64  # (K,) of the keyframes with one mean
    rest: F64  # (G, 3) weighted sum of each group over the keyframes that do not move, in the map

    def evaluate(self, rot: F64, moving: I64) -> tuple[F64, F64, float]:
        """At rotations (K, 3, 3), of the rows that move (F,): the expected directions (F, 3) in their cameras, the
        weights (F,) with the loss, and the robust cost."""
        seen, weight, group = self.seen[moving], self.weight[moving], self.group[moving]
        total = self.rest.copy()
        np.add.at(total, group, weight[:, None] * np.einsum("nij,nj->ni", rot[moving], seen))
        down = total / np.maximum(np.linalg.norm(total, axis=1), 1e-300)[:, None]
        expected = np.einsum("nji,nj->ni", rot[moving], down[group])
        off = np.sqrt(weight * ((expected - seen) ** 2).sum(axis=1))
        over = off > HUBER
        cost = np.where(over, HUBER * (off - 0.5 * HUBER), 0.5 * off * off)
        return expected, np.where(over, weight * HUBER / np.maximum(off, HUBER), weight), float(cost.sum())

    def add(self, expected: F64, weight: F64, seen: F64, h: F64, b: F64) -> None:
        """Adds the quadratic models of `evaluate` to h (F, 6, 6) and b (F, 6) of the moving keyframes.

        With R exp(phi) the expected direction q changes by q x phi: J = skew(q), J^T J = 1 - q q^T.
        """
        h[:, 3:, 3:] += weight[:, None, None] * (np.eye(3) - expected[:, :, None] * expected[:, None, :])
        b[:, 3:] += weight[:, None] * np.cross(seen, expected)


def level_of(map_: Map, rows: I64, fixed: Bool) -> Level | None:
    """The level of a bundle of keyframes (rows of the map) of which some are fixed; None where none knows gravity."""
    table = map_.keyframes
    if not (table.down_sigma[rows[~fixed]] > 0).any():
        return None
    weight = weights(table.down_sigma)
    submaps, group = np.unique(table.submap_id, return_inverse=True)
    others = table.alive & (weight > 0)
    others[rows[~fixed]] = False
    still = np.flatnonzero(others)
    rest = np.zeros((len(submaps), 3))
    in_map = np.einsum("nij,nj->ni", table.map_T_kf[still, :3, :3], table.down[still])
    np.add.at(rest, group[still], weight[still, None] * in_map)
    return Level(table.down[rows].copy(), weight[rows], group[rows], rest)


def weights(sigma: F64) -> F64:
    """(K,) 1/rad^2 of standard deviations (K,), of which 0 means: not measured."""
    return np.where(sigma > 0, 1.0 / np.square(np.where(sigma > 0, sigma, 1.0)), 0.0)


def mean_down(map_T_kf: F64, down: F64, sigma: F64) -> F64:
    """(3,) direction of gravity in the map: a unit vector, or zero where no keyframe measured it.

    Args:
        map_T_kf: (K, 4, 4). down, sigma: (K, 3) and (K,), see `Keyframe.down`.
    """
    total = (weights(sigma)[:, None] * np.einsum("nij,nj->ni", map_T_kf[:, :3, :3], down)).sum(axis=0)
    size = float(np.linalg.norm(total))
    return total / size if size > 0 else total
