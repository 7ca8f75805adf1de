# pyright: reportIncompatibleMethodOverride=false
"""The USB bus: simulated cameras behind pyusb's backend interface, with libusb's errors."""

from __future__ import annotations

import array
import errno
import threading
import time
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import usb.backend
import usb.core

from stereo_sfm.drivers.t265 import messages as m
from stereo_sfm.drivers.t265.simulated.camera import Disconnected, SimulatedCamera

_ENDPOINTS = ((0x01, 2), (0x02, 2), (0x81, 2), (0x82, 2), (0x83, 3), (0x03, 3))  # address, type: bulk 2, interrupt 3


def usb_error(number: int, text: str) -> usb.core.USBError:
    """An error as raised by pyusb's libusb backend."""
    if number == errno.ETIMEDOUT:
        return usb.core.USBTimeoutError(text, -7, number)
    return usb.core.USBError(text, -1, number)


class _Attached:
    """One appearance of a camera on the bus: what pyusb calls a device, and its open handle."""

    def __init__(self, camera: SimulatedCamera, port: int) -> None:
        self.camera, self.port, self.generation = camera, port, camera.generation
        self.booted = camera.booted
        self.configuration = 1

    @property
    def here(self) -> bool:
        return self.camera.present and self.camera.generation == self.generation


