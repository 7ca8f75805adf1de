"""A simulated T265 as a USB/IP server: a real kernel (vhci_hcd) sees a real USB device.

Protocol: Documentation/usb/usbip_protocol.rst of the Linux kernel; big-endian.
"""

from __future__ import annotations

import contextlib
import errno
import socket
import struct
import threading
from collections import deque
from dataclasses import dataclass

from stereo_sfm.drivers.t265 import messages as m
from stereo_sfm.drivers.t265.simulated.camera import Disconnected, SimulatedCamera
from tests.hardware.usb_descriptors import standard_request

VERSION = 0x0111
_REQ_DEVLIST, _REP_DEVLIST, _REQ_IMPORT, _REP_IMPORT = 0x8005, 0x0005, 0x8003, 0x0003
_CMD_SUBMIT, _CMD_UNLINK, _RET_SUBMIT, _RET_UNLINK = 1, 2, 3, 4
HIGH_SPEED, SUPER_SPEED = 3, 5  # enum usb_device_speed of the kernel
BUS_ID, BUS, DEVICE = b"1-1", 1, 2
_POLL_S = 0.05  # how often an idle endpoint looks whether it still has something to do


@dataclass
class _Urb:
    """One transfer request of the kernel."""

    number: int
    endpoint: int  # with the direction bit
    length: int
    setup: bytes
    data: bytes


class _Endpoint(threading.Thread):
    """Fills the requests on one IN endpoint, in order, with the camera's data."""

    def __init__(self, session: _Session, address: int) -> None:
        super().__init__(daemon=True, name=f"usbip-{address:02x}")
        self.session, self.address = session, address
        self.waiting: deque[_Urb] = deque()
        self.ready = threading.Condition()
        self._left = memoryview(b"")  # rest of a transfer that did not fit into one request

    def add(self, urb: _Urb) -> None:
        with self.ready:
            self.waiting.append(urb)
            self.ready.notify()

    def remove(self, number: int) -> bool:
        """Whether the request was still waiting."""
        with self.ready:
            found = next((u for u in self.waiting if u.number == number), None)
            if found is not None:
                self.waiting.remove(found)
            return found is not None

    def run(self) -> None:
        with contextlib.suppress(Disconnected, OSError):
            while self.session.alive:
                with self.ready:
                    if not self.ready.wait_for(lambda: self.waiting, _POLL_S):
                        continue
                if not self._left:
                    self._left = self._read()
                if self._left:
                    self._complete()
        self.session.close()

    def _read(self) -> memoryview:
        camera, generation = self.session.camera, self.session.generation
        if self.address == m.VIDEO_IN:
            pieces = camera.read_video(_POLL_S, generation)
            return memoryview(b"".join(pieces) if pieces else b"")
        if self.address == m.COMMAND_IN:
            return memoryview(camera.read_reply(_POLL_S, generation) or b"")
        return memoryview(camera.read_events(_POLL_S, generation, m.EVENT_BUFFER) or b"")

    def _complete(self) -> None:
        """Reply to one request; a cancellation waits meanwhile, since the kernel accepts no reply after its own."""
        with self.ready:
            if not self.waiting:
                return  # cancelled before: the next request gets the data, as on a real bus
            urb = self.waiting.popleft()
            piece, self._left = self._left[: urb.length], self._left[urb.length :]
            self.session.answer(urb, 0, bytes(piece))


