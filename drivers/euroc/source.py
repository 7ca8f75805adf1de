"""EuRoC/ASL folders (`mav0/cam0/data.csv`, `sensor.yaml`) and TUM VI (the same layout with a Kalibr camchain).

EuRoC: Burri et al., IJRR 2016; `state_groundtruth_estimate0` has poses of the body (the IMU), `T_BS` those of the
cameras.
TUM VI: Schubert et al., IROS 2018; `mocap0` holds the IMU's poses, Kalibr's `T_cam_imu` is the inverse of `T_BS`, and
sixteen-bit images carry the sensor's twelve bits in their upper part.
"""

from __future__ import annotations

import csv
import logging
from dataclasses import replace
from pathlib import Path

from stereo_sfm.calib.formats.euroc import read_euroc as read_rig
from stereo_sfm.calib.formats.kalibr import read_kalibr
from stereo_sfm.calib.rig import Rig
from stereo_sfm.drivers.folder_source import FolderSource, FrameFiles, by_stamp, folder_of, need
from stereo_sfm.drivers.ground_truth import moved, of_body, read_euroc
from stereo_sfm.drivers.image_lists import Listing, pair_listings
from stereo_sfm.drivers.imu_table import read_imu_samples
from stereo_sfm.drivers.options import SourceOptions
from stereo_sfm.drivers.rig_option import chosen_rig
from stereo_sfm.drivers.text_file import read_text, stamp_ns
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.types import ImuSamples, Trajectory

log = logging.getLogger("stereo_sfm")

TRUTH_FOLDERS = ("state_groundtruth_estimate0", "mocap0", "vicon0")


def open_euroc(path: str, options: SourceOptions) -> FolderSource:
    """Open an ASL folder: the one that holds `mav0`, or `mav0` itself."""
    mav = _mav_folder(folder_of("euroc", path))
    return _open(f"euroc:{_label(mav)}", mav, chosen_rig(options.rig, lambda: _own_rig(mav)))


def open_tum_vi(path: str, options: SourceOptions) -> FolderSource:
    """Open a TUM VI folder: `mav0` next to `camchain.yaml` (or `dso/camchain.yaml`)."""
    mav = _mav_folder(folder_of("tum_vi", path))
    chains = [mav.parent / "camchain.yaml", mav.parent / "dso" / "camchain.yaml"]
    chain = next((c for c in chains if c.is_file()), chains[0])
    return _open(f"tum_vi:{_label(mav)}", mav, chosen_rig(options.rig, lambda: read_kalibr(chain)))


def _own_rig(mav: Path) -> Rig:
    rig = read_rig(mav)
    if not rig.stereo and (mav / "cam1" / "data.csv").is_file():
        raise StereoSfmError(f"no {mav / 'cam1' / 'sensor.yaml'}: give a calibration of both cameras by --rig FILE")
    return rig


def _label(mav: Path) -> str:
    mav = mav.resolve()
    return mav.parent.name if mav.name == "mav0" else mav.name


def _mav_folder(folder: Path) -> Path:
    for mav in (folder / "mav0", folder):
        if (mav / "cam0").is_dir():
            return mav
    raise StereoSfmError(f"{folder} has no mav0/cam0 folder: name the folder that holds mav0")


def _open(name: str, mav: Path, rig: Rig) -> FolderSource:
    left = _read_listing(mav / "cam0")
    exposures = _read_exposures(mav / "cam0" / "times.txt")
    frames = [FrameFiles(stamp, file, exposure_us=exposures.get(file.stem, float("nan"))) for stamp, file in left]
    if rig.stereo:
        right = _read_listing(need(mav / "cam1", "second camera"))
        pairs = pair_listings(name, left, right)
        frames = [replace(frames[i], right=right[j][1], right_stamp_ns=right[j][0]) for i, j in pairs]
    return FolderSource(name, rig, by_stamp(frames), _ground_truth(mav, rig), imu=_inertial(mav))


def _read_listing(camera: Path) -> Listing:
    """(stamp_ns, file) of every line of data.csv."""
    path = need(camera / "data.csv", "image list")
    images: Listing = []
    for number, row in enumerate(csv.reader(read_text(path).splitlines()), 1):
        if not row or row[0].lstrip().startswith("#"):
            continue
        try:
            images.append((stamp_ns(row[0]), camera / "data" / row[1].strip()))
        except (ValueError, IndexError):
            raise StereoSfmError(f"{path} line {number} is not 'stamp_ns,file'") from None
    return images


def _inertial(mav: Path) -> ImuSamples | None:
    """`imu0/data.csv`: stamp_ns, angular velocity (rad/s), specific force (m/s^2)."""
    path = mav / "imu0" / "data.csv"
    return read_imu_samples(path) if path.is_file() else None


def _read_exposures(path: Path) -> dict[str, float]:
    """TUM VI: file stem -> exposure time in microseconds."""
    if not path.is_file():
        return {}
    rows = [line.split() for line in read_text(path).splitlines() if not line.startswith("#")]
    try:
        return {row[0]: float(row[2]) * 1e3 for row in rows if len(row) >= 3}
    except ValueError as error:
        raise StereoSfmError(f"{path}: {error}") from None


def _ground_truth(mav: Path, rig: Rig) -> Trajectory | None:
    """world_T_cam0 from the poses of the body."""
    path = next((p for p in (mav / f / "data.csv" for f in TRUTH_FOLDERS) if p.is_file()), None)
    if path is None:
        return None
    poses = read_euroc(path)
    try:
        poses = of_body(path, poses)
    except StereoSfmError as error:
        log.warning("%s: its poses are taken for those of the body", error)
    return moved(poses, rig.body_T_left)
