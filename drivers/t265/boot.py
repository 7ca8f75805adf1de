"""Booting the camera: send the firmware, wait until it reappears on another bus."""

from __future__ import annotations

import contextlib
import tempfile
import time
from collections.abc import Generator
from pathlib import Path
from typing import IO, Any

from stereo_sfm.drivers.live.errors import BootFailed, Busy
from stereo_sfm.drivers.t265 import messages as m
from stereo_sfm.drivers.t265.firmware import Firmware
from stereo_sfm.drivers.t265.link import Timing, dispose
from stereo_sfm.drivers.t265.usb_device import UsbDevice, attached, device_error, is_boot, place

# Bytes of one transfer: whole packets, so that the camera receives one stream. One transfer of 9 MB needs more
# contiguous memory than some kernels provide (seen on the virtual host controller of Linux 6.1).
_CHUNK = 256 * 1024


def boot(device: UsbDevice, firmware: Firmware, backend: Any, timing: Timing) -> UsbDevice:
    """Send the firmware to one camera and return the running camera.

    The bus and address change, so it is identified as a new running camera, preferably at the same USB ports.

    Raises:
        NoPermission, Busy, BootFailed.
    """
    if not is_boot(device):
        raise ValueError("only a T265 in its boot state accepts firmware")
    with _one_booter(timing):
        before = {place(d) for d in attached(backend) if not is_boot(d)}
        _send(device, firmware, timing)
        return _wait(device, before, backend, timing)


def _send(device: UsbDevice, firmware: Firmware, timing: Timing) -> None:
    import usb.core
    import usb.util

    try:
        usb.util.claim_interface(device, 0)
        for at in range(0, len(firmware.data), _CHUNK):
            chunk = firmware.data[at : at + _CHUNK]
            if device.write(m.BOOT_OUT, chunk, timing.boot_ms) != len(chunk):
                raise BootFailed("the T265 stopped accepting its firmware halfway: replug it and try again")
    except usb.core.USBTimeoutError:
        raise BootFailed("the T265 does not accept its firmware: replug it directly into the computer") from None
    except (usb.core.USBError, ValueError, LookupError) as error:
        raise device_error(error, f"cannot boot the T265 on {place(device)}") from None
    finally:
        dispose(device)


def _wait(device: UsbDevice, before: set[str], backend: Any, timing: Timing) -> UsbDevice:
    deadline = time.monotonic() + timing.boot_s
    while time.monotonic() < deadline:
        time.sleep(timing.boot_poll_s)
        new = [d for d in attached(backend) if not is_boot(d) and place(d) not in before]
        same_port = [d for d in new if d.port_numbers == device.port_numbers]
        if new:
            time.sleep(timing.settle_s)
            return (same_port or new)[0]
    raise BootFailed(f"the T265 did not restart after loading its firmware within {timing.boot_s:.0f} s: replug it")


@contextlib.contextmanager
def _one_booter(timing: Timing) -> Generator[None]:
    """A lock between processes: booting cameras from two programs at once fails."""
    path = Path(tempfile.gettempdir()) / "stereo-sfm-t265-boot.lock"
    try:
        file = path.open("a")
    except OSError:  # another user's lock file: boot without the lock
        yield
        return
    with file:
        deadline = time.monotonic() + timing.boot_s
        while not _try_lock(file):
            if time.monotonic() > deadline:
                raise Busy("another program is booting a T265: wait for it, or remove " + str(path))
            time.sleep(timing.boot_poll_s)
        yield


def _try_lock(file: IO[str]) -> bool:
    try:
        import fcntl
    except ImportError:  # not available on Windows
        return True
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True
