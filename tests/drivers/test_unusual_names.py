"""Folders, files, topics and lists of times that are named otherwise than ours."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest

from stereo_sfm.calib import save_rig
from stereo_sfm.calib.formats.native import rig_to_text
from stereo_sfm.calib.formats.pair_files import left_files
from stereo_sfm.calib.rig import Rig
from stereo_sfm.calib.side_names import side_pairs
from stereo_sfm.calib.views import find_pairs
from stereo_sfm.drivers import open_source
from stereo_sfm.drivers.choice import SourceChoice
from stereo_sfm.drivers.image_lists import natural_key
from stereo_sfm.drivers.images.source import find_pair
from stereo_sfm.drivers.mcap.topics import is_rectified
from stereo_sfm.drivers.times_file import read_times
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Pinhole
from tests.drivers import dataset_folders

NS = 1403636579763555584


def write(folder: Path, names: Sequence[str], level: int) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    pixels = (np.random.default_rng(level).integers(0, 40, (30, 40)) + level).astype(np.uint8)
    for name in names:
        cv2.imwrite(str(folder / name), pixels)


def stereo_rig() -> Rig:
    camera = Pinhole(40, 30, 30.0, 30.0, 20.0, 15.0)
    return Rig(camera, camera, se3.from_rotation_translation(np.eye(3), np.array([0.1, 0, 0])))


@pytest.mark.parametrize(
    "names",
    ["left right", "Left Right", "cam_left cam_right", "leftcam rightcam", "L R", "cam1 cam2", "fisheye1 fisheye2",
     "infra1 infra2", "image_2 image_3", "image_left/data image_right/data"],
)  # fmt: skip
@pytest.mark.parametrize("suffix", ["png", "jpg"])
def test_folders_of_two_cameras(names: str, suffix: str, tmp_path: Path) -> None:
    for level, name in zip((50, 150), names.split(), strict=True):
        write(tmp_path / name, [f"{k:06d}.{suffix}" for k in range(3)], level)
    save_rig(stereo_rig(), tmp_path / "rig.yaml")
    with open_source(tmp_path) as source:
        images = list(source)
    assert [image.left.mean() < 100 < image.right.mean() for image in images if image.right is not None] == [True] * 3


@pytest.mark.parametrize(
    ("left", "right"),
    [
        ("left{}", "right{}"),
        ("cam0_{}", "cam1_{}"),
        ("{}_left", "{}_right"),
        ("{}_cam0", "{}_cam1"),
        ("img_L_{}", "img_R_{}"),
    ],
)
def test_files_of_both_cameras_in_one_folder(left: str, right: str, tmp_path: Path) -> None:
    numbers = [NS + 50_000_000 * k for k in range(3)]
    write(tmp_path, [f"{left.format(n)}.png" for n in numbers], 50)
    write(tmp_path, [f"{right.format(n)}.png" for n in numbers], 150)
    found = find_pair(tmp_path)
    assert found is not None
    assert [p.stem for p in found[0]] == [left.format(n) for n in numbers]
    assert [p.stem for p in found[1]] == [right.format(n) for n in numbers]


def test_names_that_tell_nothing_are_chosen(tmp_path: Path) -> None:
    for level, name in ((50, "west"), (150, "east")):
        write(tmp_path / name, ["0.png", "1.png"], level)
    save_rig(stereo_rig(), tmp_path / "rig.yaml")
    assert find_pair(tmp_path) is None
    with pytest.raises(StereoSfmError, match=r"east, rig.yaml, west: name them as in .*left=FOLDER&right=FOLDER"):
        open_source(f"images:{tmp_path}")
    with open_source(f"images:{tmp_path}?left=west&right=east") as source:
        assert source.frame_count == 2
    with pytest.raises(StereoSfmError, match="give both"):
        open_source(f"images:{tmp_path}?left=west")


MAKERS = [getattr(dataset_folders, name) for name in sorted(vars(dataset_folders)) if name.startswith("make_")]


@pytest.mark.parametrize("make", MAKERS)
def test_what_macos_writes_beside_every_file_is_left_out(make: Callable[[Path], Path], tmp_path: Path) -> None:
    """Beside each NAME a ._NAME without an image, text or calibration in it."""
    folder = make(tmp_path / "data")
    with open_source(folder) as source:
        rig, stamps = rig_to_text(source.rig), [(image.stamp_ns, image.right is None) for image in source]
    for path in list((tmp_path / "data").rglob("*")):
        path.with_name(f"._{path.name}").write_bytes(b"\x00\x05\x16\x07Mac OS X")
    with open_source(folder) as source:
        assert [(image.stamp_ns, image.right is None) for image in source] == stamps
        assert rig_to_text(source.rig) == rig


def test_hidden_files_are_no_images_and_no_calibrations(tmp_path: Path) -> None:
    for side, level in (("left", 50), ("right", 150)):
        write(tmp_path, [f"{side}{k}.png" for k in range(3)], level)
        (tmp_path / f"._{side}0.png").write_bytes(b"Mac OS X")
        write(tmp_path / f".{side}", [f"{k}.png" for k in range(9)], level)
    for text in ("", "*.png"):
        found = find_pair(tmp_path, text.replace("*", "left*"), text.replace("*", "right*"))
        assert found is not None and [[p.name for p in side] for side in found] == [
            [f"{side}{k}.png" for k in range(3)] for side in ("left", "right")
        ]
    assert all(len(side) == 3 for side in find_pair(tmp_path, "*left*.png", "*right*.png") or ())
    assert len(find_pairs(tmp_path)) == 3
    for side in ("left", "right"):
        (tmp_path / f"._{side}.yaml").write_text("Mac OS X")
    assert left_files(tmp_path, ".yaml") == []


def test_recordings_side_by_side_are_no_pair(tmp_path: Path) -> None:
    for name in ("run1", "run2", "2024", "2025"):
        write(tmp_path / name, ["0.png"], 50)
    assert find_pair(tmp_path) is None


@pytest.mark.parametrize(
    ("text", "stamps", "names"),
    [
        ("1.5\n2.5\n", [1_500_000_000, 2_500_000_000], []),
        ("# times\n\n1.5\r\n2.5", [1_500_000_000, 2_500_000_000], []),
        ("timestamp\n1.5\n2.5", [1_500_000_000, 2_500_000_000], []),
        ("1.403636579763555584e+18\n1.403636579813555456e+18\n", [NS, 1403636579813555456], []),
        (f"#timestamp [ns],filename\n{NS},a.png\n{NS + 1},b.png", [NS, NS + 1], ["a", "b"]),
        ("0 1.5\n1 2.5\n", [1_500_000_000, 2_500_000_000], []),
        ("00000 1.5 0.02\n00001 2.5 0.01\n00002 3.5 0.03", [10**9 * k + 5 * 10**8 for k in (1, 2, 3)], []),  # exposures
        ("frame,time\n10,1.5\n11,2.5\n", [1_500_000_000, 2_500_000_000], []),
        ("1.5 0.02\n2.5 0.01\n", [1_500_000_000, 2_500_000_000], []),
        ("7 0.02\n8 0.01\n9 0.03\n", [7 * 10**9, 8 * 10**9, 9 * 10**9], []),  # whole seconds and exposures
        ("left/a.png;1.5\nleft/b.png;2.5\n", [1_500_000_000, 2_500_000_000], ["a", "b"]),
        ("1 2 3.5", [1_000_000_000, 2_000_000_000, 3_500_000_000], []),
        ("0\n1\n2\n", [0, 1_000_000_000, 2_000_000_000], []),
        ("1403636579763\n1403636579813\n", [NS // 10**6 * 10**6, 1403636579813000000], []),  # milliseconds
        ("1403636579763555\n1403636579813555\n", [NS // 1000 * 1000, 1403636579813555000], []),  # microseconds
        ("1403636579 763555584\n1403636579 813555456\n1403636580 13555456\n", [NS, NS + 49999872, NS + 249999872], []),
        ("secs,nsecs\n5,900000000\n5,950000000\n6,0\n", [5900000000, 5950000000, 6000000000], []),
        ("5000000000\n5033000000\n", [5_000_000_000, 5_033_000_000], []),  # nanoseconds since the camera's start
    ],
)  # fmt: skip
def test_lists_of_times(text: str, stamps: list[int], names: list[str], tmp_path: Path) -> None:
    path = tmp_path / "times.txt"
    path.write_text(text)
    times = read_times(path)
    assert times.stamp_ns == stamps and times.names == names


def test_a_list_without_times(tmp_path: Path) -> None:
    path = tmp_path / "times.txt"
    for text in ("one\ntwo\n", "nan\n1.5\n2.5\n"):
        path.write_text(text)
        with pytest.raises(StereoSfmError, match="one time in seconds or a smaller unit"):
            read_times(path)


def test_times_that_were_set_back_keep_the_order_of_the_images(tmp_path: Path) -> None:
    for level, name in ((50, "left"), (150, "right")):
        write(tmp_path / name, [f"{k}.png" for k in range(8)], level)
    (tmp_path / "times.txt").write_text("".join(f"{10 + 0.1 * k - 2 * (k >= 4):.1f}\n" for k in range(8)))
    save_rig(stereo_rig(), tmp_path / "rig.yaml")
    with SourceChoice(str(tmp_path))() as source:
        images = list(source)
    assert [image.frame_id for image in images] == list(range(8))
    assert [image.stamp_ns // 10**8 for image in images] == list(range(100, 108))


def test_what_is_missing_is_told_with_the_option_that_gives_it(tmp_path: Path) -> None:
    write(tmp_path / "image_00" / "data", ["0.png"], 50)
    write(tmp_path / "image_01" / "data", ["0.png"], 150)
    (tmp_path / "image_00" / "timestamps.txt").write_text("2011-09-26 13:02:25.964389445\n")
    with pytest.raises(StereoSfmError, match=r"no KITTI raw calibration at .* give a calibration with --rig FILE"):
        open_source(tmp_path)
    write(tmp_path / "east", ["0.png"], 50)
    with pytest.raises(StereoSfmError, match=r"not a known kind .*left=FOLDER&right=FOLDER"):
        open_source(tmp_path / "east")


def test_words_not_letters_tell_rectified_images() -> None:
    assert is_rectified("/camera/left/image_rect") and is_rectified("/cam/image_rect_raw") and is_rectified("/leftRect")
    assert not any(map(is_rectified, ("/direct/left/image_raw", "/camera/unrectified", "/rectangle/image")))


def test_pairs_of_topics() -> None:
    assert side_pairs(["/cleft/image", "/cright/image", "/x/cam0", "/x/cam1"])[0] == ("/cleft/image", "/cright/image")
    assert side_pairs(["/cam1/image", "/cam2/image", "/cam0/image"])[0] == ("/cam0/image", "/cam1/image")
    assert not side_pairs(["/left/image", "/right/mask"])


def test_numbers_after_a_serial_number_are_counted() -> None:
    names = [f"843112073259.{k}.png" for k in (1, 2, 9, 10, 11)]
    assert [p.name for p in sorted(map(Path, reversed(names)), key=natural_key)] == names
