"""COLMAP's dense workspace, read and fused by COLMAP itself."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from stereo_sfm.dense import colmap, keyframe_depth
from stereo_sfm.dense.keyframe_depth import KeyframeImages
from stereo_sfm.maps.merge import subset
from stereo_sfm.maps.saved_map import SavedMap
from tests.dense.test_depth import render
from tests.loop.store_sequence import make_sequence
from tests.maps.maps import map_of_sequence
from tests.synthetic import pinhole_rig

pycolmap = pytest.importorskip("pycolmap")

COUNT = 4  # keyframes
WALLS = [(0, -1.2), (0, 1.3), (2, 3.0)]  # map's axes: those of the first camera


def a_map() -> SavedMap:
    """The first keyframes of an aisle."""
    whole = map_of_sequence(make_sequence([0], seed=1, rig=pinhole_rig()))
    s = whole.snapshot
    keep = np.arange(len(s.kf_ids)) < COUNT
    obs = keep[s.obs_kf]
    points = np.bincount(s.obs_pt[obs], minlength=len(s.pt_ids)) > 0
    return SavedMap(subset(s, keep, points, obs), whole.cameras, whole.vocabulary_id, whole.sessions[keep])


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    saved, folder = a_map(), tmp_path_factory.mktemp("workspace")
    rig = saved.cameras[0].rig
    assert rig.right is not None

    def images(_: object) -> Iterator[KeyframeImages]:
        for k, pose in enumerate(saved.snapshot.map_T_kf):
            pair = [render(c, p, WALLS)[0] for c, p in ((rig.left, pose), (rig.right, pose @ rig.left_T_right))]
            yield KeyframeImages(k, rig, pose, *pair)

    given: Any = SimpleNamespace(saved=saved)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(colmap, "keyframes", images)
        patch.setattr(keyframe_depth, "shows_more", lambda *_: True)
        for module in (colmap, keyframe_depth):
            patch.setattr(module, "VIEW_PX", 320)  # quick
        assert colmap.export_colmap_dense(given, folder) == COUNT
    return folder


def test_depth_and_poses_as_pycolmap_reads_them_lie_on_the_walls(workspace: Path) -> None:
    model = pycolmap.Reconstruction(workspace / "sparse")
    assert len(model.images) == COUNT
    for image in model.images.values():
        camera = model.cameras[image.camera_id]
        depth = pycolmap.DepthMap()
        depth.read(workspace / "stereo" / "depth_maps" / f"{image.name}.geometric.bin")
        z = np.asarray(depth.to_array())
        assert z.shape == (camera.height, camera.width)
        v, u = np.nonzero(z)
        assert len(v) > 0.3 * z.size
        rays = camera.cam_from_img(np.stack([u + 0.5, v + 0.5], axis=1).astype(float))
        points = np.concatenate([rays, np.ones((len(rays), 1))], axis=1) * z[v, u, None]
        world = image.cam_from_world().inverse() * points
        off = np.min([np.abs(world[:, axis] - place) for axis, place in WALLS], axis=0)
        assert np.median(off) < 0.03


def test_its_fusion_makes_a_cloud(workspace: Path, tmp_path: Path) -> None:
    """Points that three views agree on."""
    options = pycolmap.StereoFusionOptions()
    options.min_num_pixels, options.num_threads = 3, 1
    fused = pycolmap.stereo_fusion(tmp_path, workspace, options=options)
    points = np.array([p.xyz for p in fused.points3D.values()])
    assert len(points) > 1000
    off = np.min([np.abs(points[:, axis] - place) for axis, place in WALLS], axis=0)
    assert np.median(off) < 0.03


def test_normals_face_the_camera_and_are_those_of_the_wall() -> None:
    v, u = np.mgrid[:9, :11]
    z = 2.0 + 0.1 * (u - 5)
    points = np.stack([(u - 5) * 0.1, (v - 4) * 0.1, z], axis=-1)
    normals = colmap.surface_normals(points)
    expected = np.array([1.0, 0.0, -1.0]) / np.sqrt(2)
    np.testing.assert_allclose(normals[1:-1, 1:-1], np.broadcast_to(expected, (7, 9, 3)), atol=1e-6)
    assert np.isnan(normals[0]).all()
    points[4, 5] = np.nan
    assert np.isnan(colmap.surface_normals(points)[4, 4:7]).all()


def test_a_map_file_is_columns_first_and_channels_last(tmp_path: Path) -> None:
    values = np.arange(2 * 3 * 2, dtype=np.float32).reshape(2, 3, 2)
    colmap.write_map(tmp_path / "m.bin", values)
    head, data = tmp_path.joinpath("m.bin").read_bytes().split(b"&", 3)[:3], tmp_path.joinpath("m.bin").read_bytes()
    assert head == [b"3", b"2", b"2"]
    np.testing.assert_array_equal(np.frombuffer(data[6:], "<f4"), [0, 2, 4, 6, 8, 10, 1, 3, 5, 7, 9, 11])
