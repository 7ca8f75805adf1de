"""`stereo-sfm dense`: files, going on where it was, bad input in one line."""

from __future__ import annotations

import errno
import json
import struct
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from stereo_sfm.arrays import write_arrays
from stereo_sfm.cli import main
from stereo_sfm.dense import build as module
from stereo_sfm.dense import inputs
from stereo_sfm.dense.files import Mesh, read_mesh, write_all, write_heights, write_mesh_ply
from stereo_sfm.dense.keyframe_depth import KeyframeImages, keyframe_depth, partner, shows_more, with_partners
from stereo_sfm.dense.pictures import render_mesh
from stereo_sfm.dense.report import write_report
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.export.floor_plan import FloorPlan
from stereo_sfm.geometry import se3
from tests.dense.test_depth import render
from tests.maps.maps import small_map
from tests.synthetic import pinhole_rig

VOXEL = 0.04
WALLS = [(2, 2.0), (0, -1.0), (0, 1.1)]
FLOOR = np.eye(4)  # z up from a floor 1 m below the camera, which looks along y
FLOOR[:3, :3] = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]], float)
FLOOR[:3, 3] = (0, 1.0, 0)


def drive(steps: int = 3, right: bool = True) -> list[KeyframeImages]:
    """Keyframes that move ahead by 15 cm."""
    rig, out = pinhole_rig(), []
    for k in range(steps):
        pose = np.eye(4)
        pose[2, 3] = 0.15 * k
        other = render(rig.right, pose @ rig.left_T_right, WALLS)[0] if rig.right is not None and right else None
        out.append(KeyframeImages(k, rig, pose, render(rig.left, pose, WALLS)[0], other))
    return out


class _Saved:
    snapshot, sessions, rig = None, np.zeros(3, np.int64), pinhole_rig()

    def __len__(self) -> int:
        return 3


