"""kapture folders: the T265 samples (`kapture_sensors.txt`, fisheye1/, fisheye2/) and the full layout (`sensors/`).

Format: github.com/naver/kapture, version 1.1.
"""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from stereo_sfm.calib.camera_rotation import align_cameras
from stereo_sfm.calib.formats.kapture import read_kapture, read_kapture_cameras
from stereo_sfm.calib.rig import Rig
from stereo_sfm.drivers.folder_source import FolderSource, FrameFiles, by_stamp, folder_of, need
from stereo_sfm.drivers.image_lists import Listing, list_images, pair_listings
from stereo_sfm.drivers.options import SourceOptions
from stereo_sfm.drivers.rig_option import chosen_rig
from stereo_sfm.drivers.select import SelectedFrames
from stereo_sfm.drivers.text_file import read_text
from stereo_sfm.errors import StereoSfmError

log = logging.getLogger("stereo_sfm")

T265_BASELINE = 0.064  # metres, nominal baseline of a T265
T265_SIZE = (848, 800)
ALIGNED_PAIRS = 5  # images for estimating a missing rotation between the cameras


def open_kapture(path: str, options: SourceOptions) -> FolderSource:
    """Open the first two cameras of a kapture folder.

    A T265 sample has no extrinsics: the nominal baseline is assumed, and the rotation of the right camera is estimated
    from the images.
    """
    folder = folder_of("kapture", path)
    name = f"kapture:{folder.resolve().name}"
    left, right = _listings(folder)
    pairs = pair_listings(name, left, right)
    frames = by_stamp(FrameFiles(left[i][0], left[i][1], right[j][1], right_stamp_ns=right[j][0]) for i, j in pairs)
    guessed = not options.rig and not _sensors(folder).with_name("rigs.txt").is_file()
    source = FolderSource(name, chosen_rig(options.rig, lambda: _read_rig(folder)), frames)
    if guessed:
        source.rig = _turned(name, source)
    return source


def _turned(name: str, source: FolderSource) -> Rig:
    """The nominal rig with the rotation of the right camera estimated from the images."""
    step = max(len(source.frames) // ALIGNED_PAIRS, 1)
    found = align_cameras(source.rig, SelectedFrames(source, frame_skip=step, max_frames=ALIGNED_PAIRS))
    if found is None:
        log.warning(
            "%s: no extrinsics: assuming parallel cameras with the nominal baseline of %g m", name, T265_BASELINE
        )
        return source.rig
    log.warning(
        "%s: no extrinsics: assuming a baseline of %g m, right camera rotated to fit %d matches to %.1f px "
        "(parallel: %.1f px)",
        name,
        T265_BASELINE,
        found.matches,
        found.after_px,
        found.before_px,
    )
    return found.rig


def _sensors(folder: Path) -> Path:
    sample = folder / "kapture_sensors.txt"
    return sample if sample.is_file() else need(folder / "sensors" / "sensors.txt", "kapture sensors")


def _read_rig(folder: Path) -> Rig:
    sensors = _sensors(folder)
    if sensors.with_name("rigs.txt").is_file():
        return read_kapture(sensors)
    cameras = list(read_kapture_cameras(sensors).values())
    if len(cameras) < 2 or any(c.size != T265_SIZE or c.model != "kannala_brandt" for c in cameras[:2]):
        raise StereoSfmError(f"{folder} has no extrinsics of two cameras (rigs.txt): give --rig FILE")
    left_T_right = np.eye(4)
    left_T_right[0, 3] = T265_BASELINE
    return read_kapture(sensors, left_T_right)


def _listings(folder: Path) -> tuple[Listing, Listing]:
    """(stamp_ns, file) of both cameras."""
    records = folder / "sensors" / "records_camera.txt"
    if not records.is_file():
        left, right = ([(_stamp(p.stem), p) for p in list_images(folder / f"fisheye{i}")] for i in (1, 2))
        return left, right
    cameras: dict[str, Listing] = {i: [] for i in list(read_kapture_cameras(_sensors(folder)))[:2]}
    if len(cameras) < 2:
        raise StereoSfmError(f"{folder} has one camera, two are needed")
    for line in read_text(records).splitlines():
        fields = [f.strip() for f in line.split(",")]
        if len(fields) == 3 and fields[1] in cameras:
            cameras[fields[1]].append((_stamp(fields[0]), folder / "sensors" / "records_data" / fields[2]))
    left, right = cameras.values()
    return left, right


def _stamp(text: str) -> int:
    try:
        return int(text)
    except ValueError:
        raise StereoSfmError(f"kapture: '{text}' is not a stamp in nanoseconds") from None
