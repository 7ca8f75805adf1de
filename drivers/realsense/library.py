"""pyrealsense2, imported lazily: attached cameras, and its errors in one line."""

from __future__ import annotations

import ctypes
import importlib
import importlib.util
from contextlib import suppress
from typing import Any

from stereo_sfm.drivers.driver import Attached
from stereo_sfm.drivers.live.errors import (
    Busy,
    DeviceError,
    DeviceFault,
    DeviceLost,
    Meanings,
    NoPermission,
    NotFound,
    translated,
)

NO_CAMERA = "no RealSense attached: plug it into a USB 3 port"
# Lower-case parts of librealsense's messages -> error and message; the first match is used.
_MEANINGS: Meanings = (
    ("no device connected", NotFound, NO_CAMERA),
    ("device disconnected", DeviceLost, "the RealSense was disconnected"),
    ("no such device", DeviceLost, "the RealSense was disconnected"),
    ("device or resource busy", Busy, "another program uses the RealSense: close it"),
    ("permission denied", NoPermission, "no permission: install the udev rule that 'stereo-sfm udev' prints"),
    ("access denied", NoPermission, "no permission: install the udev rule that 'stereo-sfm udev' prints"),
    ("couldn't resolve requests", DeviceFault, "the RealSense has no infrared pair of this size and rate: try "
     "realsense?size=640x480&fps=30, or a USB 3 port"),
)  # fmt: skip


def load() -> Any:
    """pyrealsense2.

    Raises:
        DeviceFault: it is not installed.
    """
    with suppress(ImportError, OSError):  # pyrealsense2's wheels expect the system's libusb, which may be missing
        package = importlib.import_module("libusb_package")
        ctypes.CDLL(str(package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
    try:
        return importlib.import_module("pyrealsense2")
    except ImportError as error:
        raise DeviceFault(
            f"the RealSense driver needs pyrealsense2, which cannot be imported ({error}): "
            "pip install 'stereo-sfm[realsense]'"
        ) from None


def device_error(error: Exception) -> DeviceError:
    """An exception of librealsense translated to one of ours."""
    return translated(error, "RealSense", _MEANINGS)


def find(rs: Any) -> dict[str, Any]:
    """Serial number -> device, of the attached cameras that have an infrared pair."""
    try:
        devices = list(rs.context().query_devices())
        return {
            device.get_info(rs.camera_info.serial_number): device
            for device in devices
            if any(sensor.is_depth_sensor() for sensor in device.query_sensors())
        }
    except RuntimeError as error:
        raise device_error(error) from None


def choose(found: dict[str, Any], wanted: str) -> str:
    """The serial number that is meant.

    Raises:
        NotFound, DeviceFault.
    """
    if not found:
        raise NotFound(NO_CAMERA)
    if wanted and wanted not in found:
        raise NotFound(f"no RealSense '{wanted}' attached (attached: {', '.join(sorted(found))})")
    if not wanted and len(found) > 1:
        raise DeviceFault(f"{len(found)} RealSenses are attached: choose one ({', '.join(sorted(found))})")
    return wanted or next(iter(found))


def find_all() -> list[Attached]:
    """All attached cameras; none without the library, which not everybody needs."""
    if importlib.util.find_spec("pyrealsense2") is None:
        return []
    rs = load()
    info = rs.camera_info
    return [
        Attached(
            f"realsense:{serial}", "realsense", serial, device.get_info(info.usb_type_descriptor),
            device.get_info(info.firmware_version), True, device.get_info(info.name),
        )
        for serial, device in sorted(find(rs).items())
    ]  # fmt: skip
