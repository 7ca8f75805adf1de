"""Selecting, booting and opening a T265, with a check of its link."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from stereo_sfm.drivers.live.counters import Counters
from stereo_sfm.drivers.live.errors import Busy, DeviceError, DeviceFault, NotFound, TooSlowLink
from stereo_sfm.drivers.t265.boot import boot
from stereo_sfm.drivers.t265.camera import T265
from stereo_sfm.drivers.t265.firmware import Firmware, load
from stereo_sfm.drivers.t265.link import Link, Timing
from stereo_sfm.drivers.t265.usb_device import SPEEDS, SUPER_SPEED, UsbDevice, attached, is_boot, place

logger = logging.getLogger("stereo_sfm")


@dataclass(frozen=True)
class Access:
    """Selection of a camera and its firmware."""

    backend: Any  # pyusb's
    serial: str = ""  # empty: the only one
    firmware: Callable[[], Firmware] = load  # called only when the camera must be booted
    allow_slow: bool = False
    timing: Timing = field(default_factory=Timing)


def acquire(access: Access, counters: Counters) -> T265:
    """Open the wanted camera, booting it first when it has no firmware.

    Raises:
        DeviceError: each kind with its own message.
    """
    devices = attached(access.backend)
    if not devices:
        raise NotFound("no T265 attached (looked for USB ids 8087:0b37 and 03e7:2150): plug it into a USB 3 port")
    if access.serial:
        return _by_serial(devices, access, counters)
    if len(devices) > 1:
        raise DeviceFault(
            f"{len(devices)} T265s are attached: choose one with t265:SERIAL ('stereo-sfm devices' lists them)"
        )
    return _open(devices[0], access, counters)


def _by_serial(devices: list[UsbDevice], access: Access, counters: Counters) -> T265:
    """Running cameras first; without firmware the serial is unknown."""
    trouble: DeviceError | None = None
    seen: list[str] = []
    for device in sorted(devices, key=is_boot):
        try:
            camera = _open(device, access, counters)
        except (Busy, TooSlowLink) as error:
            trouble = error
            continue
        if camera.info.serial == access.serial.upper():
            return camera
        seen.append(camera.info.serial)
        camera.link.close()
    if trouble is not None:
        raise trouble
    raise NotFound(f"no T265 with serial {access.serial} attached (attached: {', '.join(seen)})")


def _open(device: UsbDevice, access: Access, counters: Counters) -> T265:
    if is_boot(device):
        firmware = access.firmware()
        logger.info("booting the T265 on %s", place(device))
        device = boot(device, firmware, access.backend, access.timing)
    _check_speed(device, access)
    link = Link(device, access.timing)
    try:
        return T265(link, counters, access.timing)
    except DeviceError:
        link.close()
        raise


def _check_speed(device: UsbDevice, access: Access) -> None:
    speed = device.speed or 0
    if not 0 < speed < SUPER_SPEED:
        return
    if not access.allow_slow:
        raise TooSlowLink(
            f"the T265 on {place(device)} is on a USB 2 link ({SPEEDS[speed]} speed), which cannot carry 41 MB/s of "
            "images: use a USB 3 port and cable, or allow losses with the option allow_slow=1"
        )
    logger.warning("T265 on a USB 2 link, frames will be lost: use a USB 3 port and cable")
