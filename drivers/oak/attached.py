"""Attached OAKs: listed from the bus, and started for more information."""

from __future__ import annotations

from typing import Any

from stereo_sfm.drivers.driver import Attached
from stereo_sfm.drivers.oak import library


def find_all(probe: bool) -> list[Attached]:
    """All cameras; with `probe` each is started (takes seconds) to read its speed and calibration."""
    dai = library.load()
    return [_probed(dai, one) if probe else _seen(one) for one in library.find(dai)]


def _seen(one: Any) -> Attached:
    note = f"{one.state.lower()} at {one.name}"
    status = "" if one.status == "X_LINK_SUCCESS" else f", {one.status.lower()}"
    speed = "" if "usb" in one.protocol else one.protocol
    return Attached(f"oak:{one.device_id}", "oak", one.device_id, speed, note=note + status)


def _probed(dai: Any, one: Any) -> Attached:
    try:
        device = dai.Device(one.info)
    except RuntimeError as error:
        return Attached(f"oak:{one.device_id}", "oak", one.device_id, note=str(library.device_error(error)))
    try:
        calibrated = bool(device.isCalibrationAvailable())
        speed = str(device.getUsbSpeed()).rpartition(".")[2].lower()
        name = str(device.getProductName() or device.getDeviceName())
        return Attached(
            f"oak:{one.device_id}", "oak", one.device_id, speed, f"depthai {dai.__version__}", calibrated, name
        )
    finally:
        device.close()
