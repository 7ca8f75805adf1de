"""Calibration of wheel odometry: the keys of our rig file, and the T265's calibration_odometry.json."""

from __future__ import annotations

import json
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from stereo_sfm.calib.formats.common import numbers, read_json, reading, rigid, rows
from stereo_sfm.calib.wheel import Wheel
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.types import F64

_SCALARS = ("track_m", "wheelbase_m", "angular_scale", "slip", "speed_noise", "tick_m", "rate_hz", "offset_s")
_VELOCIMETERS = "velocimeters"


def wheel_to_plain(wheel: Wheel) -> dict[str, Any]:
    """Keys of our own rig file."""
    return {
        "model": wheel.model,
        "left_T_wheel": rows(wheel.left_T_wheel),
        "radii_m": [float(r) for r in wheel.radii_m],
        "linear_matrix": rows(wheel.linear_matrix),
        **{name: float(getattr(wheel, name)) for name in _SCALARS},
    }


def wheel_from_plain(data: dict[str, Any], body_T_left: F64) -> Wheel:
    """The inverse of `wheel_to_plain`; missing keys get their defaults, and `body_T_wheel` may stand for the pose.

    Raises:
        ValueError: an unknown key, or no pose.
    """
    unknown = set(data) - {f.name for f in fields(Wheel)} - {"body_T_wheel"}
    if unknown:
        raise ValueError(f"unknown wheel key: {', '.join(sorted(unknown))}")
    if "body_T_wheel" in data:
        left_T_wheel = se3.inverse(body_T_left) @ rigid(data["body_T_wheel"])
    else:
        left_T_wheel = rigid(data["left_T_wheel"])
    known: dict[str, Any] = {name: float(data[name]) for name in _SCALARS if name in data}
    if "linear_matrix" in data:
        known["linear_matrix"] = np.array(numbers(data["linear_matrix"], 9)).reshape(3, 3)
    radii = tuple(numbers(data.get("radii_m") or []))
    return Wheel(left_T_wheel, str(data.get("model", "twist")), radii, **known)


def write_t265_odometry(wheel: Wheel, left_T_right: F64, path: Path) -> None:
    """The inverse of `read_t265_odometry`, for velocities that are sent to the camera; (4, 4) of the rig.

    Raises:
        StereoSfmError: the file cannot be written.
    """
    tracker_T_wheel = se3.inverse(_left_T_tracker(left_T_right)) @ wheel.left_T_wheel
    turn, place = se3.so3_log(tracker_T_wheel[:3, :3]), tracker_T_wheel[:3, 3]
    meter = {
        "scale_and_alignment": [float(v) for v in wheel.linear_matrix.ravel()],
        "noise_variance": wheel.speed_noise**2 * wheel.rate_hz,
        "extrinsics": {"T": place.tolist(), "T_variance": [1e-4] * 3, "W": turn.tolist(), "W_variance": [1e-4] * 3},
    }
    try:
        path.write_text(json.dumps({_VELOCIMETERS: [meter]}, indent=2) + "\n", encoding="utf-8")
    except OSError as error:
        raise StereoSfmError(f"cannot write {path}: {error.strerror}") from None


def _left_T_tracker(left_T_right: F64) -> F64:
    """(4, 4): amid the cameras, x right, y up, z backwards."""
    return se3.from_rotation_translation(np.diag([1.0, -1.0, -1.0]), 0.5 * left_T_right[:3, 3])


def read_t265_odometry(path: Path, left_T_right: F64) -> Wheel:
    """The first velocimeter of the T265's calibration_odometry.json (librealsense, doc/t265.md).

    Its frame is given in the tracker's: amid the cameras, x right, y up, z backwards.

    Args:
        path: the file. left_T_right: (4, 4) of the rig.

    Raises:
        StereoSfmError: malformed.
    """
    with reading(path, "T265 odometry"):
        meter = read_json(path)[_VELOCIMETERS][0]
        turn, place = (np.array(numbers(meter["extrinsics"][key], 3)) for key in ("W", "T"))
        left_T_wheel = _left_T_tracker(left_T_right) @ se3.from_rotation_translation(se3.so3_exp(turn), place)
        matrix = np.array(numbers(meter["scale_and_alignment"], 9)).reshape(3, 3)
        noise = float(np.sqrt(float(meter["noise_variance"]) / Wheel().rate_hz))  # of a sample, at the default rate
        return Wheel(left_T_wheel, linear_matrix=matrix, speed_noise=noise)
