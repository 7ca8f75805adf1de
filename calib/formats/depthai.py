"""depthai's calibration JSON (the EEPROM's content): sockets, extrinsics as destination_from_source in centimetres."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from stereo_sfm.calib.formats.common import (
    brown,
    exact_rotation,
    numbers,
    padded,
    read_json,
    reading,
    stereo_only,
    unsupported,
)
from stereo_sfm.calib.formats.imu_files import warn_of_lost
from stereo_sfm.calib.imu import Imu
from stereo_sfm.calib.rig import Rig
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Camera, KannalaBrandt, Pinhole, RadTan
from stereo_sfm.types import F64

_PERSPECTIVE, _FISHEYE = 0, 1
_CENTIMETRE = 0.01
_IMU = "imuCalibrationParams"
_SENSORS = {"accelerometer": "accel", "gyroscope": "gyro"}  # -> ours
_NO_RECTIFICATION: dict[str, Any] = {"rectifiedRotationLeft": [], "rectifiedRotationRight": []}


def read_depthai(path: Path | str, pair: tuple[int, int] | None = None) -> Rig:
    """The sockets of `pair`, else the stereo pair named in the file, else sockets 1 and 2 (CAM_B left, CAM_C right)."""
    path = Path(path)
    with reading(path, "depthai"):
        data = read_json(path)
        cameras = {int(socket): camera for socket, camera in data["cameraData"]}
        stereo = data.get("stereoRectificationData", {})
        stated = (stereo.get("leftCameraSocket", -1), stereo.get("rightCameraSocket", -1))
        left, right = pair or (socket if socket >= 0 else usual for socket, usual in zip(stated, (1, 2), strict=True))
        name, serial = str(data.get("boardName", "")), str(data.get("batchName", ""))
        right_T_left = _chain(cameras, left, right)
        lenses = _camera(cameras[left]), _camera(cameras[right])
        imu = _imu(data, cameras, left)
        return Rig(lenses[0], lenses[1], se3.inverse(right_T_left), name=name, serial=serial, imu=imu)


def write_depthai(rig: Rig, path: Path) -> None:
    """Sockets 1 and 2. The IMU is stored but for its time offset, the body's pose is not."""
    right = stereo_only(rig.right, "depthai")
    if rig.imu is not None:
        warn_of_lost(rig.imu, "depthai", affine=True)
    right_T_left = se3.inverse(rig.left_T_right)
    data = {
        "batchName": rig.serial,
        "boardName": rig.name,
        "version": 7,
        "cameraData": [[1, _plain(rig.left, right_T_left, 2)], [2, _plain(right, np.eye(4), -1)]],
        "stereoRectificationData": {"leftCameraSocket": 1, "rightCameraSocket": 2} | _NO_RECTIFICATION,
    } | ({} if rig.imu is None else {"imuExtrinsics": _extrinsics(rig.imu.left_T_imu, 1), _IMU: _plain_imu(rig.imu)})
    path.write_text(json.dumps(data, indent=2) + "\n", encoding="utf-8")


def _chain(cameras: dict[int, Any], start: int, end: int) -> F64:
    """end_T_start by chaining the cameras' extrinsics from both ends; metres."""
    towards: dict[int, tuple[int, F64]] = {}
    for socket, camera in cameras.items():
        extrinsics = camera["extrinsics"]
        if int(extrinsics["toCameraSocket"]) >= 0:
            towards[socket] = int(extrinsics["toCameraSocket"]), _pose(extrinsics)
    return se3.inverse(_to_root(towards, end)) @ _to_root(towards, start)


def _to_root(towards: dict[int, tuple[int, F64]], socket: int) -> F64:
    """root_T_socket; the root is the camera without extrinsics to another one."""
    out, seen = np.eye(4), {socket}
    while socket in towards:
        socket, step = towards[socket]
        if socket in seen:
            raise ValueError("the extrinsics form a cycle")
        seen.add(socket)
        out = step @ out
    return out


def _pose(extrinsics: dict[str, Any]) -> F64:
    """(4, 4) destination_T_source, metres."""
    step = np.eye(4)
    step[:3, :3] = np.array(numbers(extrinsics["rotationMatrix"], 9)).reshape(3, 3)
    step[:3, 3] = [_CENTIMETRE * float(extrinsics["translation"][k]) for k in "xyz"]
    return exact_rotation(step)


