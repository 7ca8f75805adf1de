"""Small data sets on disk for the tests of the drivers: a textured pair of images in each layout."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from stereo_sfm.types import U8

WIDTH, HEIGHT = 64, 48
FRAMES = 4
PERIOD_NS = 50_000_000
START_NS = 1_403_636_579_763_555_584


def picture(frame: int, side: int) -> U8:
    """(HEIGHT, WIDTH) noise, different for each frame and camera."""
    rng = np.random.default_rng([frame, side])
    return rng.integers(0, 256, (HEIGHT, WIDTH), dtype=np.uint8)


def write_images(folder: Path, side: int, names: list[str]) -> None:
    """One image for each name."""
    folder.mkdir(parents=True)
    for i, name in enumerate(names):
        cv2.imwrite(str(folder / name), picture(i, side))


def make_kitti(root: Path, frames: int = FRAMES) -> Path:
    """Data set root with sequence 00; the camera moves 1 m forward a frame."""
    sequence = root / "sequences" / "00"
    for side in (0, 1):
        write_images(sequence / f"image_{side}", side, [f"{i:06d}.png" for i in range(frames)])
    (sequence / "calib.txt").write_text("P0: 50 0 32 0 0 50 24 0 0 0 1 0\nP1: 50 0 32 -25 0 50 24 0 0 0 1 0\n")
    (sequence / "times.txt").write_text("".join(f"{i * 0.1:.6e}\n" for i in range(frames)))
    (root / "poses").mkdir()
    (root / "poses" / "00.txt").write_text("".join(f"1 0 0 0 0 1 0 0 0 0 1 {i}\n" for i in range(frames)))
    return root


def make_euroc(root: Path, frames: int = FRAMES) -> Path:
    """EuRoC folder whose body is 1 m above the camera and faces backwards."""
    stamps = [START_NS + i * PERIOD_NS for i in range(frames)]
    for side in (0, 1):
        camera = root / "mav0" / f"cam{side}"
        write_images(camera / "data", side, [f"{s}.png" for s in stamps])
        (camera / "data.csv").write_text("#timestamp [ns],filename\n" + "".join(f"{s},{s}.png\n" for s in stamps))
        (camera / "sensor.yaml").write_text(
            f"T_BS: {{cols: 4, rows: 4, data: [-1, 0, 0, {-0.1 * side}, 0, 1, 0, -1, 0, 0, -1, 0, 0, 0, 0, 1]}}\n"
            f"resolution: [{WIDTH}, {HEIGHT}]\ncamera_model: pinhole\nintrinsics: [50, 50, 32, 24]\n"
            "distortion_model: radial-tangential\ndistortion_coefficients: [-0.1, 0.01, 0, 0]\n"
        )
    truth = root / "mav0" / "state_groundtruth_estimate0"
    truth.mkdir()
    rows = [f"{s},{i},2,3,1,0,0,0,9,9,9" for i, s in enumerate(stamps)]
    (truth / "data.csv").write_text("#timestamp, p_RS_R_x [m], ...\n" + "\n".join(rows) + "\n")
    return root


RIG = f"""stereo_sfm_rig: 1
depth: false
left: {{model: pinhole, size: [{WIDTH}, {HEIGHT}], focal: [50, 50], centre: [32, 24], distortion: []}}
right: {{model: pinhole, size: [{WIDTH}, {HEIGHT}], focal: [50, 50], centre: [32, 24], distortion: []}}
left_T_right: [[1, 0, 0, 0.1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
body_T_left: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
"""


def make_images(root: Path, names: list[str] | None = None) -> Path:
    """left/ and right/ with rig.yaml."""
    names = names or [f"{i}.png" for i in range(12)]
    for index, side in enumerate(("left", "right")):
        write_images(root / side, index, names)
    (root / "rig.yaml").write_text(RIG)
    return root


def make_tum_rgbd(root: Path) -> Path:
    """rgbd_dataset_freiburg1_*: two frames at 640x480, the second depth image too late for its colour image."""
    folder = root / "rgbd_dataset_freiburg1_test"
    for name in ("rgb", "depth"):
        (folder / name).mkdir(parents=True)
    colour = np.zeros((480, 640, 3), np.uint8)
    colour[:] = 10, 20, 200
    depth = np.full((480, 640), 7500, np.uint16)
    depth[0, 0] = 0
    for i in range(3):
        cv2.imwrite(str(folder / "rgb" / f"{i}.png"), colour)
        cv2.imwrite(str(folder / "depth" / f"{i}.png"), depth)
    (folder / "rgb.txt").write_text("# c\n" + "".join(f"{100 + i / 10:.6f} rgb/{i}.png\n" for i in range(3)))
    shifts = (0.004, 0.05, -0.003)
    (folder / "depth.txt").write_text("".join(f"{100 + i / 10 + s:.6f} depth/{i}.png\n" for i, s in enumerate(shifts)))
    (folder / "groundtruth.txt").write_text("# t\n100.0 0 0 0 0 0 0 1\n100.3 0 0 1 0 0 0 1\n")
    return folder


def make_kapture(root: Path) -> Path:
    """Full kapture layout: the right camera 0.2 m to the right, both 1 m in front of the rig's origin."""
    sensors = root / "sensors"
    sensors.mkdir(parents=True)
    camera = f"camera, PINHOLE, {WIDTH}, {HEIGHT}, 50, 50, 32, 24"
    (sensors / "sensors.txt").write_text(f"# kapture format: 1.1\na, , {camera}\nb, , {camera}\n")
    (sensors / "rigs.txt").write_text("# r\nrig, a, 1, 0, 0, 0, 0, 0, -1\nrig, b, 1, 0, 0, 0, -0.2, 0, -1\n")
    lines = ["# timestamp, device_id, image_path"]
    for side, name in enumerate("ab"):
        write_images(sensors / "records_data" / name, side, [f"{i}.png" for i in range(FRAMES)])
        lines += [f"{START_NS + i * PERIOD_NS}, {name}, {name}/{i}.png" for i in range(FRAMES)]
    (sensors / "records_camera.txt").write_text("\n".join(lines) + "\n")
    return root


def make_kitti_raw(root: Path) -> Path:
    """A date with one drive that moves 1 m east per frame, heading east."""
    drive = root / "2011_09_26_drive_0001_sync"
    for side in (0, 1):
        write_images(drive / f"image_0{side}" / "data", side, [f"{i:010d}.png" for i in range(FRAMES)])
        (drive / f"image_0{side}" / "timestamps.txt").write_text(
            "".join(f"2011-09-26 13:02:25.{i}00000001\n" for i in range(FRAMES))
        )
    (root / "calib_cam_to_cam.txt").write_text(
        "calib_time: 09-Jan-2012 13:57:47\n"
        f"S_rect_00: {WIDTH} {HEIGHT}\nR_rect_00: 1 0 0 0 1 0 0 0 1\nP_rect_00: 50 0 32 0 0 50 24 0 0 0 1 0\n"
        f"S_rect_01: {WIDTH} {HEIGHT}\nP_rect_01: 50 0 32 -25 0 50 24 0 0 0 1 0\n"
    )
    (root / "calib_imu_to_velo.txt").write_text("calib_time: x\nR: 1 0 0 0 1 0 0 0 1\nT: 0 0 0\n")
    # The camera looks along the IMU's x axis: x right is -y, y down is -z.
    (root / "calib_velo_to_cam.txt").write_text("R: 0 -1 0 0 0 -1 1 0 0\nT: 0 0 0\n")
    oxts = drive / "oxts" / "data"
    oxts.mkdir(parents=True)
    metre = 180 / np.pi / 6378137.0 / np.cos(np.radians(49.0))
    for i in range(FRAMES):
        (oxts / f"{i:010d}.txt").write_text(f"49.0 {8.4 + i * metre:.12f} 100 0 0 0 " + "0 " * 24 + "\n")
    return root
