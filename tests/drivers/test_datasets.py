from __future__ import annotations

import json
import logging
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from stereo_sfm.calib import Rig, save_rig
from stereo_sfm.cli import main
from stereo_sfm.drivers.image_lists import pair_by_stamp, stamps_of
from stereo_sfm.drivers.registry import recognise
from stereo_sfm.drivers.select import SelectedFrames
from stereo_sfm.drivers.source import open_source
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Pinhole
from stereo_sfm.pixels import eight_bits
from stereo_sfm.recording.describe import describe_dataset
from tests.drivers.dataset_folders import (
    FRAMES,
    PERIOD_NS,
    RIG,
    START_NS,
    make_euroc,
    make_images,
    make_kapture,
    make_kitti,
    make_kitti_raw,
    make_tum_rgbd,
    picture,
)


def test_kitti_root_and_sequence_folder_are_one_source(tmp_path: Path) -> None:
    root = make_kitti(tmp_path)
    for spec in (root, root / "sequences", root / "sequences" / "00", f"kitti:{root}?sequence=00"):
        with open_source(spec) as source:
            images = list(source)
            assert source.name == "kitti:00"
            assert source.frame_count == len(images) == FRAMES
            assert [i.stamp_ns for i in images] == [0, 10**8, 2 * 10**8, 3 * 10**8]
            assert np.array_equal(images[2].left, picture(2, 0))
            assert images[2].right is not None and np.array_equal(images[2].right, picture(2, 1))
            assert source.rig.left_T_right[0, 3] == pytest.approx(0.5)
            assert source.ground_truth is not None
            assert source.ground_truth.positions[:, 2].tolist() == [0, 1, 2, 3]


def test_kitti_from_its_middle(tmp_path: Path) -> None:
    """Poses of the whole sequence belong to the images by their numbers, whatever times there are."""
    root = make_kitti(tmp_path, frames=10)
    sequence = root / "sequences" / "00"
    for path in sequence.glob("image_?/00000[0-5].png"):
        path.unlink()
    for times in ((sequence / "times.txt").read_text(), "".join(f"{k * 0.1:.6e}\n" for k in range(4)), None):
        (sequence / "times.txt").unlink()
        if times is not None:
            (sequence / "times.txt").write_text(times)
        with open_source(root) as source:
            truth, stamps = source.ground_truth, [image.stamp_ns for image in source]
        assert truth is not None
        rows = np.searchsorted(truth.stamp_ns, stamps)
        assert truth.positions[rows, 2].tolist() == [6, 7, 8, 9]
        (sequence / "times.txt").touch()


@pytest.mark.parametrize("make", [make_kitti, make_kitti_raw])
def test_kitti_as_jpeg(make: Callable[[Path], Path], tmp_path: Path) -> None:
    root = make(tmp_path)
    for path in root.rglob("*.png"):
        cv2.imwrite(str(path.with_suffix(".jpg")), cv2.imread(str(path), cv2.IMREAD_UNCHANGED))
        path.unlink()
    with open_source(root) as source:
        images = list(source)
    assert source.name.startswith("kitti") and len(images) == FRAMES and all(i.right is not None for i in images)
    assert np.abs(images[2].left.astype(int) - picture(2, 0)).mean() < 15


def test_several_kitti_sequences_must_be_chosen_from(tmp_path: Path) -> None:
    root = make_kitti(tmp_path)
    (root / "sequences" / "07" / "image_0").mkdir(parents=True)
    with pytest.raises(StereoSfmError, match="00, 07: choose one"):
        open_source(root)


def test_kitti_colour_pair_is_moved_to_its_own_left_camera(tmp_path: Path) -> None:
    root = make_kitti(tmp_path)
    sequence = root / "sequences" / "00"
    for old, new in ((0, 2), (1, 3)):
        (sequence / f"image_{old}").rename(sequence / f"image_{new}")
    (sequence / "calib.txt").write_text("P2: 50 0 32 -3 0 50 24 0 0 0 1 0\nP3: 50 0 32 -28 0 50 24 0 0 0 1 0\n")
    with open_source(root) as source:
        assert source.rig.baseline == pytest.approx(0.5)
        assert source.ground_truth is not None
        assert source.ground_truth.positions[0] == pytest.approx([0.06, 0, 0])


