"""The volume: surfaces where they are, joined cubes, what contradicts vanishes, the same bits in any order of cubes."""

from __future__ import annotations

import numpy as np

from stereo_sfm.dense.depth import DepthImage
from stereo_sfm.dense.keyframe_depth import joined as joined_depth
from stereo_sfm.dense.surface import extract, joined
from stereo_sfm.dense.volume import Seen, contributes, cubes_of, fuse, touched
from stereo_sfm.geometry.cameras import Pinhole
from stereo_sfm.types import F64

CAMERA = Pinhole(160, 120, 100.0, 100.0, 79.5, 59.5)
VOXEL = 0.02


def wall(z: float, session: int = 0, place: F64 | None = None, sigma: float = 0.01) -> Seen:
    """A wall across the z axis as a camera sees it."""
    pose = np.eye(4)
    pose[:3, 3] = (0.65, 0.6, 0.0) if place is None else place
    rays = CAMERA.bearing_grid()
    ranges = ((z - pose[2, 3]) / rays[..., 2]).astype(np.float32)
    grey = np.full(ranges.shape, 77, np.uint8)
    return Seen(DepthImage(CAMERA, np.eye(3), ranges, np.full_like(ranges, sigma), grey), pose, session)


def mesh(images: list[Seen]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    cubes = cubes_of([touched(s, VOXEL) for s in images])
    kept = [[s for s in images if contributes(s.floor_T_cam[:3, 3], s.reach(VOXEL), c, VOXEL)] for c in cubes]
    return joined([extract(fuse(c, k, VOXEL)) for c, k in zip(cubes, kept, strict=True)])


def test_a_wall_is_one_closed_surface_at_its_place() -> None:
    vertices, grey, triangles = mesh([wall(1.01), wall(1.01, place=np.array([0.7, 0.6, 0.1]))])
    assert len(vertices) > 500
    assert np.abs(vertices[:, 2] * VOXEL - 1.01).max() < 0.003  # a camera at 2 px a voxel
    assert (grey == 77).all()
    edges = np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1)
    _, count = np.unique(edges, axis=0, return_counts=True)
    assert count.max() == 2
    assert (count == 2).mean() > 0.9, "cubes are not joined"
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    assert (np.cross(b - a, c - a)[:, 2] < 0).all(), "faces look at the camera"


def test_a_person_who_was_seen_twice_is_gone_when_others_see_through() -> None:
    person, free = [wall(1.0)] * 2, [wall(2.0)] * 6
    z = mesh([*person, *free])[0][:, 2] * VOXEL
    assert not ((z > 0.9) & (z < 1.1)).any()
    assert ((z > 1.9) & (z < 2.1)).any()


def test_three_later_sessions_take_away_what_they_contradict() -> None:
    shelf = [wall(1.0, session=0, sigma=0.001)] * 20  # far more weight than the later ones
    later = [wall(2.0, session=k) for k in (1, 1, 2, 2, 3, 3)]
    z = mesh([*shelf, *later])[0][:, 2] * VOXEL
    assert not ((z > 0.9) & (z < 1.1)).any()
    z = mesh([*shelf, *later[:4]])[0][:, 2] * VOXEL
    assert ((z > 0.9) & (z < 1.1)).any()


def test_the_same_bits_again() -> None:
    images = [wall(1.01), wall(1.02)]
    for a, b in zip(mesh(images), mesh(images), strict=True):
        np.testing.assert_array_equal(a, b)


def test_depths_join_by_their_variances_and_contradictions_are_left_out() -> None:
    def flat(r: float, sigma: float) -> DepthImage:
        shape = (CAMERA.height, CAMERA.width)
        full = [np.full(shape, value, np.float32) for value in (r, sigma)]
        return DepthImage(CAMERA, np.eye(3), full[0], full[1], np.zeros(shape, np.uint8))

    both = joined_depth([flat(2.0, 0.02), flat(2.03, 0.01)])
    assert 2.015 < np.nanmedian(both.ranges) < 2.03
    assert np.nanmedian(both.sigmas) < 0.01
    assert not np.isfinite(joined_depth([flat(2.0, 0.02), flat(2.5, 0.02)]).ranges).any()
    outvoted = joined_depth([flat(2.5, 0.02), flat(2.0, 0.02), flat(2.03, 0.01)])
    np.testing.assert_allclose(outvoted.ranges, both.ranges, rtol=1e-5)


def test_ranges_that_are_hardly_known_reach_nowhere() -> None:
    """A disparity near zero says kilometres; no cube may come of it."""
    far = wall(2000.0, sigma=500.0)
    assert touched(far, VOXEL) == set()
    assert far.reach(VOXEL) == 0
