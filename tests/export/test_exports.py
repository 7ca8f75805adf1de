"""Exports read back by the programs they are for: pycolmap, gtsam, and map_server's rules."""

from __future__ import annotations

import dataclasses
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from stereo_sfm.cli import main
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.export.colmap import export_colmap
from stereo_sfm.export.floor_plan import FREE, OCCUPIED, UNKNOWN, make_floor_plan
from stereo_sfm.export.g2o import export_g2o, graph_edges
from stereo_sfm.export.ply import export_ply
from stereo_sfm.export.trajectories import named_pose, write_tum
from stereo_sfm.geometry import se3
from stereo_sfm.maps.saved_map import SavedMap, joined, save_map, session_trajectory
from tests.loop.store_sequence import StoreSequence
from tests.maps.maps import small_map


@pytest.fixture(scope="module")
def sequence_and_map() -> tuple[StoreSequence, SavedMap]:
    return small_map()


@pytest.fixture(scope="module")
def saved(sequence_and_map: tuple[StoreSequence, SavedMap]) -> SavedMap:
    return sequence_and_map[1]


def test_colmap_reads_the_model_and_its_own_projection_meets_the_pixels(tmp_path: Path, saved: SavedMap) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    export_colmap(saved, tmp_path)
    model = pycolmap.Reconstruction(str(tmp_path))
    s = saved.snapshot
    assert model.num_images() == 2 * len(s.kf_ids)
    assert model.num_frames() == len(s.kf_ids)
    assert model.num_points3D() == len(s.pt_ids)
    image = model.images[2 * 4 + 2]  # the right camera of the fifth keyframe
    assert image.name == f"right/{int(s.frame_ids[4]):06d}.png"
    cam_T_map = np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]])
    expected = se3.inverse(s.map_T_kf[4] @ saved.rig.left_T_right)
    assert np.allclose(cam_T_map, expected, atol=1e-9)
    errors = []
    for point2d in image.points2D:
        xyz = model.points3D[point2d.point3D_id].xyz
        errors.append(np.linalg.norm(image.project_point(xyz) - point2d.xy))
    assert saved.rig.right is not None
    ours = saved.rig.right.project(se3.transform(expected, s.points[s.obs_pt[s.obs_kf == 4]]))
    seen = s.uv_right[s.obs_kf == 4]
    ok = np.isfinite(seen[:, 0])
    assert np.allclose(errors, np.linalg.norm(ours - seen, axis=1)[ok], atol=1e-4)  # the half pixel cancels: same error
    track = model.points3D[1].track.elements
    assert len(track) == (s.obs_pt == 0).sum() + np.isfinite(s.uv_right[s.obs_pt == 0, 0]).sum()


def test_a_point_that_is_seen_once_is_left_out(tmp_path: Path, saved: SavedMap) -> None:
    """COLMAP reads no map with one, and the pixel stays without a point."""
    pycolmap = pytest.importorskip("pycolmap")
    s = saved.snapshot
    uv_right = s.uv_right.copy()
    first = np.flatnonzero(s.obs_pt == 3)
    kept = np.setdiff1d(np.arange(len(s.obs_pt)), first[1:])
    uv_right[first[0]] = np.nan
    columns = {
        "obs_kf": s.obs_kf[kept],
        "obs_pt": s.obs_pt[kept],
        "uv_left": s.uv_left[kept],
        "uv_right": uv_right[kept],
    }
    once = dataclasses.replace(saved, snapshot=dataclasses.replace(s, **columns))
    export_colmap(once, tmp_path)
    model = pycolmap.Reconstruction(str(tmp_path))
    assert model.num_points3D() == len(s.pt_ids) - 1 and 4 not in model.points3D
    assert sum(not p.has_point3D() for image in model.images.values() for p in image.points2D) == 1


def test_classic_colmap_files_are_complete(tmp_path: Path, saved: SavedMap) -> None:
    """Readers without rigs and frames use the poses in images.txt."""
    export_colmap(saved, tmp_path)
    lines = [x for x in (tmp_path / "images.txt").read_text().splitlines() if not x.startswith("#")]
    assert len(lines) == 2 * 2 * len(saved)
    w, x, y, z, *t = map(float, lines[0].split()[1:8])
    cam_T_map = se3.from_rotation_translation(se3.rotation_from_quaternion(np.array([x, y, z, w])), np.array(t))
    assert np.allclose(cam_T_map, se3.inverse(saved.snapshot.map_T_kf[0]), atol=1e-12)


def test_g2o_is_read_by_gtsam(tmp_path: Path, saved: SavedMap) -> None:
    gtsam = pytest.importorskip("gtsam")
    path = tmp_path / "g.g2o"
    export_g2o(saved, path)
    graph, values = gtsam.readG2o(str(path), True)
    s = saved.snapshot
    assert values.size() == len(s.kf_ids)
    edges = graph_edges(s)
    assert graph.size() == len(edges)
    for k, kf_id in enumerate(s.kf_ids.tolist()):
        assert np.allclose(values.atPose3(kf_id).matrix(), s.map_T_kf[k], atol=1e-5)
    assert graph.error(values) < 1e-3
    assert np.allclose(graph.at(0).noiseModel().sigmas()[3:], edges.sigmas[0, 0], rtol=1e-3)


