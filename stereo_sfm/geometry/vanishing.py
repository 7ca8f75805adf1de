"""Three orthogonal vanishing points of a Manhattan world: two-line exhaustive search on a polar grid, then refinement.

Lu, Yao, Li, Liu, Zhang (WACV 2017), as in the retail paper's section III-A2 and equations 6-10. Their image plane is
replaced by the sphere of bearings, on which the same grid lives, so the camera need not be a pinhole. Directions are
axes: v and -v are one vanishing point, kept on the hemisphere z >= 0.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from stereo_sfm.geometry import se3
from stereo_sfm.geometry.lines import LineSegments
from stereo_sfm.geometry.robust import Degenerate
from stereo_sfm.types import F64, I64, Bool, Message

_LATITUDES, _LONGITUDES = 90, 360  # one degree cells: phi in [0, 90), lambda in [0, 360)
_PAIR_SAMPLES = 150  # two-line samples for the first vanishing point
_VOTERS = 250  # longest segments that vote on the grid (all of them refine)
_SPLITS = 90  # positions of the second on the great circle of the first; the other 270 repeat these


@dataclass(frozen=True)
class ManhattanLimits:
    """Acceptance thresholds."""

    min_lines: int = 20  # segments in total
    min_lines_per_axis: int = 4  # segments of each of at least two axes
    min_share: float = 0.35  # of the total angular length, in segments of the three axes
    max_sigma_deg: float = 0.25  # standard deviation of the rotation about its worst axis
    tolerance_deg: float = 1.0  # between a segment's plane and its axis, in the last round


@dataclass(frozen=True, eq=False)
class Manhattan(Message):
    """Orientation of the camera relative to the three Manhattan directions."""

    cam_R_axes: F64  # (3, 3) columns are the axes in the camera; up to the 24 rotations of a cube
    covariance: F64  # (3, 3) rad^2 of a rotation vector w with exp(w) @ cam_R_axes
    share: float  # inlier fraction of the total angular length
    lines_per_axis: I64  # (3,)
    labels: I64  # (L,) axis of each segment, -1 for none

    @property
    def sigma(self) -> float:
        """Radians, standard deviation about the worst axis."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance)[-1]))