def test_kitti_raw_drive_with_poses_from_gps(tmp_path: Path) -> None:
    root = make_kitti_raw(tmp_path)
    for spec in (root, root / "2011_09_26_drive_0001_sync"):
        with open_source(spec) as source:
            images = list(source)
            assert source.name == "kitti_raw:2011_09_26_drive_0001_sync"
            assert np.diff([i.stamp_ns for i in images]).tolist() == [10**8] * 3
            assert images[0].stamp_ns == 1317042145 * 10**9 + 1
            assert source.rig.left_T_right[0, 3] == pytest.approx(0.5)
            truth = source.ground_truth
            assert truth is not None
            # World: the first IMU's, x forward. The camera looks along it.
            assert truth.positions == pytest.approx(np.outer(range(4), [1, 0, 0]), abs=1e-4)
            assert truth.poses[0][:3, 2] == pytest.approx([1, 0, 0])


def test_a_drive_that_is_not_synchronised_has_poses_of_their_own_times(tmp_path: Path) -> None:
    """Ten packets for each image; the car moves by a metre a packet."""
    root = make_kitti_raw(tmp_path)
    drive = root / "2011_09_26_drive_0001_sync"
    metre = 180 / np.pi / 6378137.0 / np.cos(np.radians(49.0))
    for k in range(31):
        text = f"49.0 {8.4 + k * metre:.12f} 100 0 0 0 " + "0 " * 24
        (drive / "oxts" / "data" / f"{k:010d}.txt").write_text(text)
    times = [f"2011-09-26 13:02:25.{k:02d}0000001\n" for k in range(31)]
    (drive / "oxts" / "timestamps.txt").write_text("".join(times))
    with open_source(root) as source:
        truth, stamps = source.ground_truth, [image.stamp_ns for image in source]
    assert truth is not None and len(truth) == 31
    assert truth.positions[np.searchsorted(truth.stamp_ns, stamps), 0] == pytest.approx([0, 10, 20, 30], abs=1e-3)


def test_images_named_by_seconds_without_zeros_are_in_order(tmp_path: Path) -> None:
    """As Python writes them: ...79.1 is after ...79.05, and before ...79.15."""
    names = [f"{1403636579 + round(0.05 * k, 2)}.png" for k in range(12)]
    with open_source(make_images(tmp_path, names)) as source:
        images = list(source)
    assert [image.stamp_ns for image in images] == [1403636579 * 10**9 + 50_000_000 * k for k in range(12)]
    for k, image in enumerate(images):
        np.testing.assert_array_equal(image.left, picture(k, 0))


