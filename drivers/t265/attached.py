"""Attached T265s: a running camera is queried; one without firmware is only listed."""

from __future__ import annotations

from typing import Any

from stereo_sfm.drivers.driver import Attached
from stereo_sfm.drivers.live.counters import Counters
from stereo_sfm.drivers.live.errors import DeviceError
from stereo_sfm.drivers.t265 import firmware, usb_device
from stereo_sfm.drivers.t265.camera import T265
from stereo_sfm.drivers.t265.link import Link, Timing
from stereo_sfm.drivers.t265.usb_device import SPEEDS, SUPER_SPEED, is_boot, place


def find() -> list[Attached]:
    """All cameras, booted or not; none is booted."""
    return [_described(device) for device in usb_device.attached(usb_device.default_backend())]


def _described(device: Any) -> Attached:
    speed = SPEEDS.get(device.speed or 0, "unknown")
    if is_boot(device):
        try:
            note = f"not booted yet; firmware file {firmware.find()}"
        except DeviceError as error:
            note = f"not booted yet; {error}"
        return Attached("t265", "t265", usb_speed=speed, firmware="none", note=f"{note} ({place(device)})")
    timing = Timing(command_ms=500, busy_tries=1)
    try:
        link = Link(device, timing)
    except DeviceError as error:
        return Attached("t265", "t265", usb_speed=speed, note=str(error))
    try:
        info = T265(link, Counters(), timing).info
    except DeviceError as error:
        return Attached("t265", "t265", usb_speed=speed, note=str(error))
    finally:
        link.close()
    fast = device.speed is None or device.speed >= SUPER_SPEED
    note = "" if fast else "on a USB 2 link: too slow for images"
    return Attached(f"t265:{info.serial}", "t265", info.serial, speed, info.firmware, info.calibrated, note)
