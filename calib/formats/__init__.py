"""Calibration file formats, one module each: every calibration file is read into a `Rig` and written from one."""

from __future__ import annotations

import importlib
import inspect
import logging
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from stereo_sfm.calib.formats.common import read_text
from stereo_sfm.calib.formats.pair_files import left_files
from stereo_sfm.calib.rig import Rig
from stereo_sfm.errors import StereoSfmError, one_of
from stereo_sfm.input_file import refuse_pipe, visible

log = logging.getLogger("stereo_sfm")

# name -> (module, reader, writer, whether it writes a folder). A reader takes a path and returns a Rig.
FORMATS: dict[str, tuple[str, str, str, bool]] = {
    "rig": ("native", "read_native", "write_native", False),
    "kalibr": ("kalibr", "read_kalibr", "write_kalibr", False),
    "ros": ("ros", "read_ros", "write_ros", True),
    "opencv": ("opencv", "read_opencv", "write_opencv", False),
    "euroc": ("euroc", "read_euroc", "write_euroc", True),
    "kitti": ("kitti", "read_kitti", "write_kitti", False),
    "basalt": ("basalt", "read_basalt", "write_basalt", False),
    "colmap": ("colmap", "read_colmap", "write_colmap", True),
    "foxglove": ("foxglove", "read_foxglove", "write_foxglove", False),
    "kapture": ("kapture", "read_kapture", "write_kapture", True),
    "depthai": ("depthai", "read_depthai", "write_depthai", False),
}

# Settings of other systems: name -> (module, reader). Nothing writes them.
SETTINGS: dict[str, tuple[str, str]] = {
    "orbslam": ("orbslam", "read_orbslam"),
    "stella": ("stella", "read_stella"),
    "vins": ("vins", "read_vins"),
    "openvins": ("openvins", "read_openvins"),
}

OPTIONS = "size", "pair", "lens", "unit"  # of readers
WITH_IMU = "rig", "kalibr", "euroc", "basalt", "depthai"  # formats that store one


def load_rig(path: Path | str, format: str | None = None, **options: Any) -> Rig:
    """Read a calibration of any format.

    Args:
        path: a file, or a folder for formats with one file per camera.
        format: a name of `FORMATS` or `SETTINGS`; None detects it from the content.
        **options: options of the format's reader: `size=(width, height)` where files state none, `pair=(0, 2)` where
            they have more than two cameras, `unit=0.01` and `lens="fisheye"` where they name neither.

    Raises:
        StereoSfmError: missing, malformed or unrecognised, or the format has no such option.
    """
    path = Path(path).expanduser()
    if not path.exists():
        raise StereoSfmError(f"no calibration at {path}")
    name = format or recognise(path)
    read = _function(name, 1)
    known = [key for key in inspect.signature(read).parameters if key in OPTIONS]
    for key in options:
        if key not in known:
            raise StereoSfmError(
                f"a calibration of the format {name} is read with {', '.join(known) or 'no options'}, not with {key}"
            )
    return read(path, **options)


def save_rig(rig: Rig, path: Path | str, format: str | None = None) -> None:
    """Write a calibration; without `format` a .json is Foxglove's, an .xml OpenCV's, everything else ours."""
    path = Path(path).expanduser()
    name = format or {".json": "foxglove", ".xml": "opencv"}.get(path.suffix, "rig")
    write = _function(name, 2)
    for what in _lost(rig, name):
        log.warning("%s cannot store %s lost: the format 'rig' keeps it", name, what)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        refuse_pipe(path)
        write(rig, path)
    except OSError as error:
        raise StereoSfmError(f"cannot write the calibration to {path}: {error.strerror}") from None


def _lost(rig: Rig, name: str) -> Iterator[str]:
    """What a format does not store of a rig."""
    if rig.imu is not None and name not in WITH_IMU:
        yield "an IMU, its calibration is"
    if name == "rig":
        return
    if rig.readout_s:
        yield f"the readout time of a rolling shutter ({rig.readout_s:g} s), it is"
    if rig.wheel is not None:
        yield "wheel odometry, its calibration is"
    if rig.left_mask is not None or rig.right_mask is not None:
        yield "what is masked, it is"
    if rig.depth:
        yield "that the right camera is virtual (RGB-D), it is"


def recognise(path: Path) -> str:
    """The format of a file or folder, detected from its content.

    Raises:
        StereoSfmError: no format matches, or the file is not text.
    """
    found = _recognise_folder(path) if path.is_dir() else _recognise_file(path)
    if found is None:
        raise StereoSfmError(f"cannot detect the calibration format of {path}: {_instead(path)}")
    return found


def _instead(path: Path) -> str:
    """What to do with a file whose format is not recognised."""
    if path.name == "sensor.yaml":  # EuRoC
        return f"it is of one camera of two, give the folder with cam0/sensor.yaml ({path.absolute().parents[1]})"
    return f"'stereo-sfm convert-calib --from FORMAT' reads it as one of {', '.join([*FORMATS, *SETTINGS])}"


def _recognise_folder(path: Path) -> str | None:
    marks = {
        "euroc": ("mav0/cam0/sensor.yaml", "cam0/sensor.yaml"),
        "kitti": ("calib.txt", "calib_cam_to_cam.txt"),
        "colmap": ("cameras.txt",),
        "kapture": ("sensors.txt", "sensors/sensors.txt"),
    }
    found = next((name for name, files in marks.items() if any((path / f).is_file() for f in files)), None)
    if found is None:  # a file for each camera
        files = left_files(path, ".yaml", ".yml") or sorted(visible(path, "*.yaml"))
        found = _recognise_file(files[0]) if files else None
        return found if found == "ros" else None
    return found


def _recognise_file(path: Path) -> str | None:
    try:
        text = read_text(path)
    except UnicodeDecodeError:
        raise StereoSfmError(f"calibration {path} is not a text file") from None
    except OSError as error:
        raise StereoSfmError(f"calibration {path}: {error.strerror}") from None
    if path.suffix == ".json" or text.lstrip().startswith(("{", "[")):
        marks = {"basalt": '"T_imu_cam"', "depthai": '"cameraData"', "opencv": '"opencv-matrix"', "foxglove": '"K"'}
    elif path.suffix == ".txt":
        marks = {"kitti": "P0:", "kapture": "camera,"} | {"colmap": "" if path.name == "cameras.txt" else "CAMERA_ID"}
        marks = {"kitti": "P_rect_"} | marks if "P_rect_" in text else marks
    else:
        marks = {
            "rig": "stereo_sfm_rig:",
            "openvins": "relative_config_imucam:",
            "vins": "cam0_calib:" if "cam0_calib:" in text else "model_type:",
            "stella": "Camera.model:" if "Camera.model:" in text else "\nCamera:",
            "orbslam": "Camera1.fx:" if "Camera1.fx:" in text else "Camera.fx:",
            "opencv": "opencv-matrix" if "opencv-matrix" in text else "<opencv_storage>",
            "ros": "camera_matrix:",
            "kalibr": "cam0:",
            "kitti": "P0:",
        }
    return next((name for name, mark in marks.items() if mark in f"\n{text}"), None)


def _function(name: str, which: int) -> Callable[..., Any]:
    known: dict[str, tuple[Any, ...]] = {**FORMATS, **SETTINGS} if which == 1 else {**FORMATS}
    one_of(name, known, "calibration format")
    return getattr(importlib.import_module(f"stereo_sfm.calib.formats.{known[name][0]}"), str(known[name][which]))
