"""KITTI raw data: `DATE_drive_NNNN_sync/image_00/data`, calibration files of the date, poses from `oxts` (GPS/IMU).

Geiger et al., IJRR 2013. The oxts packets become poses as in the raw data's development kit: a Mercator projection
scaled at the first latitude, and rotation Rz(yaw) Ry(pitch) Rx(roll). Their rates and forces (x ahead, y left, z up)
are inertial samples: a hundred a second in `DATE_drive_NNNN_extract` beside the drive, else one for each image.
"""

from __future__ import annotations

import logging
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from stereo_sfm.calib.formats.kitti import read_kitti as read_rig
from stereo_sfm.calib.imu import Imu
from stereo_sfm.drivers.folder_source import FolderSource, FrameFiles, folder_of, need
from stereo_sfm.drivers.ground_truth import moved
from stereo_sfm.drivers.image_lists import lines_of, list_images, pair_files
from stereo_sfm.drivers.rig_option import chosen_rig
from stereo_sfm.drivers.text_file import read_text
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.input_file import visible
from stereo_sfm.types import F64, I64, ImuSamples, Trajectory

if TYPE_CHECKING:
    from stereo_sfm.drivers.kitti_raw import KittiRawOptions

log = logging.getLogger("stereo_sfm")

EARTH_RADIUS = 6378137.0  # metres, as the development kit
CALIBRATION = "calib_cam_to_cam.txt"
FORCE, RATE = slice(11, 14), slice(17, 20)  # of a packet's numbers: ax ay az, wx wy wz


def open_kitti_raw(path: str, options: KittiRawOptions) -> FolderSource:
    """Open one drive (synchronised and rectified).

    Args:
        path: the drive's folder, or the date's folder that holds it.
        options: which drive, and the calibration.
    """
    folder = _drive_folder(folder_of("kitti_raw", path), options.drive)
    name = f"kitti_raw:{folder.resolve().name}"
    sides = next((e for e in ((0, 1), (2, 3)) if (folder / f"image_0{e[0]}" / "data").is_dir()), None)
    if sides is None:
        raise StereoSfmError(f"{folder} has neither image_00/data nor image_02/data")
    date = next((p for p in (folder, folder.resolve().parent) if (p / CALIBRATION).is_file()), folder.resolve().parent)
    own = chosen_rig(options.rig, lambda: read_rig(need(date / CALIBRATION, "KITTI raw calibration"), pair=sides))
    lefts, rights = (list_images(folder / f"image_0{i}" / "data") for i in sides)
    files = [folder / f"image_0{i}" / "timestamps.txt" for i in sides]
    stamps = _read_times(need(files[0], "time stamps"))
    others = _read_times(files[1]) if files[1].is_file() else []
    line = lines_of(name, lefts, len(stamps), "timestamps.txt", first=0)
    frames = [
        FrameFiles(
            stamps[line[left]], left, right, right_stamp_ns=others[line[left]] if len(others) == len(stamps) else 0
        )
        for left, right in pair_files(name, lefts, rights)
        if left in line
    ]
    imu_T_left = _imu_T_left(date, own.body_T_left)
    truth = None if imu_T_left is None else _ground_truth(folder, stamps, imu_T_left)
    samples = _inertial(folder)
    if imu_T_left is None or samples is None:
        return FolderSource(name, own, frames, truth)
    rate = 1e9 / float(np.median(np.diff(samples.stamp_ns)))
    imu = own.imu or Imu(left_T_imu=se3.inverse(imu_T_left), rate_hz=rate)
    return FolderSource(name, replace(own, imu=imu), frames, truth, imu=samples)


def _drive_folder(folder: Path, drive: str) -> Path:
    if any((folder / f"image_0{i}").is_dir() for i in (0, 2)):
        return folder
    found = sorted(p for p in visible(folder, "*_drive_*") if drive in p.name and p.is_dir())
    if len(found) != 1:
        names = ", ".join(p.name for p in found) or "none"
        raise StereoSfmError(f"{folder} must contain one KITTI raw drive, found {names}: give the folder of the drive")
    return found[0]


def _read_times(path: Path) -> list[int]:
    """Nanoseconds from lines such as 2011-09-26 13:02:25.964389445."""
    stamps: list[int] = []
    for line in read_text(path).splitlines():
        if not line.strip():
            continue
        whole, _, fraction = line.strip().partition(".")
        try:
            seconds = datetime.strptime(whole, "%Y-%m-%d %H:%M:%S").replace(tzinfo=UTC).timestamp()
            stamps.append(int(seconds) * 10**9 + int(fraction[:9].ljust(9, "0")))
        except ValueError:
            raise StereoSfmError(f"{path}: '{line.strip()}' is not a time stamp") from None
    return stamps