def test_ply_holds_the_points(tmp_path: Path, saved: SavedMap) -> None:
    path = tmp_path / "p.ply"
    export_ply(saved, path)
    raw = path.read_bytes()
    end = raw.index(b"end_header\n") + len(b"end_header\n")
    header = raw[:end].decode()
    assert f"element vertex {len(saved.snapshot.points)}" in header
    row = struct.Struct("<fffBBBff")
    assert len(raw) - end == row.size * len(saved.snapshot.points)
    x, y, z, *_, views, session = row.unpack_from(raw, end + 7 * row.size)
    assert np.allclose([x, y, z], saved.snapshot.points[7], rtol=1e-6)
    assert views == (saved.snapshot.obs_pt == 7).sum() and session == 0


def test_floor_plan_of_one_aisle(sequence_and_map: tuple[StoreSequence, SavedMap]) -> None:
    sequence, saved = sequence_and_map
    plan = make_floor_plan(saved.snapshot, 0.05)
    floor_T_map = se3.inverse(plan.map_T_floor)
    cameras = se3.transform(floor_T_map, saved.snapshot.map_T_kf[:, :3, 3])
    column = ((cameras[:, 0] - plan.origin[0]) / 0.05).astype(int)
    row = plan.image.shape[0] - 1 - ((cameras[:, 1] - plan.origin[1]) / 0.05).astype(int)
    inside = sequence.world_T_kf[:, 2, 3] > 1.0
    assert (plan.image[row[inside], column[inside]] == FREE).mean() > 0.9  # where the robot went is free
    assert set(np.unique(plan.image)) <= {FREE, OCCUPIED, UNKNOWN}
    # Shelf fronts stand 0.9 to 1.2 m left and right of the path, along it.
    rows, columns = np.nonzero(plan.image == OCCUPIED)
    xy = (
        np.stack([columns * 0.05 + plan.origin[0], (plan.image.shape[0] - 1 - rows) * 0.05 + plan.origin[1]], 1) + 0.025
    )
    along = cameras[inside][-1, :2] - cameras[inside][0, :2]
    along /= np.linalg.norm(along)
    aside = np.abs((xy - cameras[inside][0, :2]) @ np.array([-along[1], along[0]]))
    assert len(xy) > 50
    assert ((aside > 0.75) & (aside < 1.4)).mean() > 0.85
    assert min(abs(along[0]), abs(along[1])) < np.sin(np.deg2rad(2))  # the plan lies along the aisle


def test_export_command(tmp_path: Path, saved: SavedMap, capsys: pytest.CaptureFixture[str]) -> None:
    save_map(saved, tmp_path / "m")
    folder = str(tmp_path / "m")
    assert main(["export", folder, "--format", "floor-plan", "-o", str(tmp_path / "plan.png")]) == 0
    description = yaml.safe_load((tmp_path / "plan.yaml").read_text())
    picture = cv2.imread(str(tmp_path / description["image"]), cv2.IMREAD_GRAYSCALE)
    assert picture is not None and description["resolution"] == 0.05 and len(description["origin"]) == 3
    occupied = (255 - picture.astype(float)) / 255 > description["occupied_thresh"]
    free = (255 - picture.astype(float)) / 255 < description["free_thresh"]
    assert occupied.any() and free.any() and (~occupied & ~free).any()
    for kind in ("colmap", "ply", "g2o", "tum", "kitti", "euroc"):
        assert main(["map", "export", folder, "--format", kind]) == 0
    assert main(["export", folder, "--format", "ply"]) == 2
    assert "exists: choose another -o" in capsys.readouterr().err
    assert main(["export", str(tmp_path), "--format", "ply"]) == 2
    assert "holds no map" in capsys.readouterr().err
    assert len((tmp_path / "m" / "export_map.tum").read_text().splitlines()) == len(saved) + 1


