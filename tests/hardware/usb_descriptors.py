"""The descriptors of a T265 as bytes, for a kernel that enumerates it. Facts: lsusb output in public issues."""

from __future__ import annotations

import struct

from stereo_sfm.drivers.t265 import messages as m

_DEVICE, _CONFIG, _STRING, _BOS = 1, 2, 3, 15
_BULK, _INTERRUPT = 2, 3
_RUN_ENDPOINTS = ((0x01, _BULK), (0x02, _BULK), (0x81, _BULK), (0x82, _BULK), (0x83, _INTERRUPT), (0x03, _INTERRUPT))
_STRINGS = {
    False: ("Movidius Ltd.", "Movidius MA2X5X", "03e72150"),
    True: ("Intel(R) Corporation", "Intel(R) RealSense(TM) Tracking Camera T265", ""),
}


def device(booted: bool) -> bytes:
    """18 bytes; SuperSpeed writes the packet size of endpoint 0 as a power of two."""
    vendor, product = m.RUN_IDS[0] if booted else m.BOOT_ID
    version, packet = (0x0310, 9) if booted else (0x0200, 64)
    number = 0xFFFF if booted else 0x0001
    return struct.pack("<BBHBBBBHHHBBBB", 18, _DEVICE, version, 0, 0, 0, packet, vendor, product, number, 1, 2, 3, 1)


def configuration(booted: bool) -> bytes:
    """Configuration, one vendor interface, its endpoints (with companions on SuperSpeed)."""
    endpoints = b""
    for address, kind in _RUN_ENDPOINTS if booted else _RUN_ENDPOINTS[:1]:
        packet = (1024 if kind == _BULK else 64) if booted else 512
        endpoints += struct.pack("<BBBBHB", 7, 5, address, kind, packet, 1 if kind == _INTERRUPT else 0)
        if booted:
            endpoints += struct.pack("<BBBBH", 6, 0x30, 0, 0, packet if kind == _INTERRUPT else 0)
    interface = struct.pack("<9B", 9, 4, 0, 0, len(_RUN_ENDPOINTS) if booted else 1, 0xFF, 0xFF, 0xFF, 0)
    total = 9 + len(interface) + len(endpoints)
    return struct.pack("<BBHBBBBB", 9, _CONFIG, total, 1, 1, 0, 0x80, 250) + interface + endpoints


def bos() -> bytes:
    """The descriptors of a SuperSpeed device."""
    usb2 = struct.pack("<BBBI", 7, 16, 2, 2)
    usb3 = struct.pack("<BBBBHBBH", 10, 16, 3, 0, 0x0E, 3, 10, 32)
    return struct.pack("<BBHB", 5, _BOS, 5 + len(usb2) + len(usb3), 2) + usb2 + usb3


def string(index: int, booted: bool, serial: str) -> bytes | None:
    """Language list, or one of the three texts."""
    if index == 0:
        return struct.pack("<BBH", 4, _STRING, 0x0409)
    texts = _STRINGS[booted]
    if not 1 <= index <= 3:
        return None
    text = ((*texts[:2], serial if booted else texts[2])[index - 1]).encode("utf-16-le")
    return struct.pack("<BB", 2 + len(text), _STRING) + text


def standard_request(setup: bytes, booted: bool, serial: str) -> bytes | None:
    """Answer of a standard control request; None: stall."""
    kind, request, value, _, length = struct.unpack("<BBHHH", setup)
    if request == 6 and kind & 0x80:  # GET_DESCRIPTOR
        which, index = value >> 8, value & 0xFF
        data = {
            _DEVICE: lambda: device(booted),
            _CONFIG: lambda: configuration(booted) if index == 0 else None,
            _STRING: lambda: string(index, booted, serial),
            _BOS: lambda: bos() if booted else None,
        }.get(which, lambda: None)()
        return None if data is None else data[:length]
    if request == 0 and kind & 0x80:  # GET_STATUS
        return b"\0\0"[:length]
    if request == 8:  # GET_CONFIGURATION
        return b"\x01"
    return b""  # SET_CONFIGURATION, SET_FEATURE, SET_SEL, ...: fine
