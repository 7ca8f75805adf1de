"""Pictures of a map's keyframes: each sequence's own, from its own recording."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest

from stereo_sfm.calib import save_rig
from stereo_sfm.cli import main
from stereo_sfm.config import Config
from stereo_sfm.drivers.rectified import RectifiedSource, rectified
from stereo_sfm.drivers.source import open_source
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.export.colmap import export_colmap
from stereo_sfm.export.keyframe_images import check_session, open_recording, session_of_recording, write_keyframe_images
from stereo_sfm.log.run_log import RunLog
from stereo_sfm.log.writer import LogWriter
from stereo_sfm.maps.cameras import MapCamera
from stereo_sfm.maps.saved_map import SavedMap, joined, save_map
from stereo_sfm.types import RIG_TERMS, StartCheck, StereoImage
from tests.maps.maps import small_map

LATER_NS = 10**12
SPEC = "sim:aisle?size=150x140&rate=15&seed=1&frames=4"


@pytest.fixture(scope="module")
def saved() -> SavedMap:
    return small_map()[1]


def later(saved: SavedMap, by_ns: int = LATER_NS) -> SavedMap:
    """The same sequence on another day: frame ids restart, the clock does not."""
    return dataclasses.replace(
        saved, snapshot=dataclasses.replace(saved.snapshot, stamp_ns=saved.snapshot.stamp_ns + by_ns)
    )


def recording(saved: SavedMap, grey: int) -> list[StereoImage]:
    """One image of one grey for every keyframe."""
    s = saved.snapshot
    picture = np.full((4, 6), grey, np.uint8)
    return [
        StereoImage(stamp_ns=t, frame_id=k, left=picture, right=picture)
        for t, k in zip(s.stamp_ns.tolist(), s.frame_ids.tolist(), strict=True)
    ]


def names_in(folder: Path) -> list[str]:
    lines = [x for x in (folder / "images.txt").read_text().splitlines() if not x.startswith("#")]
    return [line.split()[9] for line in lines[::2]]


def test_every_image_of_a_merged_map_has_a_name_of_its_own(tmp_path: Path, saved: SavedMap) -> None:
    both = joined([saved, later(saved)])
    export_colmap(both, tmp_path)
    names = names_in(tmp_path)
    assert len(set(names)) == len(names) == 4 * len(saved)
    first = int(saved.snapshot.frame_ids[0])
    assert names[0] == f"left/walk0/{first:06d}.png" and f"right/walk1/{first:06d}.png" in names
    pycolmap = pytest.importorskip("pycolmap")
    assert pycolmap.Reconstruction(str(tmp_path)).num_images() == len(names)


def test_each_recording_gives_the_images_of_its_own_sequence(tmp_path: Path, saved: SavedMap) -> None:
    both = joined([saved, later(saved)])
    export_colmap(both, tmp_path)
    for sequence, one in enumerate((saved, later(saved))):
        pictures = recording(one, 50 + 100 * sequence)
        assert session_of_recording(both, pictures, "day") == sequence
        write_keyframe_images(both, pictures, sequence, tmp_path)
        assert sum(1 for _ in (tmp_path / "images").rglob("*.png")) == 2 * len(saved) * (sequence + 1)
    for name in names_in(tmp_path):
        picture = cv2.imread(str(tmp_path / "images" / name), cv2.IMREAD_GRAYSCALE)
        assert picture is not None and int(picture[0, 0]) == (150 if "walk1" in name else 50)


def test_an_ambiguous_recording_is_rejected(tmp_path: Path, saved: SavedMap) -> None:
    pictures = recording(saved, 50)
    with pytest.raises(
        StereoSfmError, match=r"matches several sessions of the map \(0, 1\): choose one with --session N"
    ):
        session_of_recording(joined([saved, saved]), pictures, "day")
    with pytest.raises(StereoSfmError, match="day lacks keyframes of every session"):
        session_of_recording(joined([saved, later(saved)]), pictures[1:], "day")
    with pytest.raises(StereoSfmError, match="no session 2"):
        check_session(joined([saved, saved]), 2)
    with pytest.raises(StereoSfmError, match=f"another day lacks {len(saved)} of the map's keyframes"):
        write_keyframe_images(later(saved), pictures, 0, tmp_path, "another day")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("how", "option"), [("none", "none"), ("pinhole", "pinhole"), ("epipolar", "wide")])
def test_images_are_those_of_the_maps_camera(how: str, option: str) -> None:
    rig = rectified(open_source(SPEC), how).rig
    source = open_recording(SPEC, [MapCamera(rig)])
    assert isinstance(source, RectifiedSource) == (option != "none")
    assert np.array_equal(source.rig.left.params, rig.left.params)


def test_images_are_paired_as_in_the_run(tmp_path: Path) -> None:
    """Its start check found that the right images are a frame late; the log's own images are paired already."""
    with open_source(SPEC) as source:
        rig, images = source.rig, list(source)
    check = StartCheck(0, images[0].stamp_ns, "a frame apart", "corrected for this run", True, "", 1)
    log = RunLog(LogWriter(tmp_path / "run.mcap"), rig, Config(), source=SPEC, mode="inline", image_format="none")
    log.put(check)
    log.close()
    with open_recording(SPEC, [MapCamera(rig)], run=tmp_path) as shifted:
        seen = list(shifted)
    assert len(seen) == len(images) - 1
    other = SPEC.replace("aisle", "loop")
    with open_source(other) as source, open_recording(other, [MapCamera(source.rig)], run=tmp_path) as as_it_is:
        assert len(list(as_it_is)) == len(images)  # not the recording of this run
    for k, image in enumerate(seen):
        right = images[k + 1].right
        assert image.frame_id == k and image.right is not None and right is not None
        np.testing.assert_array_equal(image.right, right)