class SimulatedBus(usb.backend.IBackend):
    """Pass it as `backend` to `usb.core.find`.

    Args:
        cameras: each on its own port; unbooted ones appear on bus 1, running ones on bus 2.
    """

    def __init__(self, cameras: Sequence[SimulatedCamera]) -> None:
        self.cameras = list(cameras)
        self._claimed: dict[int, int] = {}  # camera -> generation
        self._lock = threading.Lock()
        self.thread_ns = 0  # CPU time spent here, to be subtracted from the driver's

    # ---- enumeration

    def enumerate_devices(self) -> Any:
        return iter([_Attached(c, port) for port, c in enumerate(self.cameras, 1) if c.present])

    def get_parent(self, dev: _Attached) -> None:
        return None

    def get_device_descriptor(self, dev: _Attached) -> Any:
        vendor, product = m.RUN_IDS[0] if dev.booted else m.BOOT_ID
        return SimpleNamespace(
            bLength=18, bDescriptorType=1, bcdUSB=0x0300 if dev.booted else 0x0200, bDeviceClass=0, bDeviceSubClass=0,
            bDeviceProtocol=0, bMaxPacketSize0=9 if dev.booted else 64, idVendor=vendor, idProduct=product,
            bcdDevice=0xFFFF if dev.booted else 1, iManufacturer=0, iProduct=0, iSerialNumber=0, bNumConfigurations=1,
            address=(16 * dev.port + dev.generation) % 128, bus=2 if dev.booted else 1, port_number=dev.port,
            port_numbers=(dev.port,), speed=dev.camera.faults.speed if dev.booted else 3, extra_descriptors=[],
        )  # fmt: skip

    def get_configuration_descriptor(self, dev: _Attached, config: int) -> Any:
        if config:
            raise IndexError("one configuration only")
        return SimpleNamespace(
            bLength=9, bDescriptorType=2, wTotalLength=9, bNumInterfaces=1, bConfigurationValue=1, iConfiguration=0,
            bmAttributes=0x80, bMaxPower=250, extra_descriptors=[],
        )  # fmt: skip

    def get_interface_descriptor(self, dev: _Attached, intf: int, alt: int, config: int) -> Any:
        if intf or alt or config:
            raise IndexError("one interface only")
        return SimpleNamespace(
            bLength=9, bDescriptorType=4, bInterfaceNumber=0, bAlternateSetting=0,
            bNumEndpoints=len(_ENDPOINTS) if dev.booted else 1, bInterfaceClass=0xFF, bInterfaceSubClass=0xFF,
            bInterfaceProtocol=0xFF, iInterface=0, extra_descriptors=[],
        )  # fmt: skip

    def get_endpoint_descriptor(self, dev: _Attached, ep: int, intf: int, alt: int, config: int) -> Any:
        address, kind = _ENDPOINTS[: 6 if dev.booted else 1][ep]
        return SimpleNamespace(
            bLength=7, bDescriptorType=5, bEndpointAddress=address, bmAttributes=kind, wMaxPacketSize=1024,
            bInterval=1, bRefresh=0, bSynchAddress=0, extra_descriptors=[],
        )  # fmt: skip

    # ---- handles

    def open_device(self, dev: _Attached) -> _Attached:
        self._alive(dev)
        if dev.camera.faults.refuse_open:
            raise usb_error(dev.camera.faults.refuse_open, "Access denied (insufficient permissions)")
        return dev

    def close_device(self, dev_handle: _Attached) -> None:
        return None

    def get_configuration(self, dev_handle: _Attached) -> int:
        self._alive(dev_handle)
        return dev_handle.configuration

    def set_configuration(self, dev_handle: _Attached, config_value: int) -> None:
        self._alive(dev_handle)
        dev_handle.configuration = config_value

    def claim_interface(self, dev_handle: _Attached, intf: int) -> None:
        self._alive(dev_handle)
        key, generation = id(dev_handle.camera), dev_handle.generation
        with self._lock:
            if dev_handle.camera.faults.refuse_claim or self._claimed.get(key) == generation:
                raise usb_error(dev_handle.camera.faults.refuse_claim or errno.EBUSY, "Resource busy")
            self._claimed[key] = generation

    def release_interface(self, dev_handle: _Attached, intf: int) -> None:
        with self._lock:
            if self._claimed.get(id(dev_handle.camera)) == dev_handle.generation:
                del self._claimed[id(dev_handle.camera)]
        self._alive(dev_handle)

    def _alive(self, dev: _Attached) -> None:
        if not dev.here:
            raise usb_error(errno.ENODEV, "No such device (it may have been disconnected)")

    # ---- transfers

    def bulk_write(self, dev_handle: _Attached, ep: int, intf: int, data: Any, timeout: int) -> int:
        self._alive(dev_handle)
        if not dev_handle.booted:
            return dev_handle.camera.take_firmware(bytes(data))
        if ep == m.COMMAND_OUT:
            dev_handle.camera.command(bytes(data))
        return len(data)

    def bulk_read(self, dev_handle: _Attached, ep: int, intf: int, buff: array.array[int], timeout: int) -> int:
        self._alive(dev_handle)
        began = time.thread_time_ns()
        camera, generation, wait = dev_handle.camera, dev_handle.generation, timeout / 1e3
        try:
            if ep == m.VIDEO_IN:
                return self._fill(buff, camera.read_video(wait, generation))
            reply = camera.read_reply(wait, generation)
            return self._fill(buff, None if reply is None else [reply])
        except Disconnected:
            raise usb_error(errno.ENODEV, "No such device (it may have been disconnected)") from None
        finally:
            self.thread_ns += time.thread_time_ns() - began

    def intr_read(self, dev_handle: _Attached, ep: int, intf: int, buff: array.array[int], timeout: int) -> int:
        self._alive(dev_handle)
        began = time.thread_time_ns()
        try:
            data = dev_handle.camera.read_events(timeout / 1e3, dev_handle.generation, len(buff))
        except Disconnected:
            raise usb_error(errno.ENODEV, "No such device (it may have been disconnected)") from None
        finally:
            self.thread_ns += time.thread_time_ns() - began
        return self._fill(buff, None if data is None else [data])

    @staticmethod
    def _fill(buff: array.array[int], chunks: Sequence[bytes | memoryview] | None) -> int:
        if chunks is None:
            raise usb_error(errno.ETIMEDOUT, "Operation timed out")
        view, at = memoryview(buff), 0
        for chunk in chunks:
            if at + len(chunk) > len(view):
                raise usb_error(errno.EOVERFLOW, "Overflow")
            view[at : at + len(chunk)] = chunk
            at += len(chunk)
        return at

    def ctrl_transfer(
        self,
        dev_handle: _Attached,
        bmRequestType: int,
        bRequest: int,
        wValue: int,
        wIndex: int,
        data: Any,
        timeout: int,
    ) -> int:
        self._alive(dev_handle)
        if (bmRequestType, bRequest) == (0x40, 0x10):
            dev_handle.camera.reset()
            raise usb_error(errno.EPIPE, "Pipe error")  # as a real camera
        if (bmRequestType, bRequest) == (0xC0, 0x11):
            return self._fill(data, [(10).to_bytes(4, "little") + bytes(4)])
        raise usb_error(errno.EPIPE, "Pipe error")