def _imu_T_left(date: Path, cam0_T_left: F64) -> F64 | None:
    """(4, 4), or None without the calibration of the oxts."""
    files = [date / "calib_imu_to_velo.txt", date / "calib_velo_to_cam.txt", date / CALIBRATION]
    if not all(f.is_file() for f in files):
        return None
    entries = _read_entries(files[2])
    if "R_rect_00" not in entries:
        raise StereoSfmError(f"{files[2]} has no R_rect_00")
    velo_T_imu, cam_T_velo = (_read_rigid(f) for f in files[:2])
    rectified_T_cam = np.eye(4)
    rectified_T_cam[:3, :3] = entries["R_rect_00"].reshape(3, 3)
    return se3.inverse(rectified_T_cam @ cam_T_velo @ velo_T_imu) @ cam0_T_left


def _ground_truth(folder: Path, stamps: list[int], imu_T_left: F64) -> Trajectory | None:
    """world_T_left with the first IMU pose as the world, or None without oxts."""
    packets, times = _packets(folder), folder / "oxts" / "timestamps.txt"
    if len(packets) != len(stamps) and times.is_file():  # of a drive that is not synchronised: ten for each image
        stamps = _read_times(times)
    count = min(len(packets), len(stamps))
    if not count:
        return None
    at, first = np.unique(np.array(stamps[:count], np.int64), return_index=True)
    return moved(Trajectory(at, poses_from_oxts(packets[:count, :6])[first]), imu_T_left)


def _inertial(folder: Path) -> ImuSamples | None:
    """None without oxts and their stamps."""
    folder = folder.absolute()  # "." has no name
    everything = folder.with_name(folder.name.removesuffix("_sync") + "_extract")
    place = everything if (everything / "oxts" / "timestamps.txt").is_file() else folder
    times = place / "oxts" / "timestamps.txt"
    packets = _packets(place) if times.is_file() else np.zeros((0, 0))
    if len(packets) < 2 or packets.shape[1] < RATE.stop:
        return None
    stamp_ns: I64 = np.array(_read_times(times), np.int64)
    if len(stamp_ns) != len(packets):
        raise StereoSfmError(f"{times}: {len(stamp_ns)} time stamps for {len(packets)} packets")
    order = np.argsort(stamp_ns, kind="stable")
    packets = packets[order]
    return ImuSamples(stamp_ns[order], packets[:, RATE].copy(), packets[:, FORCE].copy())


def _packets(folder: Path) -> F64:
    """(N, K) numbers of the oxts; (0, 0) without them."""
    files = sorted(visible(folder / "oxts" / "data", "*.txt"))
    if not files:
        return np.zeros((0, 0))
    try:
        return np.array([read_text(p).split() for p in files], float)
    except ValueError as error:
        raise StereoSfmError(f"{folder / 'oxts'}: {error}") from None


def poses_from_oxts(packets: F64) -> F64:
    """(N, 6) latitude, longitude (degrees), altitude, roll, pitch, yaw -> (N, 4, 4) first_T_imu."""
    latitude, longitude, altitude, roll, pitch, yaw = packets.T
    scale = np.cos(np.radians(latitude[0]))
    east = scale * EARTH_RADIUS * np.radians(longitude)
    north = scale * EARTH_RADIUS * np.log(np.tan(np.pi / 4 + np.radians(latitude) / 2))
    zero = np.zeros_like(roll)
    rotation = (
        se3.so3_exp(np.stack([zero, zero, yaw], 1))
        @ se3.so3_exp(np.stack([zero, pitch, zero], 1))
        @ se3.so3_exp(np.stack([roll, zero, zero], 1))
    )
    poses = se3.from_rotation_translation(rotation, np.stack([east, north, altitude], 1))
    return se3.inverse(poses[0]) @ poses


def _read_entries(path: Path) -> dict[str, F64]:
    """`KEY: numbers` lines."""
    entries: dict[str, F64] = {}
    for line in read_text(path).splitlines():
        key, _, values = line.partition(":")
        try:
            entries[key.strip()] = np.array(values.split(), float)
        except ValueError:
            continue  # dates
    return entries


def _read_rigid(path: Path) -> F64:
    """`R: nine numbers`, `T: three numbers` -> (4, 4)."""
    entries = _read_entries(path)
    try:
        return se3.from_rotation_translation(entries["R"].reshape(3, 3), entries["T"])
    except (KeyError, ValueError):
        raise StereoSfmError(f"{path} must contain R (nine numbers) and T (three)") from None