def test_images_of_another_camera_are_refused(saved: SavedMap) -> None:
    with pytest.raises(StereoSfmError, match=r"is not the map's.*left image 150x140 instead of 848x800"):
        open_recording(SPEC, [MapCamera(saved.rig)])


def test_a_camera_whose_right_lens_was_corrected_is_the_maps() -> None:
    """Of a lens without distortion, decentering makes one with."""
    spec = f"{SPEC}&camera=pinhole"
    terms = np.zeros(RIG_TERMS)
    terms[6] = np.deg2rad(0.5)
    corrected = MapCamera(open_source(spec).rig, terms)
    assert corrected.rig.right is not None and corrected.rig.right.model != corrected.rig.left.model
    assert not isinstance(open_recording(spec, [corrected]), RectifiedSource)


def test_export_of_a_rectified_run_writes_rectified_images(
    tmp_path: Path, saved: SavedMap, capsys: pytest.CaptureFixture[str]
) -> None:
    seen = rectified(open_source(SPEC), "pinhole")
    with seen:
        frames = list(seen)
    s = saved.snapshot
    ids, stamps = np.full(len(saved), frames[0].frame_id), np.full(len(saved), frames[0].stamp_ns)
    ids[-1], stamps[-1] = frames[2].frame_id, frames[2].stamp_ns
    rectified_map = dataclasses.replace(
        saved, cameras={0: MapCamera(seen.rig)}, snapshot=dataclasses.replace(s, frame_ids=ids, stamp_ns=stamps)
    )
    save_map(rectified_map, tmp_path / "m")
    export = ["export", str(tmp_path / "m"), "--format", "colmap", "-o", str(tmp_path / "c"), "--images", SPEC]
    assert main(export) == 0
    picture = cv2.imread(str(tmp_path / f"c/images/right/{frames[2].frame_id:06d}.png"), cv2.IMREAD_GRAYSCALE)
    right = frames[2].right
    assert picture is not None and right is not None and np.array_equal(picture, right)
    assert "PINHOLE" in (tmp_path / "c" / "cameras.txt").read_text()
    save_rig(saved.rig, tmp_path / "other.yaml")
    assert main([*export, "--rig", str(tmp_path / "other.yaml"), "--overwrite"]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
    assert main(["export", str(tmp_path / "m"), "--format", "ply", "--images", SPEC]) == 2
    assert "--images goes with --format colmap" in capsys.readouterr().err
