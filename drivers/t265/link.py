"""The opened camera: commands, endpoint reads, reset. All commands are sent from here."""

from __future__ import annotations

import array
import struct
import threading
from dataclasses import dataclass
from typing import Any

from stereo_sfm.drivers.live.errors import DeviceError, DeviceFault, DeviceLost
from stereo_sfm.drivers.t265 import messages as m
from stereo_sfm.drivers.t265 import protocol
from stereo_sfm.drivers.t265.usb_device import UsbDevice, device_error, place

_BULK, _INTERRUPT = 2, 3
_ENDPOINTS = {(m.COMMAND_OUT, _BULK), (m.COMMAND_IN, _BULK), (m.VIDEO_IN, _BULK), (m.EVENT_IN, _INTERRUPT)}


@dataclass(frozen=True)
class Timing:
    """Timeouts."""

    command_ms: int = 3000
    read_ms: int = 300  # one blocking read of an image or event endpoint
    busy_tries: int = 5
    busy_wait_s: float = 1.0
    boot_ms: int = 10_000  # sending the firmware
    boot_s: float = 10.0  # until the camera reappears
    boot_poll_s: float = 0.1
    settle_s: float = 0.3  # after it reappears, before the first command
    clock_s: float = 0.5  # between clock readings


class Link:
    """Interface 0 of a running T265.

    Args:
        device: from `usb_device.attached`.
        timing: timeouts.

    Raises:
        NoPermission, Busy, DeviceLost, DeviceFault.
    """

    def __init__(self, device: UsbDevice, timing: Timing) -> None:
        self.device, self._timing = device, timing
        self._lock = threading.Lock()
        self.what = f"T265 on {place(device)}"
        try:
            self._open()
        except DeviceError:
            self.close()
            raise

    def _open(self) -> None:
        import usb.core
        import usb.util

        try:
            try:
                configuration = self.device.get_active_configuration()
            except usb.core.USBError as error:
                if error.errno is not None:
                    raise
                self.device.set_configuration()  # macOS leaves it unconfigured
                configuration = self.device.get_active_configuration()
            endpoints = {(e.bEndpointAddress, e.bmAttributes & 3) for e in configuration[(0, 0)].endpoints()}
            missing = _ENDPOINTS - endpoints
            if missing:
                raise DeviceFault(f"{self.what} has no endpoint {min(missing)[0]:#04x}: this T265 is not supported")
            usb.util.claim_interface(self.device, 0)
        except usb.core.USBError as error:
            raise device_error(error, f"cannot open the {self.what}") from None
        except (LookupError, ValueError, TypeError, AttributeError, NotImplementedError) as error:
            raise DeviceFault(f"{self.what} has invalid descriptors ({error})") from None

    def command(self, request: bytes) -> tuple[int, protocol.Buffer]:
        """Send one request and wait for its answer.

        Returns:
            Status and payload.

        Raises:
            ValueError: the request is not on the list of safe ones (a bug of the driver).
            ProtocolError, DeviceLost, DeviceError.
        """
        import usb.core

        length, message = struct.unpack_from("<IH", request)
        if message not in m.SENDABLE or length != len(request):
            raise ValueError(f"refusing to send message {message:#06x} to a T265: not on the list of safe ones")
        buffer = array.array("B", bytes(m.COMMAND_BUFFER))
        with self._lock:
            try:
                self.device.write(m.COMMAND_OUT, request, self._timing.command_ms)
                for last in (False, False, True):
                    got = self.device.read(m.COMMAND_IN, buffer, self._timing.command_ms)
                    try:
                        return protocol.response_payload(memoryview(buffer)[:got].tobytes(), message)
                    except protocol.ProtocolError:  # possibly the late answer to a command that timed out
                        if last:
                            raise
            except usb.core.USBTimeoutError:
                raise DeviceLost(f"{self.what} does not answer message {message:#06x}") from None
            except (usb.core.USBError, ValueError, LookupError) as error:
                raise device_error(error, f"{self.what}") from None
        raise AssertionError("unreachable")

    def read(self, endpoint: int, buffer: array.array[int], timeout_ms: int) -> int:
        """One transfer from an IN endpoint; 0 on timeout.

        Raises:
            DeviceLost, DeviceError.
        """
        import usb.core

        try:
            return self.device.read(endpoint, buffer, timeout_ms)
        except usb.core.USBTimeoutError:
            return 0
        except (usb.core.USBError, ValueError, LookupError) as error:
            raise device_error(error, self.what) from None

    def reset(self) -> None:
        """Vendor request that drops the camera to its boot state. It often disconnects during the answer."""
        import usb.core

        with self._lock:
            try:
                self.device.ctrl_transfer(0x40, 0x10, 0, 0, 0, self._timing.command_ms)
            except (usb.core.USBError, ValueError, LookupError):
                return

    def close(self) -> None:
        """Release the interface. Readers must have ended."""
        dispose(self.device)


def dispose(device: UsbDevice | Any) -> None:
    """Release pyusb's resources; errors of a disconnected camera are ignored."""
    import contextlib

    import usb.core
    import usb.util

    with contextlib.suppress(usb.core.USBError, ValueError, LookupError):
        usb.util.dispose_resources(device)
