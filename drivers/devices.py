"""Attached live cameras and their udev rules, from the installed drivers."""

from __future__ import annotations

from stereo_sfm.drivers import registry
from stereo_sfm.drivers.driver import Attached, Cameras, UsbId
from stereo_sfm.drivers.live.errors import DeviceError

UDEV_FILE = "/etc/udev/rules.d/70-stereo-sfm.rules"  # below 73: 'uaccess' works


def camera_drivers() -> dict[str, Cameras]:
    """Kind -> camera description of its driver."""
    return {kind: found.cameras for kind, found in registry.drivers() if found.cameras is not None}


def list_devices(probe: bool = False) -> tuple[list[Attached], list[str]]:
    """All attached cameras.

    Args:
        probe: cameras may be started (takes seconds) to read their calibration.

    Returns:
        Cameras, and errors of drivers that could not search.
    """
    cameras: list[Attached] = []
    problems: list[str] = []
    for kind, driver in camera_drivers().items():
        try:
            cameras += driver.find(probe) if driver.find is not None else ()
        except DeviceError as error:
            problems.append(f"{kind}: {error}")
    return cameras, problems


def no_cameras() -> str:
    """The message when none is attached."""
    drivers = camera_drivers().values()
    titles = " or ".join(driver.title for driver in drivers if driver.find is not None)
    without = [driver.without for driver in drivers if driver.without]
    return f"no {titles} attached" + (f" ({', '.join(without)} needs none)" if without else "")


def udev_rules() -> str:
    """Rules that let the local user and the group plugdev open the cameras of all drivers."""
    drivers = camera_drivers()
    ids = {usb for driver in drivers.values() for usb in driver.usb}
    whole = {usb.vendor for usb in ids if usb.product is None}  # such a rule covers all of a vendor's products
    needed = [usb for usb in ids if usb.product is None or usb.vendor not in whole]
    needed.sort(key=lambda usb: (usb.vendor, usb.product or 0))
    titles = " and ".join(driver.title for driver in drivers.values() if driver.usb)
    first = f"# stereo-sfm: {titles} for the local user and the group plugdev"
    return "\n".join([first, *map(_rule, needed), ""])


def _rule(usb: UsbId) -> str:
    product = "" if usb.product is None else f', ATTR{{idProduct}}=="{usb.product:04x}"'
    return (
        f'SUBSYSTEM=="usb", ENV{{DEVTYPE}}=="usb_device", ATTR{{idVendor}}=="{usb.vendor:04x}"{product}, '
        'MODE="0660", GROUP="plugdev", TAG+="uaccess"'
    )
