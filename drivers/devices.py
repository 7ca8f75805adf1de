"""Which live cameras are attached, and the udev rules they need."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from drivers.live.counters import Counters
from drivers.live.errors import DeviceError

UDEV_FILE = "/etc/udev/rules.d/70-stereo-sfm.rules"  # below 73: 'uaccess' works
# Both ids of a T265, before its firmware is sent and after; 03e7 without a product covers that one and every OAK.
_MATCH = 'SUBSYSTEM=="usb", ENV{DEVTYPE}=="usb_device", '
_GRANT = ', MODE="0660", GROUP="plugdev", TAG+="uaccess"'
UDEV_RULES = "\n".join(
    [
        "# stereo-sfm: T265 and OAK for whoever sits at this computer, and for the group plugdev",
        f'{_MATCH}ATTR{{idVendor}}=="8087", ATTR{{idProduct}}=="0b37"{_GRANT}',
        f'{_MATCH}ATTR{{idVendor}}=="8087", ATTR{{idProduct}}=="0af3"{_GRANT}',
        f'{_MATCH}ATTR{{idVendor}}=="03e7"{_GRANT}',
        "",
    ]
)


@dataclass(frozen=True)
class Attached:
    """One camera."""

    id: str  # what `run` and `record` take
    driver: str
    serial: str = ""
    usb_speed: str = ""
    firmware: str = ""
    calibrated: bool | None = None  # None: not known without starting the camera
    note: str = ""


def list_devices(backend: Any = None, probe: bool = False) -> tuple[list[Attached], list[str]]:
    """All attached cameras.

    Args:
        backend: pyusb backend, None for libusb.
        probe: also start each OAK (seconds) to read its calibration.

    Returns:
        Cameras, and what kept a driver from looking.
    """
    cameras: list[Attached] = []
    problems: list[str] = []
    for driver, look in (("t265", lambda: _t265s(backend)), ("oak", lambda: _oaks(probe))):
        try:
            cameras += look()
        except DeviceError as error:
            problems.append(f"{driver}: {error}")
    return cameras, problems


def _t265s(backend: Any) -> list[Attached]:
    from drivers.t265.usb_device import attached, default_backend

    return [_t265(device) for device in attached(backend if backend is not None else default_backend())]


def _t265(device: Any) -> Attached:
    """A running camera is asked; one without firmware can only be seen."""
    from drivers.t265 import firmware
    from drivers.t265.camera import T265
    from drivers.t265.link import Link, Timing
    from drivers.t265.usb_device import SPEEDS, is_boot, place

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
    note = "" if device.speed is None or device.speed >= 4 else "on a USB 2 link: too slow for images"
    return Attached(f"t265:{info.serial}", "t265", info.serial, speed, info.firmware, info.calibrated, note)


def _oaks(probe: bool) -> list[Attached]:
    from drivers.oak.library import find, load

    dai = load()
    return [_probed(dai, one) if probe else _seen(one) for one in find(dai)]


def _seen(one: Any) -> Attached:
    note = f"{one.state.lower()} at {one.name}"
    status = "" if one.status == "X_LINK_SUCCESS" else f", {one.status.lower()}"
    speed = "" if "usb" in one.protocol else one.protocol
    return Attached(f"oak:{one.device_id}", "oak", one.device_id, speed, note=note + status)


def _probed(dai: Any, one: Any) -> Attached:
    from drivers.oak.library import device_error

    try:
        device = dai.Device(one.info)
    except RuntimeError as error:
        return Attached(f"oak:{one.device_id}", "oak", one.device_id, note=str(device_error(error)))
    try:
        calibrated = bool(device.isCalibrationAvailable())
        speed = str(device.getUsbSpeed()).rpartition(".")[2].lower()
        name = str(device.getProductName() or device.getDeviceName())
        return Attached(
            f"oak:{one.device_id}", "oak", one.device_id, speed, f"depthai {dai.__version__}", calibrated, name
        )
    finally:
        device.close()