def _imu(data: dict[str, Any], cameras: dict[int, Any], left: int) -> Imu | None:
    """None where the board does not know its pose."""
    extrinsics = data.get("imuExtrinsics")
    socket = -1 if extrinsics is None else int(extrinsics.get("toCameraSocket", -1))
    if extrinsics is None or socket not in cameras:
        return None
    return imu_at(_chain(cameras, socket, left) @ _pose(extrinsics), data.get(_IMU))


def imu_at(left_T_imu: F64, parameters: dict[str, Any] | None) -> Imu:
    """An IMU at a pose (4, 4) with the EEPROM's `imuCalibrationParams`: affine maps [Q | b] of its samples, and noise.

    Noise that is 0, and parameters that older boards do not have, are the defaults.
    """
    if not parameters:
        return Imu(left_T_imu)
    known: dict[str, Any] = {}
    for name, ours in _SENSORS.items():
        affine = np.array([numbers(row, 4) for row in parameters[name]]).reshape(3, 4)
        known |= {f"{ours}_matrix": affine[:, :3].copy(), f"{ours}_bias": -affine[:, 3]}
        axes = parameters["noise"][name].values()
        for key, theirs in (("noise", "noiseDensity"), ("walk", "randomWalk")):
            mean = float(np.mean([axis[theirs] for axis in axes]))
            known |= {f"{ours}_{key}": mean} if mean > 0 else {}
    return Imu(left_T_imu, **known)


def _plain_imu(imu: Imu) -> dict[str, Any]:
    noise: dict[str, Any] = {"name": ""}
    out: dict[str, Any] = {"noise": noise}
    for name, ours in _SENSORS.items():
        matrix, bias = getattr(imu, f"{ours}_matrix"), getattr(imu, f"{ours}_bias")
        out[name] = np.column_stack([matrix, -bias]).tolist()
        axis = {"noiseDensity": float(getattr(imu, f"{ours}_noise")), "randomWalk": float(getattr(imu, f"{ours}_walk"))}
        noise[name] = {k: axis | {"biasStability": 0.0} for k in "xyz"}
    return out


def _camera(data: dict[str, Any]) -> Camera:
    k = np.array(numbers(data["intrinsicMatrix"], 9)).reshape(3, 3)
    width, height, kind = int(data["width"]), int(data["height"]), int(data.get("cameraType", _PERSPECTIVE))
    coefficients = numbers(data["distortionCoeff"])
    if kind == _FISHEYE:
        return KannalaBrandt(width, height, k[0, 0], k[1, 1], k[0, 2], k[1, 2], tuple(coefficients[:4]))
    if kind != _PERSPECTIVE:
        raise ValueError(f"camera type {kind} is not supported (supported: perspective, fisheye)")
    return brown((width, height), (k[0, 0], k[1, 1]), (k[0, 2], k[1, 2]), coefficients)


def _plain(camera: Camera, next_T_this: F64, next_socket: int) -> dict[str, Any]:
    if not isinstance(camera, Pinhole | RadTan | KannalaBrandt):
        raise unsupported(camera, "depthai")
    return {
        "cameraType": _FISHEYE if camera.model == "kannala_brandt" else _PERSPECTIVE,
        "width": camera.width,
        "height": camera.height,
        "intrinsicMatrix": [[float(v) for v in row] for row in camera.matrix],
        "distortionCoeff": padded(camera, 14),
        "lensPosition": 0,
        "specHfovDeg": float(np.rad2deg(2 * np.arctan(0.5 * camera.width / camera.fx))),
        "extrinsics": _extrinsics(next_T_this, next_socket),
    }


def _extrinsics(next_T_this: F64, next_socket: int) -> dict[str, Any]:
    """To a socket; -1: to none."""
    x, y, z = (float(v) / _CENTIMETRE for v in next_T_this[:3, 3])
    return {
        "rotationMatrix": [[float(v) for v in row] for row in next_T_this[:3, :3]],
        "translation": {"x": x, "y": y, "z": z},
        "specTranslation": {"x": x, "y": y, "z": z},
        "toCameraSocket": next_socket,
    }
