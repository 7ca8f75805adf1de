"""Points of the map made from corners of side views, where a loop leads across directions of travel.

Tracked points look different from the other direction, so such a loop pairs none of them. What it matched are corners
(`Keyframe.sides`). As points that keyframes of both directions observe, they hold the two together in every adjustment,
like the fused points of other loops. Their descriptors are of the views, not of the image: the map does not keep them.
"""

from __future__ import annotations

import numpy as np

from stereo_sfm.geometry import se3
from stereo_sfm.mapping.map import Map
from stereo_sfm.types import I64

Sighting = tuple[int, int]  # keyframe row, row in its `sides`


def join_corners(map_: Map, sightings: I64, sigma_px: float) -> list[tuple[int, int]]:
    """Make points of the corners that a loop matched; one that an earlier loop made a point stays that point.

    Args:
        sightings: (S, 3) see `LoopResult`; those in keyframes that were culled are left out.
        sigma_px: noise of one coordinate.

    Returns:
        Point rows (removed, kept) of points that turned out to be one.
    """
    corners = _by_corner(map_, sightings)
    fused: list[tuple[int, int]] = []
    for corner in corners:
        known = _points(map_, corner)
        for other in known[1:]:
            if map_.points.alive[known[0]] and not map_.share_a_keyframe(other, known[0]):
                map_.fuse(other, known[0], sigma_px)
                fused.append((other, known[0]))
    wanted: dict[int, dict[int, int]] = {}  # keyframe row -> point row -> row in its `sides`
    for corner in corners:
        known = _points(map_, corner)
        point = known[0] if known else _new_point(map_, corner, sigma_px)
        for kf, row in corner:
            wanted.setdefault(kf, {}).setdefault(point, row)
    for kf in sorted(wanted):
        before = set(map_.observations.pt[map_.observations_of_keyframe(kf)].tolist())
        new = {point: row for point, row in wanted[kf].items() if point not in before}
        sides, rows = map_.corners[kf][1], np.array(list(new.values()), np.int64)
        uv_left, uv_right = (uv[rows].astype(np.float64) for uv in (sides.uv_left, sides.uv_right))
        nothing = np.zeros((len(rows), 32), np.uint8)
        map_.observe(kf, np.array(list(new), np.int64), uv_left, uv_right, nothing)
    return fused


def _by_corner(map_: Map, sightings: I64) -> list[list[Sighting]]:
    """What several living keyframes see, corner by corner."""
    corners: dict[int, list[Sighting]] = {}
    for number, kf_id, row in sightings.tolist():
        kf = map_.kf_row(kf_id)
        if map_.keyframes.alive[kf]:
            corners.setdefault(number, []).append((kf, row))
    return [sorted(corner) for corner in corners.values() if len({kf for kf, _ in corner}) > 1]


def _points(map_: Map, corner: list[Sighting]) -> list[int]:
    """Rows of the points that these keyframes observe at just these pixels, ascending."""
    found: set[int] = set()
    for kf, row in corner:
        obs = map_.observations_of_keyframe(kf)
        same = (map_.observations.uv_left[obs] == map_.corners[kf][1].uv_left[row]).all(axis=1)
        found.update(map_.observations.pt[obs[same]].tolist())
    return sorted(found)


def _new_point(map_: Map, corner: list[Sighting], sigma_px: float) -> int:
    """A point at the mean of the corner's positions by stereo."""
    poses = map_.keyframes.map_T_kf
    seen = [se3.transform(poses[kf], map_.corners[kf][1].points_cam[row].astype(np.float64)) for kf, row in corner]
    return map_.add_untracked(np.mean(seen, axis=0), corner[0][0], sigma_px)