@pytest.mark.parametrize(("kind", "ending"), [("tum", "tum"), ("kitti", "kitti"), ("euroc", "csv")])
def test_trajectories_of_a_merged_map_are_a_file_for_each_sequence(
    tmp_path: Path, saved: SavedMap, kind: str, ending: str, capsys: pytest.CaptureFixture[str]
) -> None:
    both = joined([saved, saved])
    save_map(both, tmp_path / "m")
    export = ["export", str(tmp_path / "m"), "--format", kind]
    assert main(export) == 0
    names = [f"export_map_walk{k}.{ending}" for k in (0, 1)]
    told = capsys.readouterr().out
    assert all(name in told for name in names)
    for name in names:
        lines = [x for x in (tmp_path / "m" / name).read_text().splitlines() if not x.startswith("#")]
        assert len(lines) == len(saved)
        if kind != "kitti":
            stamps = [float(line.replace(",", " ").split()[0]) for line in lines]
            assert (np.diff(stamps) > 0).all()
    assert main([*export, "--walk", "1", "-o", str(tmp_path / "one.txt")]) == 0
    assert (tmp_path / "one.txt").read_bytes() == (tmp_path / "m" / names[1]).read_bytes()
    assert main(export) == 2
    assert f"{names[0]} exists: choose another -o" in capsys.readouterr().err
    assert main([*export, "--session", "2", "-o", str(tmp_path / "two.txt")]) == 2
    assert "the map has no session 2 (it has 0, 1)" in capsys.readouterr().err


def test_two_keyframes_with_one_stamp_are_not_a_trajectory(saved: SavedMap) -> None:
    twice = dataclasses.replace(joined([saved, saved]), sessions=np.zeros(2 * len(saved), np.int64))
    with pytest.raises(StereoSfmError, match="session 0 of the map has two keyframes of the same stamp"):
        session_trajectory(twice, 0)


@pytest.mark.parametrize("what", ["world_T_body", "world_T_cam0"])
def test_exported_poses_of_a_run_keep_their_name(tmp_path: Path, saved: SavedMap, what: str) -> None:
    """`run --frame body` writes poses of the body: no export may call them the camera's."""
    trajectory = session_trajectory(saved, 0)
    write_tum(tmp_path / "trajectory_map.tum", trajectory, what)
    for kind in ("tum", "euroc"):
        assert main(["export", str(tmp_path), "--format", kind, "-o", str(tmp_path / kind)]) == 0
        assert what in (tmp_path / kind).read_text().splitlines()[0]
    assert (tmp_path / "tum").read_bytes() == (tmp_path / "trajectory_map.tum").read_bytes()


def test_a_trajectory_without_a_heading_is_the_cameras(tmp_path: Path) -> None:
    (tmp_path / "t.tum").write_text("1.0 0 0 0 0 0 0 1\n")
    assert named_pose(tmp_path / "t.tum") == "world_T_cam0"


def test_a_floor_plan_is_written_to_its_path_and_overwrites_no_file(
    tmp_path: Path, saved: SavedMap, capsys: pytest.CaptureFixture[str]
) -> None:
    save_map(saved, tmp_path / "m")
    export = ["export", str(tmp_path / "m"), "--format", "floor-plan", "-o", str(tmp_path / "plans" / "plan_0.05m")]
    assert main(export) == 0
    files = [tmp_path / "plans" / f"plan_0.05m.{ending}" for ending in ("png", "yaml")]
    assert capsys.readouterr().out == f"written to {files[0]}, {files[1]}\n"
    assert sorted((tmp_path / "plans").iterdir()) == files
    assert yaml.safe_load(files[1].read_text())["image"] == "plan_0.05m.png"
    for path in files:  # either of the two is somebody's work
        other = next(f for f in files if f != path)
        other.unlink()
        before = path.read_bytes()
        assert main(export) == 2
        assert f"{path} exists: choose another -o" in capsys.readouterr().err
        assert path.read_bytes() == before and not other.exists()
        assert main([*export, "--overwrite"]) == 0
        capsys.readouterr()


@pytest.mark.parametrize("metres", ["nan", "0", "-0.1", "inf", "1e-7"])
def test_a_floor_plan_with_an_invalid_resolution(
    tmp_path: Path, saved: SavedMap, metres: str, capsys: pytest.CaptureFixture[str]
) -> None:
    save_map(saved, tmp_path / "m")
    assert main(["export", str(tmp_path / "m"), "--format", "floor-plan", f"--resolution={metres}"]) == 2
    error = capsys.readouterr().err
    assert len(error.splitlines()) == 1 and ("above 0 metres" in error or "pixels" in error)
    with pytest.raises(StereoSfmError):
        make_floor_plan(saved.snapshot, float(metres))


def test_kittis_lines_of_a_run_are_its_frames_also_lost_ones(tmp_path: Path) -> None:
    """A frame without a pose has a line, or all after it would belong to other images."""
    (tmp_path / "trajectory_map.tum").write_text("1.0 0 0 0 0 0 0 1\n3.0 0 0 2 0 0 0 1\n")
    lines = [f"1 0 0 0 0 1 0 0 0 0 1 {z}" for z in (0, 1, 2)]
    (tmp_path / "trajectory_map.kitti").write_text("\n".join(lines) + "\n")
    for which, count in (("kitti", 3), ("tum", 2)):
        out = tmp_path / f"out.{which}"
        assert main(["export", str(tmp_path), "--format", which, "-o", str(out)]) == 0
        rows = [line for line in out.read_text().splitlines() if not line.startswith("#")]
        assert len(rows) == count
