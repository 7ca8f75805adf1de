"""The volume: surfaces where they are, joined cubes, what contradicts vanishes, the same bits in any order of cubes."""

from __future__ import annotations

import tracemalloc
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from weakref import ref

import numpy as np
import pytest

from stereo_sfm.arrays import write_arrays
from stereo_sfm.dense import files
from stereo_sfm.dense.build import Volume
from stereo_sfm.dense.depth import DepthImage
from stereo_sfm.dense.files import joined, read_mesh, write_cloud_ply, write_glb, write_las, write_mesh_ply
from stereo_sfm.dense.keyframe_depth import joined as joined_depth
from stereo_sfm.dense.surface import Numbering, extract
from stereo_sfm.dense.volume import SIDE, Cube, Seen, contributes, fuse, touched
from stereo_sfm.geometry.cameras import Camera, Epipolar, Pinhole
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
    """Vertices in voxels, grey levels and triangles of all cubes."""
    places, reach = np.stack([s.floor_T_cam[:3, 3] for s in images]), np.array([s.reach(VOXEL) for s in images])
    numbering, parts = Numbering(), list[tuple[Any, ...]]()
    for cube in sorted(set[Any]().union(*(touched(s, VOXEL) for s in images))):
        seen_by = np.flatnonzero(contributes(places, reach, cube, VOXEL))
        surface = extract(fuse(cube, [images[i] for i in seen_by], VOXEL))
        if len(surface.quads):
            new, numbers = numbering.add(surface)
            parts.append((surface.vertices[new], surface.grey[new], numbers[surface.triangles()]))
    vertices, grey, triangles = (np.concatenate(column) for column in zip(*parts, strict=True))
    return vertices, grey, triangles


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


@pytest.mark.parametrize("cubes", [4, 40])
def test_memory_does_not_depend_on_the_number_of_cubes(
    cubes: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A floor across a row of cubes is one mesh, with a cube and a chunk in memory at a time."""
    monkeypatch.setattr(files, "CHUNK", 1000)
    place, n = tmp_path / "cubes", SIDE + 2
    place.mkdir()
    distance = np.broadcast_to(np.arange(n, dtype=np.float32) - 30.4, (n, n, n)).copy()
    seen, grey = np.full((n, n, n), 2, np.float32), np.full((n, n, n), 77, np.float32)
    volume = Volume(place, [(k, 0, 0) for k in range(cubes)], VOXEL, np.eye(4), np.eye(4))
    for index in volume.indices:
        columns = vars(extract(Cube(index, distance, seen, seen, grey)))
        write_arrays(place / f"{index[0]}_0_0.npz", columns)
    tracemalloc.start()
    with joined(volume, tmp_path) as mesh:
        for write in (write_mesh_ply, write_glb, write_cloud_ply, write_las):
            write(tmp_path / write.__name__, mesh)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    points, _, triangles = read_mesh(tmp_path / "write_mesh_ply")
    assert len(np.unique(points, axis=0)) == len(points) == (cubes * SIDE + 1) * (SIDE + 1), "borders are shared"
    assert len(triangles) == 2 * cubes * SIDE**2
    assert peak < 3 << 20, "the whole floor of 40 cubes has 15 MB"


def test_a_person_who_was_seen_twice_is_gone_when_others_see_through() -> None:
    person, free = [wall(1.0)] * 2, [wall(2.0)] * 6
    z = mesh([*person, *free])[0][:, 2] * VOXEL
    assert not ((z > 0.9) & (z < 1.1)).any()
    assert ((z > 1.9) & (z < 2.1)).any()


def test_three_later_sessions_take_away_what_they_contradict() -> None:
    shelf = [wall(1.0, session=0, sigma=0.001)] * 20  # far more weight than the later ones
    later = [wall(2.0, session=k) for k in (3, 3, 2, 2, 1, 1)]
    z = mesh([*later, *shelf])[0][:, 2] * VOXEL
    assert not ((z > 0.9) & (z < 1.1)).any()
    z = mesh([*later[2:], *shelf])[0][:, 2] * VOXEL
    assert ((z > 0.9) & (z < 1.1)).any()


@pytest.mark.parametrize("camera", [CAMERA, Epipolar(300, 300, 100.0, 100.0, 149.5, 149.5)])
def test_a_voxel_gets_the_distance_of_the_pixel_that_sees_it(camera: Camera) -> None:
    ranges = np.tile(1.2 + 1e-3 * np.arange(camera.width, dtype=np.float32), (camera.height, 1))
    image = DepthImage(camera, np.eye(3), ranges, np.full_like(ranges, 0.01), np.zeros(ranges.shape, np.uint8))
    pose = np.eye(4)
    pose[:3, 3] = 0.6, 0.6, -0.2
    cube = fuse((0, 0, 0), [Seen(image, pose, 0)], VOXEL)
    n = np.arange(-1.0, 65.0) * VOXEL
    points = np.stack(np.meshgrid(n, n, n, indexing="ij"), -1) - pose[:3, 3]
    uv = camera.project(points)
    sure = camera.inside(uv, 0.2) & (cube.views == 1)
    seen = ranges[0, np.rint(uv[sure][:, 0]).astype(int)] - np.linalg.norm(points[sure], axis=1)
    off = np.abs(cube.distance[sure] - np.minimum(seen, 0.08))
    assert len(off) > 30000
    assert off.max() < 1.1e-3  # the next pixel, where a tenth of one decides
    assert (off > 1e-5).mean() < 0.03


def test_a_place_seen_again_and_again_needs_no_more_memory() -> None:
    alive: list[int] = []
    made: list[ref[Seen]] = []

    def images() -> Iterator[Seen]:
        for k in range(8):
            made.append(ref(one := wall(1.0, session=-(k // 4))))
            yield one
            del one
            alive.append(sum(r() is not None for r in made))

    fuse((0, 0, 0), images(), VOXEL)
    assert len(alive) == 8
    assert max(alive) <= 2


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