def polar_grid(lines: LineSegments) -> F64:
    """(90, 360) response: every pair of segments votes for the intersection of their planes.

    The vote is length times length times sin(2 angle between the planes), as the paper's, smoothed by 3 x 3 cells.
    """
    voters = np.argsort(-lines.angles, kind="stable")[:_VOTERS]
    i, j = (voters[k] for k in np.triu_indices(len(voters), 1))
    meet = np.cross(lines.normals[i], lines.normals[j])
    sine = np.linalg.norm(meet, axis=1)
    good = sine > 1e-4
    meet, sine, i, j = meet[good] / sine[good, None], sine[good], i[good], j[good]
    cosine = np.abs((lines.normals[i] * lines.normals[j]).sum(1))
    vote = lines.angles[i] * lines.angles[j] * 2 * sine * cosine
    phi, lam = _cells(meet)
    grid = np.bincount(phi * _LONGITUDES + lam, vote, minlength=_LATITUDES * _LONGITUDES)
    grid = grid.reshape(_LATITUDES, _LONGITUDES)
    around = grid + np.roll(grid, 1, 1) + np.roll(grid, -1, 1)
    padded = np.pad(around, ((1, 1), (0, 0)))
    padded[0] = np.roll(around[0], _LONGITUDES // 2)  # across the pole
    padded[-1] = np.roll(around[-1], _LONGITUDES // 2)  # across the equator, where v and -v are one
    return np.asarray(padded[:-2] + padded[1:-1] + padded[2:], np.float64)


def _cells(directions: F64) -> tuple[I64, I64]:
    """Axes (..., 3) -> latitude and longitude cells (equation 7), v and -v in one."""
    d = np.where(directions[..., 2:] < 0, -directions, directions)
    phi = np.degrees(np.arccos(d[..., 2].clip(0.0, 1.0)))
    lam = np.degrees(np.arctan2(d[..., 0], d[..., 1])) + 180.0
    rows = phi.astype(np.int64).clip(0, _LATITUDES - 1)
    return rows, lam.astype(np.int64) % _LONGITUDES


def _hypotheses(lines: LineSegments, rng: np.random.Generator) -> F64:
    """(H, 3, 3) candidate axes as columns: v1 from two segments, v2 along its great circle, v3 = v1 x v2."""
    chance = lines.angles / lines.angles.sum()
    i = rng.choice(len(lines), _PAIR_SAMPLES, p=chance)
    j = rng.choice(len(lines), _PAIR_SAMPLES, p=chance)
    v1 = np.cross(lines.normals[i], lines.normals[j])
    norm = np.linalg.norm(v1, axis=1)
    v1 = v1[norm > 0.02] / norm[norm > 0.02, None]
    helper = np.where(np.abs(v1[:, :1]) < 0.7, np.array([1.0, 0, 0]), np.array([0, 1.0, 0]))
    a = np.cross(v1, helper)
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    b = np.cross(v1, a)
    angle = np.radians(np.arange(_SPLITS))
    v2 = np.cos(angle)[None, :, None] * a[:, None] + np.sin(angle)[None, :, None] * b[:, None]
    v1 = np.broadcast_to(v1[:, None], v2.shape)
    return np.stack([v1, v2, np.cross(v1, v2)], axis=-1).reshape(-1, 3, 3)


def search(lines: LineSegments, rng: np.random.Generator) -> F64:
    """(3, 3) axes with the largest response on the grid, to about a degree.

    Raises:
        Degenerate: "no_lines" where no two segments meet.
    """
    candidates = _hypotheses(lines, rng) if len(lines) >= 2 else np.zeros((0, 3, 3))
    if len(candidates) == 0:
        raise Degenerate("no_lines", "no two segments meet in a point")
    grid = polar_grid(lines)
    phi, lam = _cells(np.swapaxes(candidates, 1, 2))
    return candidates[int(np.argmax(grid[phi, lam].sum(axis=1)))]


def refine(lines: LineSegments, cam_R_axes: F64, limits: ManhattanLimits) -> Manhattan:
    """Gauss-Newton on the angles between each segment's plane and its nearest axis, in narrowing rounds.

    Raises:
        Degenerate: "weak_structure" when the segments do not determine all three angles or too few agree.
    """
    rotation = cam_R_axes
    final = np.radians(limits.tolerance_deg)
    labels, hessian = np.full(len(lines), -1), np.zeros((3, 3))
    spread = final
    for tolerance in (6 * final, 4 * final, 2 * final, final, final, final):
        offset = lines.normals @ rotation  # (L, 3) sine of the angle between plane and axis
        axis = np.argmin(np.abs(offset), axis=1)
        error = np.take_along_axis(offset, axis[:, None], 1)[:, 0]
        # A segment whose plane contains two axes (seen along an axis) is ambiguous.
        second = np.sort(np.abs(offset), axis=1)[:, 1]
        chosen = (np.abs(error) < np.sin(tolerance)) & (second > 2 * np.sin(tolerance))
        labels = np.where(chosen, axis, -1)
        directions = rotation.T[axis]
        jac = np.cross(directions, lines.normals)  # d(n . exp(w) d) / dw
        # Long segments determine their plane better; Tukey's weight suppresses outliers.
        weight = np.where(chosen, lines.angles**2 * (1 - (error / np.sin(tolerance)) ** 2) ** 2, 0.0)
        hessian = jac.T @ (weight[:, None] * jac)
        if np.linalg.eigvalsh(hessian)[0] <= 1e-6 * max(float(weight.sum()), 1e-12):
            raise Degenerate("weak_structure", "the segments do not determine the orientation")
        step = np.asarray(-np.linalg.solve(hessian, jac.T @ (weight * error)), np.float64)
        rotation = se3.so3_exp(step) @ rotation
        spread = float(np.sqrt((weight * error**2).sum() / weight.sum()))
    weight = np.where(labels >= 0, lines.angles**2, 0.0)
    count = max(float(weight.sum() ** 2 / np.maximum((weight**2).sum(), 1e-12)), 1.0)  # effective number of segments
    covariance = np.linalg.inv(hessian / np.maximum(weight.sum(), 1e-12)) * spread**2 / count
    share = float(lines.angles[labels >= 0].sum() / lines.angles.sum())
    per_axis = np.bincount(labels[labels >= 0], minlength=3).astype(np.int64)
    found = Manhattan(rotation, np.asarray(covariance, np.float64), share, per_axis, labels.astype(np.int64))
    _believe(found, limits)
    return found


def _believe(found: Manhattan, limits: ManhattanLimits) -> None:
    if np.sort(found.lines_per_axis)[1] < limits.min_lines_per_axis:
        raise Degenerate("weak_structure", f"segments per axis {found.lines_per_axis.tolist()}")
    if found.share < limits.min_share:
        raise Degenerate("weak_structure", f"{found.share:.0%} of the segments agree")
    if found.sigma > np.radians(limits.max_sigma_deg):
        raise Degenerate("weak_structure", f"orientation uncertain by {np.degrees(found.sigma):.2f} degrees")


def estimate(
    lines: LineSegments,
    rng: np.random.Generator,
    limits: ManhattanLimits | None = None,
    expected: F64 | None = None,
) -> Manhattan:
    """Camera orientation relative to the Manhattan directions.

    Args:
        expected: (3, 3) prediction from the last frame; an additional candidate, which also selects one of the 24
            equivalent rotations.

    Raises:
        Degenerate: "too_few_lines", "no_lines", "weak_structure".
    """
    limits = limits or ManhattanLimits()
    if len(lines) < limits.min_lines:
        raise Degenerate("too_few_lines", f"{len(lines)} segments")
    starts = [search(lines, rng)]
    if expected is not None:
        starts.append(expected)
    candidates: list[Manhattan] = []
    refusal = Degenerate("weak_structure")
    for start in starts:
        try:
            candidates.append(refine(lines, start, limits))
        except Degenerate as error:
            refusal = error
    if not candidates:
        raise refusal
    best = max(candidates, key=lambda m: m.share)
    turned = nearest_turn(best.cam_R_axes, np.eye(3) if expected is None else expected)
    return Manhattan(turned, best.covariance, best.share, best.lines_per_axis, best.labels)


def _cube_turns() -> F64:
    """(24, 3, 3) rotations that map the axes onto themselves."""
    out: list[F64] = []
    for permutation in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            turn = np.zeros((3, 3))
            turn[list(permutation), range(3)] = signs
            if np.linalg.det(turn) > 0:
                out.append(turn)
    return np.array(out)


_TURNS = _cube_turns()


def nearest_turn(cam_R_axes: F64, expected: F64) -> F64:
    """Of the 24 equivalent orientations (and the reflection that makes it a rotation) the one nearest to `expected`."""
    proper = cam_R_axes if np.linalg.det(cam_R_axes) > 0 else -cam_R_axes
    candidates = proper @ _TURNS
    return candidates[int(np.argmax(np.einsum("nij,ij->n", candidates, expected)))]


def agreeing(lines: LineSegments, cam_R_axes: F64, tolerance: float) -> Bool:
    """(L,) segments whose plane holds one of the axes within `tolerance` radians."""
    return np.abs(lines.normals @ cam_R_axes).min(axis=1) < np.sin(tolerance)