class Case:
    """A drive as `build` takes it, without recordings."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.frames, self.made = drive(), 0
        self.given: Any = SimpleNamespace(saved=_Saved(), map_T_floor=FLOOR)
        monkeypatch.setattr(module, "keyframes", self._keyframes)
        monkeypatch.setattr(module, "fuse", self._fuse)

    def _keyframes(self, _: object) -> Iterator[KeyframeImages]:
        yield from self.frames

    def _fuse(self, *args: Any) -> Any:
        from stereo_sfm.dense.volume import fuse

        self.made += 1
        return fuse(*args)


def test_a_drive_becomes_files_and_goes_on_where_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    case = Case(monkeypatch)
    volume = module.build(case.given, tmp_path, VOXEL, 1)
    numbers = write_all(volume, tmp_path)
    made = case.made
    assert made == len(volume.indices) > 1
    assert sorted(p.name for p in (tmp_path / "depth").iterdir()) == ["000000.npz", "000002.npz"], "15 cm show no more"
    written = {p.name: p.read_bytes() for p in tmp_path.iterdir() if p.is_file()}

    (tmp_path / "cubes" / sorted(p.name for p in (tmp_path / "cubes").iterdir())[0]).write_bytes(b"cut off")
    write_all(module.build(case.given, tmp_path, VOXEL, 1), tmp_path)
    assert case.made == made + 1, "only the damaged cube is made again"
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir() if p.is_file()} == written, "the same bits"

    vertices = np.frombuffer(written["mesh.ply"].partition(b"end_header\n")[2], np.uint8)
    count = int(numbers["vertices"])
    points = vertices[: 15 * count].reshape(-1, 15)[:, :12].copy().view("<f4")
    ahead = points[(np.abs(points[:, 0]) < 0.5)]
    assert np.median(np.abs(ahead[:, 1] - 2.0)) < 0.02, "the wall ahead, along y of the floor"
    magic, version, size = struct.unpack("<4sII", written["mesh.glb"][:12])
    assert (magic, version, size) == (b"glTF", 2, len(written["mesh.glb"]))
    length = struct.unpack("<I", written["mesh.glb"][12:16])[0]
    assert json.loads(written["mesh.glb"][20 : 20 + length])["accessors"][0]["count"] == count

    about = yaml.safe_load(written["costmap.yaml"])
    image = cv2.imread(str(tmp_path / about["image"]), 0)
    assert image is not None
    assert set(np.unique(image)) == {0, 205, 254}
    row, column = (
        image.shape[0] - 1 - int((y - about["origin"][1]) / VOXEL) if axis else int((y - about["origin"][0]) / VOXEL)
        for axis, y in ((1, 2.0), (0, 0.0))
    )
    assert (image[row - 2 : row + 3, column] == 0).any(), "the wall is occupied"
    assert image[row + 12, column] == 254, "the floor before it is free"


def test_voxels_that_no_depth_is_precise_enough_for_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(StereoSfmError, match="choose a larger --voxel"):
        module.build(Case(monkeypatch).given, tmp_path, 1e-6, 1)


def test_slices_las_and_pictures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    case = Case(monkeypatch)
    bands = (*module.ROBOT, (0.2, 0.6), (5.0, 6.0))
    volume = module.build(case.given, tmp_path, 0.08, 1)
    made = case.made
    module.build(case.given, tmp_path, 0.08, 1)
    assert case.made == made, "what is there needs no fusion"
    numbers = write_all(volume, tmp_path, bands)
    names = "costmap.png", "costmap_0.20_0.60.png", "costmap_5.00_6.00.png"
    whole, low, high = (cv2.imread(str(tmp_path / name), 0) for name in names)
    assert whole is not None and low is not None and high is not None
    assert (high == 205).all(), "nothing was seen there"
    assert 0 < (low == 0).sum() <= (whole == 0).sum()
    assert yaml.safe_load((tmp_path / "costmap_0.20_0.60.yaml").read_text())["image"] == "costmap_0.20_0.60.png"

    las, count = (tmp_path / "cloud.las").read_bytes(), int(numbers["vertices"])
    assert las[:4] == b"LASF" and las[24:26] == bytes([1, 2])
    assert struct.unpack_from("<HI", las, 94) == (227, 227) and struct.unpack_from("<BHI", las, 104) == (2, 26, count)
    step, corner = np.array(struct.unpack_from("<3d", las, 131)), np.array(struct.unpack_from("<3d", las, 155))
    bounds = np.array(struct.unpack_from("<6d", las, 179)).reshape(3, 2)
    rows = np.frombuffer(las, np.dtype([("xyz", "<i4", 3), ("rest", "V14")]), offset=227)
    points = rows["xyz"] * step + corner
    assert len(points) == count
    np.testing.assert_allclose(np.stack([points.max(0), points.min(0)], axis=1), bounds, atol=1e-3)

    report = write_report(tmp_path, "a drive", 0.08, numbers).read_text()
    pictures = [line.split("(")[-1].rstrip(")") for line in report.splitlines() if line.startswith("![")]
    assert {"mesh_height.png", "mesh_grey.png", "depth_1.png", "depth_2.png"} <= set(pictures)
    for name in pictures:
        picture = cv2.imread(str(tmp_path / name))
        assert picture is not None and picture.std() > 5


def test_a_mesh_is_drawn_from_before_and_the_nearer_face_hides_the_other() -> None:
    square = np.array([[0, 0, 0], [0, 1, 0], [1, 1, 0], [1, 0, 0]], float)  # seen from below: clockwise from above
    points = np.concatenate([square, square + np.array([0, 0, 0.5])])
    colours = np.repeat(np.array([[250, 0, 0], [0, 0, 250]], np.uint8), 4, axis=0)
    up = np.array([[0, 2, 1], [0, 3, 2]])
    image = render_mesh([points], [(points, colours, up), (points, colours, up + 4)], 200)
    assert image is not None
    blue, red = image[..., 0] > image[..., 2] + 50, image[..., 2] > image[..., 0] + 50
    assert red.sum() > 1.1 * blue.sum() > 0, "the upper one hides a part of the lower one"
    behind = render_mesh([points], [(points, colours, up[:, ::-1])], 200)
    assert behind is not None and (behind == 255).all(), "from behind there is nothing"
    assert render_mesh([points], [], 200) is None


def test_a_ceiling_does_not_hide_what_is_below(tmp_path: Path) -> None:
    x, y = (a.ravel() * 0.1 + 0.05 for a in np.mgrid[:10, :10])
    below = np.stack([x, y, np.where(x < 0.5, 0.0, 1.5)], axis=1)
    ceiling = np.stack([x, y, np.full(100, 2.8)], axis=1)
    plan = FloorPlan(np.zeros((20, 30), np.uint8), 0.1, (-1.0, -0.5), np.eye(4))
    pictures: list[Any] = []
    for points in (below, np.concatenate([below, ceiling])):
        with Mesh(tmp_path) as mesh:
            mesh.add(points, np.zeros(len(points), np.uint8), np.zeros((0, 3), np.int64))
            write_heights(tmp_path / "height.png", mesh, plan)
        pictures.append(cv2.imread(str(tmp_path / "height.png"), cv2.IMREAD_UNCHANGED))
    np.testing.assert_array_equal(pictures[0], pictures[1])
    assert pictures[0].shape == (20, 30, 4), "the pixels of the costmap"
    known = pictures[0][..., 3] > 0
    assert known[5:15, 10:20].all() and known.sum() == 100, "elsewhere nothing is known"
    blue, red = pictures[0][10, 11].astype(int)[[0, 2]], pictures[0][10, 18].astype(int)[[0, 2]]
    assert blue[0] > blue[1] and red[1] > red[0]


def test_a_mesh_is_read_as_it_was_written(tmp_path: Path) -> None:
    path = tmp_path / "mesh.ply"
    points, triangles = np.arange(12.0).reshape(4, 3), np.array([[0, 1, 2], [3, 2, 1]])
    grey = np.arange(4, dtype=np.uint8)
    with Mesh(tmp_path) as mesh:
        mesh.add(points, grey, triangles)
        write_mesh_ply(path, mesh)
    for read, wrote in zip(read_mesh(path), (points, np.repeat(grey[:, None], 3, axis=1), triangles), strict=True):
        np.testing.assert_array_equal(read, wrote)
    whole = path.read_bytes()
    for bad in (b"", b"ply\n", whole[:-1], whole + b"x", whole.replace(b"face 2", b"face 3"), whole[:-4] + b"\xff" * 4):
        path.write_bytes(bad)
        with pytest.raises(StereoSfmError):
            read_mesh(path)


@pytest.mark.slow  # starts two processes
def test_two_processes_write_the_same_bits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    case = Case(monkeypatch)
    case.frames = case.frames[::2]
    for jobs in (1, 2):
        folder = tmp_path / str(jobs)
        write_all(module.build(case.given, folder, 0.08, jobs), folder)
    one, two = ({p.relative_to(tmp_path / n): p.read_bytes() for p in (tmp_path / n).rglob("*.*")} for n in "12")
    assert len(one) > 8
    assert one == two


def test_one_camera_has_depth_from_motion_alone() -> None:
    frames = drive(2, right=False)
    assert keyframe_depth(frames[0], []) is None
    before = partner(frames[:1], frames[1])
    assert before is frames[0]
    depth = keyframe_depth(frames[1], [before])
    assert depth is not None
    points = depth.points()
    sides = points[np.isfinite(points[..., 0]) & (points[..., 2] < 1.75) & (np.abs(points[..., 0]) > 0.8)]
    assert len(sides) > 300
    off = np.minimum(np.abs(sides[:, 0] + 1.0), np.abs(sides[:, 0] - 1.1))
    assert np.median(off) < 0.02


def test_partners_are_before_and_after_in_the_same_session() -> None:
    frames = drive(6, right=False)
    sessions = np.array([0, 0, 0, 0, 1, 1])
    found = [(now.number, [k.number for k in others]) for now, others in filter(None, with_partners(frames, sessions))]
    assert found == [(0, [2]), (2, [0, 3]), (4, [5])]


def test_depth_only_where_the_camera_moved_or_turned() -> None:
    frames = drive(3, right=False)
    assert not shows_more(frames[0], frames[1])
    assert shows_more(frames[0], frames[2])
    for degrees, more in ((10.0, False), (20.0, True)):
        turned = frames[0].map_T_cam @ se3.exp(np.array([0, 0, 0, 0, np.deg2rad(degrees), 0]))
        assert shows_more(frames[0], replace(frames[0], map_T_cam=turned)) == more


def test_a_full_disk_is_one_line_and_what_was_fused_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    case = Case(monkeypatch)
    made: list[str] = []

    def full(path: Path, columns: dict[str, Any]) -> None:
        if len(made) >= 2:
            raise OSError(errno.ENOSPC, "No space left on device")
        made.append(path.name)
        write_arrays(path, columns)

    monkeypatch.setattr("stereo_sfm.dense.build.write_arrays", full)
    monkeypatch.setattr("stereo_sfm.dense.inputs.find_input", lambda *_: case.given)
    out = tmp_path / "out"
    assert main(["dense", "any", "-o", str(out), "--voxel", "0.08", "--jobs", "1", "-q"]) == 2
    err = capsys.readouterr().err.strip()
    assert len(err.splitlines()) == 1
    assert f"cannot write to {out}: No space left on device; what was written so far is kept" in err
    kept = sorted((out / "depth").iterdir()) + sorted((out / "cubes").iterdir())
    assert len(kept) == 2
    for path in kept:
        with np.load(path) as data:
            assert all(data[name] is not None for name in data.files)


def test_a_run_without_images_says_which_log_keeps_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "run.mcap").write_bytes(b"")
    monkeypatch.setattr(inputs, "LogReader", lambda _: nullcontext())
    for source in ("euroc:/gone/away", ""):
        monkeypatch.setattr(inputs, "read_run", lambda _, s=source: SimpleNamespace(image_format="none", source=s))
        monkeypatch.setattr(inputs, "load_map", lambda _: None)
        with pytest.raises(StereoSfmError, match="run again with --log full, or name the recording") as caught:
            inputs.find_input(tmp_path)
        assert (source or "(unnamed)") in str(caught.value)


def test_a_keyframe_without_image_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    saved = small_map()[1]
    images = [
        SimpleNamespace(frame_id=k, stamp_ns=t, left=None, right=None)
        for k, t in zip(saved.snapshot.frame_ids.tolist(), saved.snapshot.stamp_ns.tolist(), strict=True)
    ]
    monkeypatch.setattr(inputs, "open_recording", lambda *_: nullcontext(images[:-2]))
    given = inputs.DenseInput(saved, ("walk.mcap",), None)
    with pytest.raises(StereoSfmError, match=r"walk\.mcap lacks 2 of the map's keyframes"):
        list(inputs.keyframes(given))


def test_bad_input_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from stereo_sfm.maps.saved_map import save_map

    def fails(*args: object) -> str:
        assert main(["dense", *map(str, args)]) == 2
        err = capsys.readouterr().err
        assert len(err.strip().splitlines()) == 1
        return err

    assert "is not the folder of a run or a map" in fails(tmp_path / "none", "-o", tmp_path / "out")
    save_map(small_map()[1], tmp_path / "store")
    without = fails(tmp_path / "store", "-o", tmp_path / "out")
    assert "--images SOURCE" in without and "--log full" in without
    assert "no such file" in fails(tmp_path / "store", "-o", tmp_path / "out", "--images", "gone.mcap")
    assert "--slice takes two heights" in fails(tmp_path / "store", "-o", tmp_path / "out", "--slice", "0.6,0.1")
    assert "--voxel" in fails(tmp_path / "store", "-o", tmp_path / "out", "--voxel", "0")