class _Session:
    """One import by a kernel, until the camera leaves the bus or the kernel lets go."""

    def __init__(self, connection: socket.socket, camera: SimulatedCamera) -> None:
        self.connection, self.camera = connection, camera
        self.generation, self.booted = camera.generation, camera.booted
        self.alive = True
        self._sending = threading.Lock()
        self._endpoints = {a: _Endpoint(self, a) for a in (m.VIDEO_IN, m.COMMAND_IN, m.EVENT_IN)} if self.booted else {}

    def serve(self) -> None:
        """Requests until the end."""
        for endpoint in self._endpoints.values():
            endpoint.start()
        watch = threading.Thread(target=self._watch, daemon=True)
        watch.start()
        with contextlib.suppress(OSError, EOFError, Disconnected):
            while True:
                command, number, _, direction, endpoint = struct.unpack(">5I", _exactly(self.connection, 20))
                rest = _exactly(self.connection, 28)
                if command == _CMD_UNLINK:
                    self._unlink(number, struct.unpack_from(">I", rest)[0])
                    continue
                _, length = struct.unpack_from(">Ii", rest)
                data = b"" if direction else _exactly(self.connection, length)
                self._submit(_Urb(number, endpoint | (0x80 if direction else 0), length, rest[20:28], data))
        self.close()

    def _watch(self) -> None:
        """A disconnected camera closes its connection."""
        while self.alive and self.camera.generation == self.generation and self.camera.present:
            threading.Event().wait(_POLL_S)
        self.close()

    def close(self) -> None:
        self.alive = False
        with contextlib.suppress(OSError):
            self.connection.shutdown(socket.SHUT_RDWR)

    def answer(self, urb: _Urb, status: int, data: bytes = b"", taken: int | None = None) -> None:
        """RET_SUBMIT."""
        actual = len(data) if taken is None else taken
        head = struct.pack(">5I5i8x", _RET_SUBMIT, urb.number, 0, 0, 0, status, actual, 0, 0, 0)
        with self._sending:
            self.connection.sendall(head + data)

    def _unlink(self, number: int, target: int) -> None:
        found = sum(e.remove(target) for e in self._endpoints.values()) > 0
        status = -errno.ECONNRESET if found else 0
        with self._sending:
            self.connection.sendall(struct.pack(">5Ii24x", _RET_UNLINK, number, 0, 0, 0, status))

    def _submit(self, urb: _Urb) -> None:
        if urb.endpoint & 0x7F == 0:
            self._control(urb)
        elif urb.endpoint in self._endpoints:
            self._endpoints[urb.endpoint].add(urb)
        elif urb.endpoint == m.COMMAND_OUT and self.booted:
            self.camera.command(urb.data)
            self.answer(urb, 0, taken=len(urb.data))
        elif urb.endpoint == m.BOOT_OUT and not self.booted:
            self.answer(urb, 0, taken=len(urb.data))
            self.camera.take_firmware(urb.data)
        else:
            self.answer(urb, -errno.EPIPE)

    def _control(self, urb: _Urb) -> None:
        if urb.setup[:2] == b"\x40\x10":
            self.answer(urb, 0)
            self.camera.reset()
            return
        if urb.setup[:2] == b"\xc0\x11":
            self.answer(urb, 0, struct.pack("<II", 10, 0))
            return
        data = standard_request(urb.setup, self.booted, self.camera.serial)
        self.answer(urb, -errno.EPIPE if data is None else 0, data or b"", taken=None if data else 0)


def _exactly(connection: socket.socket, size: int) -> bytes:
    out = bytearray()
    while len(out) < size:
        piece = connection.recv(size - len(out))
        if not piece:
            raise EOFError
        out += piece
    return bytes(out)


class UsbIpServer:
    """Serves one camera; each import is one connection.

    Args:
        camera: the device. port: TCP port, 0 for any.
    """

    def __init__(self, camera: SimulatedCamera, port: int = 0) -> None:
        self._camera = camera
        self._socket = socket.create_server(("127.0.0.1", port))
        self.port: int = self._socket.getsockname()[1]
        threading.Thread(target=self._accept, daemon=True, name="usbip-accept").start()

    def close(self) -> None:
        """Stop accepting."""
        self._socket.close()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                connection, _ = self._socket.accept()
                connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                threading.Thread(target=self._talk, args=(connection,), daemon=True).start()

    def _talk(self, connection: socket.socket) -> None:
        with connection, contextlib.suppress(OSError, EOFError):
            _, code, _ = struct.unpack(">HHI", _exactly(connection, 8))
            if code == _REQ_DEVLIST:
                listed = [self._describe() + b"\xff\xff\xff\0"] if self._camera.present else []
                connection.sendall(struct.pack(">HHII", VERSION, _REP_DEVLIST, 0, len(listed)) + b"".join(listed))
            elif code == _REQ_IMPORT:
                wanted = _exactly(connection, 32).rstrip(b"\0")
                here = self._camera.present and wanted == BUS_ID
                connection.sendall(struct.pack(">HHI", VERSION, _REP_IMPORT, 0 if here else 1))
                if here:
                    connection.sendall(self._describe())
                    _Session(connection, self._camera).serve()

    def _describe(self) -> bytes:
        """struct usbip_usb_device."""
        booted = self._camera.booted
        vendor, product = m.RUN_IDS[0] if booted else m.BOOT_ID
        path = b"/sys/devices/simulated/usb1/1-1".ljust(256, b"\0")
        numbers = struct.pack(">3I3H6B", BUS, DEVICE, SUPER_SPEED if booted else HIGH_SPEED, vendor, product,
                              0xFFFF if booted else 1, 0, 0, 0, 1, 1, 1)  # fmt: skip
        return path + BUS_ID.ljust(32, b"\0") + numbers


def import_device(port: int) -> tuple[socket.socket, int, int] | None:
    """As a client: import the device.

    Returns:
        Connection to give to the kernel, device id, speed; None when the camera is not on the bus.
    """
    connection = socket.create_connection(("127.0.0.1", port))
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    connection.sendall(struct.pack(">HHI", VERSION, _REQ_IMPORT, 0) + BUS_ID.ljust(32, b"\0"))
    _, _, status = struct.unpack(">HHI", _exactly(connection, 8))
    if status:
        connection.close()
        return None
    described = _exactly(connection, 312)
    bus, number, speed = struct.unpack_from(">3I", described, 288)
    return connection, bus << 16 | number, speed
