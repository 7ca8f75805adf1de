"""depthai, imported lazily and without telemetry: attached cameras and translation of errors."""

from __future__ import annotations

import importlib
import logging
import os
from dataclasses import dataclass
from typing import Any

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

log = logging.getLogger("stereo_sfm")

AUTO_CALIBRATION = "DEPTHAI_AUTOCALIBRATION"
# Read by depthai when it is imported. Since 3.7 it reports every import and pipeline to its vendor unless disabled,
# and uploads crash dumps of the camera. Variables set by the user are kept.
ENVIRONMENT = {
    "DEPTHAI_TELEMETRY": "0",
    "DEPTHAI_CRASHDUMP": "0",
    "DEPTHAI_DISABLE_CRASHDUMP_COLLECTION": "1",
    "DEPTHAI_DISABLE_STARTUP_NOTIFICATIONS": "1",
    "DEPTHAI_INSTALL_SIGNAL_HANDLER": "0",
    "DEPTHAI_LEVEL": "off",  # it logs to standard output
    "DEPTHAI_SEARCH_TIMEOUT": "2000",
    "DEPTHAI_RECONNECT_TIMEOUT": "0",  # we handle reconnection ourselves, with a new segment
    AUTO_CALIBRATION: "OFF",  # since 3.6 it may measure the pair again at start, and write that to the camera
}

# Lower-case parts of depthai's messages -> error and message; the first match is used.
_MEANINGS: Meanings = (
    ("no available devices", NotFound, "no OAK attached: plug it into a USB 3 port"),
    ("cannot find any device", NotFound, "no such OAK attached ('stereo-sfm devices' lists the attached ones)"),
    ("insufficient_permissions", NoPermission, "no permission: install the udev rule that 'stereo-sfm udev' prints"),
    ("insufficient permissions", NoPermission, "no permission: install the udev rule that 'stereo-sfm udev' prints"),
    ("already_in_use", Busy, "another program uses the OAK: close it"),
    ("already in use", Busy, "another program uses the OAK: close it"),
    ("x_link_error", DeviceLost, "the OAK was disconnected (unplugged, or its firmware crashed)"),
    ("couldn't read data from stream", DeviceLost, "the OAK was disconnected (unplugged, or its firmware crashed)"),
    ("closed", DeviceLost, "the OAK was disconnected (unplugged, or its firmware crashed)"),
    ("disconnected", DeviceLost, "the OAK was disconnected (unplugged, or its firmware crashed)"),
)


NO_OAK = "no OAK attached: plug it into a USB 3 port (a network camera needs its address, oak:192.168.1.44)"


def load() -> Any:
    """depthai.

    Raises:
        DeviceFault: it is not installed.
    """
    for name, value in ENVIRONMENT.items():
        os.environ.setdefault(name, value)
    if os.environ[AUTO_CALIBRATION].upper() != ENVIRONMENT[AUTO_CALIBRATION]:
        log.warning(
            "%s=%s: depthai may change the camera's calibration at start, and write it to the camera",
            AUTO_CALIBRATION, os.environ[AUTO_CALIBRATION],
        )  # fmt: skip
    try:
        return importlib.import_module("depthai")
    except ImportError as error:
        raise DeviceFault(
            f"the OAK driver needs depthai 3, which cannot be imported ({error}): pip install 'stereo-sfm[oak]'"
        ) from None


def device_error(error: Exception) -> DeviceError:
    """An exception of depthai translated to one of ours."""
    return translated(error, "OAK", _MEANINGS)


@dataclass(frozen=True)
class Found:
    """A camera found by depthai, not opened."""

    device_id: str
    name: str  # USB path or network address
    state: str
    protocol: str
    status: str
    info: Any  # depthai.DeviceInfo


# USB product ids of vendor 03e7: unbooted, booted, bootloader, flash-booted. 2150 is a T265 and deliberately absent.
_USB_VENDOR, _USB_PRODUCTS = 0x03E7, (0x2485, 0xF63B, 0xF63C, 0xF63D)


def on_usb() -> bool:
    """Whether an OAK is on the USB bus: takes milliseconds, whereas depthai takes a second."""
    from stereo_sfm.drivers.t265.usb_device import default_backend

    try:
        backend = default_backend()
    except NotFound:
        return False
    import usb.core

    try:
        found = usb.core.find(
            backend=backend,
            custom_match=lambda d: d.idVendor == _USB_VENDOR and d.idProduct in _USB_PRODUCTS,
        )
    except usb.core.USBError:
        return False
    return found is not None


def find(dai: Any) -> list[Found]:
    """All attached to USB or the network, within half a second, without booting any."""
    try:
        infos = dai.Device.getAllAvailableDevices()
    except RuntimeError as error:
        raise device_error(error) from None
    found = [
        Found(
            info.deviceId,
            info.name,
            _last(info.state),
            _last(info.protocol).replace("X_LINK_", "").lower(),
            _last(info.status),
            info,
        )
        for info in infos
    ]
    return sorted(found, key=lambda f: f.device_id)


def _last(value: object) -> str:
    return str(value).rpartition(".")[2]


def choose(found: list[Found], wanted: str) -> Found:
    """The camera with this id or name, or the only one.

    Raises:
        NotFound, DeviceFault.
    """
    if not found:
        raise NotFound(NO_OAK)
    if wanted:
        for one in found:
            if wanted in (one.device_id, one.name):
                return one
        raise NotFound(f"no OAK '{wanted}' attached (attached: {', '.join(f.device_id for f in found)})")
    if len(found) > 1:
        raise DeviceFault(f"{len(found)} OAKs are attached: choose one with oak:ID ('stereo-sfm devices' lists them)")
    return found[0]
