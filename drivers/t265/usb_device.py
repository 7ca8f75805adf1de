"""Typed access to pyusb: attached cameras and translation of errors."""

from __future__ import annotations

import array
import errno
from typing import Any, Protocol, cast

from stereo_sfm.drivers.live.errors import Busy, DeviceError, DeviceLost, NoPermission, NotFound
from stereo_sfm.drivers.t265 import messages as m
from stereo_sfm.errors import require

SPEEDS = {0: "unknown", 1: "low", 2: "full", 3: "high", 4: "super", 5: "super+"}  # libusb_speed
SUPER_SPEED = 4
_GONE = {errno.ENODEV, errno.EIO, errno.EPIPE, errno.EPROTO, errno.ESHUTDOWN, errno.ENOENT, errno.EOVERFLOW}


class UsbDevice(Protocol):
    """The part of `usb.core.Device` used by this driver."""

    idVendor: int
    idProduct: int
    bus: int | None
    address: int | None
    port_numbers: tuple[int, ...] | None
    speed: int | None
    serial_number: str | None

    def get_active_configuration(self) -> Any: ...
    def set_configuration(self, configuration: int | None = None) -> None: ...
    def write(self, endpoint: int, data: bytes, timeout: int) -> int: ...
    def read(self, endpoint: int, size_or_buffer: array.array[int], timeout: int) -> int: ...
    def ctrl_transfer(
        self, bmRequestType: int, bRequest: int, wValue: int, wIndex: int, data_or_wLength: int, timeout: int
    ) -> Any: ...


def default_backend() -> Any:
    """libusb from its wheel, else the system's.

    Raises:
        NotFound: libusb is missing.
    """
    require(("usb", "libusb_package"), "t265,oak", "a camera on USB", NotFound)
    import libusb_package
    import usb.backend.libusb1

    backend = libusb_package.get_libusb1_backend() or usb.backend.libusb1.get_backend()
    if backend is None:
        raise NotFound("libusb not found: install libusb-1.0 (package libusb-1.0-0 on Debian)")
    return backend


def attached(backend: Any) -> list[UsbDevice]:
    """Every T265 on the bus, booted or not, in bus order."""
    import usb.core

    wanted = {m.BOOT_ID, *m.RUN_IDS}
    try:
        found = usb.core.find(find_all=True, backend=backend, custom_match=lambda d: _id(d) in wanted)
        devices = cast(list[UsbDevice], list(found or ()))
    except usb.core.USBError as error:
        raise device_error(error, "cannot look for cameras") from None
    return sorted(devices, key=lambda d: (d.bus or 0, d.address or 0))


def _id(device: Any) -> tuple[int, int]:
    return device.idVendor, device.idProduct


def is_boot(device: UsbDevice) -> bool:
    """Whether the camera is waiting for its firmware."""
    return _id(device) == m.BOOT_ID


def place(device: UsbDevice) -> str:
    """Its location as in `lsusb`."""
    return f"bus {device.bus} address {device.address}"


def device_error(error: Exception, what: str) -> DeviceError:
    """A pyusb error translated to one of ours, with a remedy."""
    number = getattr(error, "errno", None)
    if number in (errno.EACCES, errno.EPERM):
        return NoPermission(
            f"{what}: no permission. Install the udev rule that 'stereo-sfm udev' prints, then replug the camera"
        )
    if number == errno.EBUSY:
        return Busy(f"{what}: another program uses it. Close that program (or replug the camera)")
    if number in _GONE:
        return DeviceLost(f"{what}: the camera was disconnected (unplugged, or its firmware crashed)")
    return DeviceError(f"{what}: {error}")