def test_poses_without_stamps_beside_images_belong_to_them_in_order(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    root = make_images(tmp_path)
    (root / "poses.txt").write_text("".join(f"1 0 0 0 0 1 0 0 0 0 1 {k}\n" for k in range(12)))
    with open_source(root) as source:
        truth, stamps = source.ground_truth, [image.stamp_ns for image in source]
    assert truth is not None and truth.stamp_ns.tolist() == stamps
    (root / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 7)
    for side in ("left", "right"):
        for path in (root / side).iterdir():
            path.rename(path.with_name(f"{int(path.stem) + 40}.png"))
    with open_source(root) as source:
        assert source.ground_truth is None and "there is no ground truth" in caplog.text


def test_a_second_camera_without_calibration_is_said(tmp_path: Path) -> None:
    root = make_euroc(tmp_path)
    (root / "mav0" / "cam1" / "sensor.yaml").unlink()
    with pytest.raises(StereoSfmError, match=r"cam1.sensor\.yaml: give a calibration of both cameras"):
        open_source(root)


def test_poses_of_a_marker_are_those_of_the_body(tmp_path: Path) -> None:
    root = make_euroc(tmp_path)
    listed = root / "mav0" / "state_groundtruth_estimate0" / "data.csv"
    listed.write_text(listed.read_text().replace("1,0,0,0", "0.6,0,0.8,0", 1))  # else it never turns
    with open_source(root) as source:
        truth = source.ground_truth
    folder = (root / "mav0" / "state_groundtruth_estimate0").rename(root / "mav0" / "vicon0")
    marker = "[0, -1, 0, 0.3, 1, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]"
    (folder / "sensor.yaml").write_text(f"T_BS: {{cols: 4, rows: 4, data: {marker}}}\n")
    with open_source(root) as source:
        moved = source.ground_truth
    body_T_marker = np.array(json.loads(marker), float).reshape(4, 4)
    body_T_left = source.rig.body_T_left
    assert truth is not None and moved is not None
    (folder / "sensor.yaml").write_text("T_BS: {data: [1, 2]}\n")
    with open_source(root) as source:  # which stops no run
        assert source.ground_truth is not None
    expected = truth.poses @ se3.inverse(body_T_left) @ se3.inverse(body_T_marker) @ body_T_left
    np.testing.assert_allclose(moved.poses, expected, atol=1e-9)


def test_kitti_raw_inertial_samples(tmp_path: Path) -> None:
    root = make_kitti_raw(tmp_path)
    drive = root / "2011_09_26_drive_0001_sync"

    def write(folder: Path, count: int, step_ms: int) -> None:
        (folder / "oxts" / "data").mkdir(parents=True, exist_ok=True)
        times = [f"2011-09-26 13:02:{25 + k * step_ms / 1000:012.9f}\n" for k in range(count)]
        (folder / "oxts" / "timestamps.txt").write_text("".join(times))
        for k in range(count):
            values = [49.0, 8.4, 100.0, *[0.0] * 8, 0.1, 0.2, 9.8, *[0.0] * 3, 0.01, 0.02, 0.1 * k, *[0.0] * 10]
            (folder / "oxts" / "data" / f"{k:010d}.txt").write_text(" ".join(map(str, values)))

    with open_source(root) as source:  # packets without stamps
        assert source.rig.imu is None and next(iter(source)).imu is None
    write(drive, 4, 100)
    with open_source(root) as source:
        parts = [image.imu for image in source]
        assert [len(part) for part in parts if part is not None] == [1, 1, 1, 1]
        assert source.rig.imu is not None and source.rig.imu.rate_hz == pytest.approx(10)
        # The camera looks along the IMU's x axis: x right is -y, y down is -z.
        assert np.allclose(source.rig.imu.left_T_imu[:3, :3], [[0, -1, 0], [0, 0, -1], [1, 0, 0]])
    write(root / "2011_09_26_drive_0001_extract", 32, 10)
    with open_source(drive) as source:
        parts = [image.imu for image in source]
        assert [len(part) for part in parts if part is not None] == [1, 10, 10, 10]
        part = parts[1]
        assert part is not None and source.rig.imu is not None
        assert source.rig.imu.rate_hz == pytest.approx(100)
        assert part.gyro[0] == pytest.approx([0.01, 0.02, 0.1]) and part.accel[0] == pytest.approx([0.1, 0.2, 9.8])


def test_kapture_records(tmp_path: Path) -> None:
    with open_source(make_kapture(tmp_path)) as source:
        images = list(source)
        assert [i.stamp_ns for i in images] == [START_NS + i * PERIOD_NS for i in range(FRAMES)]
        assert images[3].right is not None and np.array_equal(images[3].right, picture(3, 1))
        assert source.rig.left_T_right[:3, 3] == pytest.approx([0.2, 0, 0])
        assert source.rig.body_T_left[:3, 3] == pytest.approx([0, 0, 1])


def test_kapture_without_extrinsics_needs_a_rig_unless_it_is_a_t265(tmp_path: Path) -> None:
    (make_kapture(tmp_path) / "sensors" / "rigs.txt").unlink()
    with pytest.raises(StereoSfmError, match="--rig FILE"):
        open_source(tmp_path)


def test_euroc_ground_truth_is_the_left_cameras(tmp_path: Path) -> None:
    with open_source(make_euroc(tmp_path / "euroc")) as source:
        assert source.name == "euroc:euroc"
        images = list(source)
        assert [i.stamp_ns for i in images] == [START_NS + i * PERIOD_NS for i in range(FRAMES)]
        assert source.rig.left_T_right[:3, 3] == pytest.approx([0.1, 0, 0])
        truth = source.ground_truth
        assert truth is not None
        # The body looks along +z without rotation, so the camera at T_BS is 1 m below it and looks along -z.
        assert truth.poses[2][:3, :3] == pytest.approx(np.diag([-1, 1, -1]))
        assert truth.positions[2] == pytest.approx([2, 1, 3])


def test_euroc_pairs_by_stamp_if_one_camera_lacks_frames(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    root = make_euroc(tmp_path)
    listing = root / "mav0" / "cam1" / "data.csv"
    lines = listing.read_text().splitlines()
    listing.write_text("\n".join([lines[0], *lines[2:]]) + "\n")
    with caplog.at_level(logging.WARNING, "stereo_sfm"), open_source(root) as source:
        images = list(source)
    assert [i.stamp_ns for i in images] == [START_NS + i * PERIOD_NS for i in (1, 2, 3)]
    assert images[0].right is not None and np.array_equal(images[0].right, picture(1, 1))
    assert "4 left and 3 right images, the 3 pairs are used" in caplog.text


def test_info_lists_inertial_samples_and_accepts_a_rig(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = make_euroc(tmp_path / "euroc")
    (root / "mav0" / "imu0").mkdir()
    rows = [f"{START_NS + i * 5_000_000},0,0,0,0,0,9.8" for i in range(40)]
    (root / "mav0" / "imu0" / "data.csv").write_text("#timestamp,w\n" + "\n".join(rows) + "\n")
    assert main(["info", str(root)]) == 0
    assert "imu0  samples beside the images  40 at 200.00 Hz" in capsys.readouterr().out
    rgbd = make_tum_rgbd(tmp_path).rename(tmp_path / "my_camera")
    assert main(["info", str(rgbd)]) == 2
    assert "give --rig FILE" in capsys.readouterr().err
    save_rig(Rig(Pinhole(640, 480, 500, 500, 320, 240)), tmp_path / "rig.yaml")
    assert main(["info", str(rgbd), "--rig", str(tmp_path / "rig.yaml")]) == 0
    assert "fx 500.00" in capsys.readouterr().out


def test_sixteen_bit_images_keep_their_upper_eight_bits(tmp_path: Path) -> None:
    root = make_euroc(tmp_path)
    for path in (root / "mav0" / "cam0" / "data").glob("*.png"):
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        cv2.imwrite(str(path), (image.astype(np.uint16) << 8) + 240)
    with open_source(root) as source:
        assert np.array_equal(next(iter(source)).left, picture(0, 0))


@pytest.mark.parametrize(
    ("bits", "shift", "lowest"), [(12, 4, 8), (10, 2, 2), (14, 6, 32), (8, 0, 0), (12, 4, 0), (10, 2, 0)]
)
def test_sixteen_bit_images_are_scaled_by_the_range_that_they_use(
    bits: int, shift: int, lowest: int, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    root = make_images(tmp_path)
    for path in root.glob("*/*.png"):
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        cv2.imwrite(str(path), (image.astype(np.uint16) << shift) + lowest)
    dark = root / "left" / "0.png"  # the first image alone does not show the range
    cv2.imwrite(str(dark), np.full((48, 64), 3 if lowest else 3 << shift, np.uint16))
    with caplog.at_level(logging.WARNING, "stereo_sfm"), open_source(root, fps=30.0) as source:
        images = list(source)
    assert np.array_equal(images[1].left, picture(1, 0))
    assert images[0].right is not None and np.array_equal(images[0].right, picture(0, 1))
    assert f"its sixteen-bit images use {bits} bits" in caplog.text
    assert len(caplog.records) == 1


def test_pixels_above_the_range_of_the_sample_are_white() -> None:
    image = np.array([[0, 1023, 1024, 65535]], np.uint16)
    assert eight_bits(image, 10).tolist() == [[0, 255, 255, 255]]


def test_tum_rgbd_has_depth_in_metres_and_a_virtual_camera(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING, "stereo_sfm"), open_source(make_tum_rgbd(tmp_path)) as source:
        images = list(source)
        assert [i.stamp_ns for i in images] == [100 * 10**9, 100_200_000_000]
        depth = images[0].depth
        assert depth is not None and depth.dtype == np.float32
        assert np.isnan(depth[0, 0]) and depth[5, 5] == pytest.approx(1.5)
        assert images[0].right is None
        assert source.rig.depth and source.rig.baseline == pytest.approx(0.08)
        assert source.rig.left.model == "radtan" and source.rig.left.fx == pytest.approx(517.306408)
        assert source.rig.readout_s == pytest.approx(0.028)  # a rolling shutter
        assert source.ground_truth is not None and source.ground_truth.positions[-1].tolist() == [0, 0, 1]
    assert "1 of 3 colour images have no depth image" in caplog.text


def test_a_rig_that_cannot_state_a_readout_keeps_the_data_sets(tmp_path: Path) -> None:
    folder = make_tum_rgbd(tmp_path)
    with open_source(folder) as source:
        own = source.rig
    save_rig(replace(own, right=None, depth=False), tmp_path / "camera.yml", "opencv")
    save_rig(replace(own, readout_s=0.0), tmp_path / "rig.yaml")
    assert open_source(folder, rig=tmp_path / "camera.yml").rig.readout_s == own.readout_s
    assert open_source(folder, rig=tmp_path / "rig.yaml").rig.readout_s == 0.0


def test_depth_images_in_other_units(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    folder = make_tum_rgbd(tmp_path)  # 7500 units everywhere
    for scale, metres in ((1000, 7.5), (5000, 1.5)):
        with open_source(f"{folder}?depth_scale={scale}") as source:
            depth = next(iter(source)).depth
        assert depth is not None and depth[5, 5] == pytest.approx(metres)
    assert "depth_scale" not in caplog.text
    for unknown in (0, 65535):
        holed = np.full((480, 640), 7500, np.uint16)
        holed[5, 5] = unknown
        cv2.imwrite(str(sorted((folder / "depth").glob("*.png"))[0]), holed)
        with open_source(folder) as source:
            depth = next(iter(source)).depth
        assert depth is not None and np.isnan(depth[5, 5]) and depth[5, 6] == 1.5
    for file in sorted((folder / "depth").glob("*.png")):
        cv2.imwrite(str(file), np.full((480, 640), 700, np.uint16))  # 0.7 m in millimetres
    with open_source(folder):
        assert "depths from 0.14 m on are nearer than depth cameras see" in caplog.text
        assert "?depth_scale=1000" in caplog.text


def test_tum_rgbd_of_an_unknown_camera_needs_a_rig(tmp_path: Path) -> None:
    folder = make_tum_rgbd(tmp_path).rename(tmp_path / "my_kinect")
    with pytest.raises(StereoSfmError, match="--rig FILE"):
        open_source(folder)


def test_image_folders_in_natural_order_with_a_rig_file(tmp_path: Path) -> None:
    with open_source(make_images(tmp_path), fps="20") as source:
        images = list(source)
        assert np.array_equal(images[10].left, picture(10, 0))  # 10.png after 9.png, not after 1.png
        assert images[10].stamp_ns == 500_000_000
        assert source.rig.baseline == pytest.approx(0.1)


def test_image_files_named_by_time(tmp_path: Path) -> None:
    names = [f"{START_NS + i * PERIOD_NS}.png" for i in range(3)]
    with open_source(make_images(tmp_path, names)) as source:
        assert [i.stamp_ns for i in source] == [START_NS + i * PERIOD_NS for i in range(3)]


def test_image_times_file(tmp_path: Path) -> None:
    make_images(tmp_path, ["a.png", "b.png"])
    (tmp_path / "times.txt").write_text("1305031102.175304\n1305031102.211214\n")
    with open_source(tmp_path) as source:
        assert [i.stamp_ns for i in source] == [1305031102175304000, 1305031102211214000]


def test_left_and_right_files_in_one_folder(tmp_path: Path) -> None:
    make_images(tmp_path, [f"{i:02d}.png" for i in (1, 2, 4)])
    for side in ("left", "right"):
        for path in (tmp_path / side).iterdir():
            path.rename(tmp_path / f"{side}{path.name}")
        (tmp_path / side).rmdir()
    (tmp_path / "right02.png").unlink()
    with open_source(tmp_path) as source:
        images = list(source)
    assert len(images) == 2
    assert np.array_equal(images[1].left, picture(2, 0))
    assert images[1].right is not None and np.array_equal(images[1].right, picture(2, 1))


def skewed_stereo(root: Path, skew_ns: int, missing: int | None = None) -> Path:
    """Ten pairs 25 ms apart in time, their names the stamps; one right image may be missing."""
    for index, side in enumerate(("left", "right")):
        (root / side).mkdir()
        for i in range(10):
            if side == "left" or i != missing:
                name = f"{START_NS + i * 25_000_000 + index * skew_ns}.png"
                cv2.imwrite(str(root / side / name), picture(i, index))
    (root / "rig.yaml").write_text(RIG)
    return root


def test_images_named_by_time_are_paired_by_time(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING, "stereo_sfm"), open_source(skewed_stereo(tmp_path, 1_500_000, 4)) as source:
        images = list(source)
    kept = [i for i in range(10) if i != 4]
    assert [i.stamp_ns for i in images] == [START_NS + i * 25_000_000 for i in kept]
    assert all(i.right_stamp_ns - i.stamp_ns == 1_500_000 for i in images)
    for image, number in zip(images, kept, strict=True):
        assert image.right is not None and np.array_equal(image.right, picture(number, 1))
    assert "10 left and 9 right images, the 9 pairs are used" in caplog.text
    assert describe_dataset(tmp_path).skew_ms == pytest.approx(1.5)


@pytest.mark.parametrize("folder", [make_euroc, None], ids=["euroc", "images"])
def test_cameras_that_are_never_exposed_together_are_refused_with_their_skew(
    folder: Callable[[Path], Path] | None, tmp_path: Path
) -> None:
    if folder is None:
        skewed_stereo(tmp_path, 12_000_000)
    else:
        listing = folder(tmp_path) / "mav0" / "cam1" / "data.csv"
        rows = [line.split(",") for line in listing.read_text().splitlines()[1:]]
        listing.write_text("".join(f"{int(stamp) + 12_000_000},{name}\n" for stamp, name in rows))
    with pytest.raises(StereoSfmError, match="stamps of left and right images differ by 12 ms"):
        open_source(tmp_path)


@pytest.mark.parametrize(
    ("left", "right"), [("left{:02d}", "right{:02d}"), ("{:02d}_cam0", "{:02d}_cam1"), ("im-{}-L2", "im-{}-R1")]
)
def test_numbered_images_are_paired_by_number_and_keep_their_times(left: str, right: str, tmp_path: Path) -> None:
    make_images(tmp_path)
    for side, name in (("left", left), ("right", right)):
        for i in range(12):
            (tmp_path / side / f"{i}.png").rename(tmp_path / side / f"{name.format(i)}.png")
    (tmp_path / "right" / f"{right.format(5)}.png").unlink()
    with open_source(tmp_path, fps=10) as source:
        images = list(source)
    kept = [i for i in range(12) if i != 5]
    assert [i.stamp_ns for i in images] == [i * 10**8 for i in kept]
    for image, number in zip(images, kept, strict=True):
        assert image.right is not None and np.array_equal(image.right, picture(number, 1))
    assert math.isnan(describe_dataset(tmp_path).skew_ms)  # nobody knows it


@pytest.mark.parametrize(
    ("names", "stamps"),
    [
        (["1403636579763555584", "1403636579813555584"], [1403636579763555584, 1403636579813555584]),
        (["1403636579763555584", "1403636599763555584"], [1403636579763555584, 1403636599763555584]),  # every 20 s
        (["left_1305031102.175304", "left_1305031102.211214"], [1305031102175304000, 1305031102211214000]),
        (["1305031102", "1305031107"], [1305031102 * 10**9, 1305031107 * 10**9]),
        (["1305031102175", "1305031102208"], [1305031102175 * 10**6, 1305031102208 * 10**6]),
        (["1305031102175304"], [1305031102175304 * 10**3]),
        (["2966666667", "3000000000", "3033333333"], [2966666667, 3000000000, 3033333333]),  # ns since the start
        (["98000033333", "98000066666"], [98000033333000, 98000066666000]),  # us since the start
        (["cam0_1305031102175304", "cam0_1305031102208304"], [1305031102175304000, 1305031102208304000]),
        (["7_1305031102175", "8_1305031102208_rect0"], None),  # names of two forms
        (["frame_7_1305031102175", "frame_8_1305031102208"], [1305031102175 * 10**6, 1305031102208 * 10**6]),
        (["20240102101112", "20240102101113"], None),  # a date, as seconds it would be after the end of all clocks
        (["000001", "000002"], None),
        (["0000000001", "0000000002"], None),
        (["12", "13"], None),
        (["20240101_000001", "20240101_000002"], None),
        (["a", "b"], None),
    ],
)
def test_names_that_are_times(names: list[str], stamps: list[int] | None) -> None:
    assert stamps_of([Path(f"{name}.png") for name in names]) == stamps


def test_the_unit_of_one_camera_is_that_of_the_other() -> None:
    left = [Path(f"{2000000000 + i * 33333333}.png") for i in range(5)]
    assert stamps_of([Path("2000001000.png")], left) == [2000001000]


def test_info_takes_what_run_takes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make_images(tmp_path)
    assert main(["info", f"images:{tmp_path}?fps=10"]) == 0
    assert "at 10.00 Hz" in capsys.readouterr().out


def test_info_sees_images_without_light(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make_images(tmp_path)
    for path in (tmp_path / "left").iterdir():
        pixels = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert pixels is not None
        cv2.imwrite(str(path), np.zeros_like(pixels))
    assert main(["info", f"{tmp_path}?fps=10"]) == 0
    out = capsys.readouterr().out
    assert "problem: 9 of 9 sampled frames have no pixel brighter than 30 grey levels" in out
    assert "no problems found" not in out


def test_info_names_the_missing_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", f"images:{tmp_path / 'nix'}"]) == 2
    assert capsys.readouterr().err.strip().endswith(f"no such file or folder: {tmp_path / 'nix'}")


def test_ambiguous_names_are_rejected(tmp_path: Path) -> None:
    make_images(tmp_path, ["a.png", "b.png", "c.png"])
    for name in "abc":
        (tmp_path / "right" / f"{name}.png").rename(tmp_path / "right" / f"r{name}.png")
    with pytest.raises(
        StereoSfmError, match=r"cannot pair the left images \(a.png, ...\) with the right images \(ra.png"
    ):
        open_source(tmp_path)


@pytest.mark.parametrize("first", [0, 1])
def test_times_belong_to_images_by_number_where_one_is_missing(first: int, tmp_path: Path) -> None:
    make_images(tmp_path, [f"{i + first}.png" for i in range(6)])
    (tmp_path / "left" / f"{3}.png").unlink()
    (tmp_path / "times.txt").write_text("".join(f"{i / 10}\n" for i in range(6)))
    with open_source(tmp_path) as source:
        assert [i.stamp_ns for i in source] == [k * 10**8 for k in range(6) if k != 3 - first]


def test_times_that_fit_no_image_are_refused(tmp_path: Path) -> None:
    make_images(tmp_path, [f"{i}.png" for i in (3, 4, 5)])
    (tmp_path / "times.txt").write_text("0\n1\n2\n3\n")
    with pytest.raises(StereoSfmError, match=r"3 images but 4 lines in times.txt, and the numbers"):
        open_source(tmp_path)


def test_a_folder_of_something_else(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("milk\n")
    with pytest.raises(StereoSfmError, match="not a known kind of dataset") as error:
        recognise(tmp_path)
    assert "\n" not in str(error.value)


def test_unreadable_images_are_dropped_and_counted(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    root = make_kitti(tmp_path, frames=6)
    sequence = root / "sequences" / "00"
    (sequence / "image_0" / "000002.png").write_bytes(b"not a image")
    (sequence / "image_1" / "000003.png").write_bytes(b"")
    with caplog.at_level(logging.WARNING, "stereo_sfm"), open_source(root) as source:
        images = list(source)
    assert [(i.frame_id, i.dropped_before) for i in images] == [(0, 0), (1, 0), (4, 2), (5, 0)]
    assert len([r for r in caplog.records if "cannot read" in r.getMessage()]) == 2


def test_many_unreadable_images_do_not_flood_the_terminal(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    root = make_images(tmp_path)
    for i in range(1, 12):
        (root / "left" / f"{i}.png").unlink()
        (root / "left" / f"{i}.png").write_bytes(b"x")
    with caplog.at_level(logging.WARNING, "stereo_sfm"), open_source(root, fps=30.0) as source:
        assert len(list(source)) == 1
    assert len(caplog.records) == 6 and "11 frames could not be read" in caplog.text


def test_only_unreadable_images_are_an_error(tmp_path: Path) -> None:
    root = make_kitti(tmp_path)
    for path in (root / "sequences" / "00" / "image_1").iterdir():
        path.write_bytes(b"x")
    with open_source(root) as source, pytest.raises(StereoSfmError, match="none of the 4 images"):
        list(source)


def test_a_size_that_contradicts_the_calibration_is_an_error_before_the_first_frame(tmp_path: Path) -> None:
    root = make_images(tmp_path)
    rig = root / "rig.yaml"
    rig.write_text(rig.read_text().replace("[64, 48]", "[640, 480]"))
    with pytest.raises(StereoSfmError, match="is 64x48 but the calibration is for 640x480"):
        open_source(root)


def test_another_rig_keeps_the_body_of_the_data_set(tmp_path: Path) -> None:
    root = make_euroc(tmp_path / "euroc")
    other = make_images(tmp_path / "other") / "rig.yaml"
    with open_source(root, rig=other) as source:
        assert source.rig.left.model == "pinhole"
        assert source.ground_truth is not None and source.ground_truth.positions[2] == pytest.approx([2, 1, 3])


def test_part_of_a_source(tmp_path: Path) -> None:
    root = make_images(tmp_path)
    (root / "left" / "4.png").write_bytes(b"x")

    def part(**options: float) -> list[tuple[int, int]]:
        with SelectedFrames(open_source(root, fps=10), **options) as source:
            return [(i.frame_id, i.dropped_before) for i in source]

    assert part(start_s=0.2, duration_s=0.5) == [(2, 0), (3, 0), (5, 1), (6, 0)]
    assert part(frame_skip=3) == [(0, 0), (3, 0), (7, 1), (10, 0)]
    assert part(max_frames=2) == [(0, 0), (1, 0)]
    with pytest.raises(StereoSfmError, match="at least 1"):
        part(frame_skip=0)
    with pytest.raises(StereoSfmError, match=r"no frames selected .* from 1000 s on, the last one read is at 1\.10 s"):
        part(start_s=1000)
    with pytest.raises(StereoSfmError, match=r"from 0\.32 s on until 0\.33 s"):
        part(start_s=0.32, duration_s=0.01)


def test_a_part_of_a_source_has_the_right_frame_count(tmp_path: Path) -> None:
    source = open_source(make_images(tmp_path))
    assert SelectedFrames(source, frame_skip=5).frame_count == 3
    assert SelectedFrames(source, max_frames=5).frame_count == 5
    assert SelectedFrames(source, start_s=1).frame_count is None


def test_pairs_take_the_smallest_difference_first() -> None:
    # 10 is nearest to 11, so 7 must take the next one within reach, or nothing.
    assert pair_by_stamp([7, 10], [11, 4], 5) == [(0, 1), (1, 0)]
    assert pair_by_stamp([7, 10], [11], 5) == [(1, 0)]
    assert pair_by_stamp([], [1], 5) == []


@pytest.mark.parametrize("side", [0, 1])
def test_a_missing_kitti_image_leaves_the_stamps_of_the_others(
    side: int, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    root = make_kitti(tmp_path, frames=6)
    (root / "sequences" / "00" / f"image_{side}" / "000002.png").unlink()
    with caplog.at_level(logging.WARNING, "stereo_sfm"), open_source(root) as source:
        stamps = [image.stamp_ns for image in source]
        truth = source.ground_truth
    assert stamps == [k * 100_000_000 for k in (0, 1, 3, 4, 5)]
    assert truth is not None and len(truth) == 6
    assert "5 pairs are used" in caplog.text


def test_ground_truth_that_is_not_finite_is_refused(tmp_path: Path) -> None:
    root = make_kitti(tmp_path)
    (root / "poses" / "00.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 nan 0 1 0 0 0 0 1 0\n")
    with pytest.raises(StereoSfmError, match="pose 1 is not finite"):
        open_source(root)


@pytest.mark.parametrize(("text", "message"), [("nan", "not a time"), ("1e99", "too large"), ("x", "not a time")])
def test_invalid_times_are_rejected(text: str, message: str, tmp_path: Path) -> None:
    root = make_kitti(tmp_path)
    (root / "sequences" / "00" / "times.txt").write_text(f"0\n{text}\n0.2\n0.3\n")
    with pytest.raises(StereoSfmError, match=message):
        open_source(root)


def test_a_byte_order_mark_is_skipped(tmp_path: Path) -> None:
    root = make_kitti(tmp_path)
    times = root / "sequences" / "00" / "times.txt"
    times.write_text("\ufeff" + times.read_text(), encoding="utf-8")
    with open_source(root) as source:
        assert len(list(source)) == 4


def test_text_in_another_encoding_is_refused_in_a_line(tmp_path: Path) -> None:
    root = make_kitti(tmp_path)
    for file in (root / "sequences" / "00" / "times.txt", make_images(tmp_path / "images", ["a.png"]) / "times.txt"):
        text = file.read_text() if file.exists() else "0.0\n"
        file.write_text(text, encoding="utf-16")
        with pytest.raises(StereoSfmError, match=r"times\.txt is not text in UTF-8"):
            open_source(root if "sequences" in file.parts else file.parent)


@pytest.mark.parametrize(("start", "duration"), [(math.nan, 1.0), (math.inf, 1.0), (1e300, 1.0), (0.0, math.nan)])
def test_a_part_that_cannot_be_is_refused(start: float, duration: float, tmp_path: Path) -> None:
    with open_source(make_kitti(tmp_path)) as source, pytest.raises(StereoSfmError, match="part of a source"):
        SelectedFrames(source, start, duration)


def test_an_assumed_frame_rate_is_reported(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    make_images(tmp_path)
    for side in ("left", "right"):
        for k, path in enumerate(sorted((tmp_path / side).iterdir())):
            path.rename(path.with_name(f"frame_{k:03d}{path.suffix}"))
    (tmp_path / "times.txt").unlink(missing_ok=True)
    problems = describe_dataset(f"images:{tmp_path}").problems
    assert any("30 a second are assumed (?fps=N, a times.txt" in problem for problem in problems)
    caplog.clear()
    with caplog.at_level(logging.WARNING, "stereo_sfm"):  # shown without -v
        next(iter(open_source(f"images:{tmp_path}")))
        assert "30 images a second assumed (?fps=N)" in caplog.text
        caplog.clear()
        source = open_source(f"images:{tmp_path}?fps=10")
    assert not caplog.text
    stamps = [image.stamp_ns for image in source]
    assert stamps[1] - stamps[0] == 100_000_000
