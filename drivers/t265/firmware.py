"""The camera's firmware: locating and verifying the user's copy, and extracting it from librealsense.

The file belongs to Intel and may not be redistributed. librealsense 2.34 to 2.53.1 and the pyrealsense2 wheels of
these versions contain it: `stereo-sfm t265 firmware extract FILE`.
"""

from __future__ import annotations

import hashlib
import io
import os
import struct
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path

from stereo_sfm.drivers.live.errors import FirmwareMissing
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.input_file import read_bytes

VERSION = "0.2.0.951"
SIZE = 9_323_648
SHA1 = "c3940ccbb0e3045603e4aceaa2d73427f96e24bc"
FILE_NAME = f"target-{VERSION}.mvcmd"
ENVIRONMENT = "STEREO_SFM_T265_FIRMWARE"
MOST_UNPACKED = 512 << 20  # bytes of the libraries in a wheel, which have some 30 MB each
_MAGIC = b"MA2x"
OFFICIAL = frozenset({SHA1})


@dataclass(frozen=True)
class Firmware:
    """Verified firmware, created by `verified` only."""

    data: bytes


def verified(data: bytes, accepted: frozenset[str] = OFFICIAL, what: str = "this file") -> Firmware:
    """Firmware with a known SHA-1.

    Raises:
        FirmwareMissing: any other file.
    """
    digest = hashlib.sha1(data).hexdigest()
    if digest not in accepted:
        raise FirmwareMissing(
            f"{what} is not T265 firmware {VERSION}: SHA-1 {digest[:12]}..., expected {SHA1[:12]}... "
            "(get it with 'stereo-sfm t265 firmware extract FILE')"
        )
    return Firmware(data)


def default_path() -> Path:
    """The path where `extract` writes the file and the driver expects it."""
    base = Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config")
    return base / "stereo-sfm" / FILE_NAME


def find(path: str | Path | None = None) -> Path:
    """The user's firmware file: the given one, the environment's, or the one in the configuration folder.

    Raises:
        FirmwareMissing: the message says how to get it.
    """
    given = path or os.environ.get(ENVIRONMENT)
    candidate = Path(given).expanduser() if given else default_path()
    if candidate.is_file():
        return candidate
    raise FirmwareMissing(
        f"no T265 firmware at {candidate}: run 'stereo-sfm t265 firmware extract FILE' "
        f"on a pyrealsense2 2.53.1 wheel or librealsense2.so, or set {ENVIRONMENT}"
    )


def load(path: str | Path | None = None) -> Firmware:
    """Find, read and verify the firmware."""
    found = find(path)
    return verified(read_bytes(found), what=str(found))


# ---- extraction


def extract(source: Path, accepted: frozenset[str] = OFFICIAL) -> Firmware:
    """The firmware inside a librealsense library, a pyrealsense2 extension or wheel, or the firmware file itself.

    Raises:
        StereoSfmError: the file cannot be read, or contains no or another firmware.
    """
    try:
        members = _members(source)
    except (OSError, EOFError, RuntimeError, zipfile.BadZipFile, zlib.error) as error:
        raise StereoSfmError(f"cannot read {source}: {error}") from None
    versions: list[str] = []
    for data in members:
        version, blob = _from_elf(data)
        for candidate in [blob] if blob else _by_magic(data):
            if hashlib.sha1(candidate).hexdigest() in accepted:
                return Firmware(candidate)
        versions += [version] if version else []
    held = f"it contains firmware {', '.join(sorted(set(versions)))}" if versions else "it contains none"
    raise StereoSfmError(f"no T265 firmware {VERSION} in {source}: {held}. Use librealsense 2.34 to 2.53.1")


def _members(source: Path) -> list[bytes]:
    data = read_bytes(source)
    if not zipfile.is_zipfile(io.BytesIO(data)):
        return [data]
    with zipfile.ZipFile(io.BytesIO(data)) as wheel:
        ends = (".pyd", ".dll", ".dylib", ".mvcmd")
        members = [m for m in wheel.infolist() if ".so" in m.filename or m.filename.endswith(ends)]
        if sum(m.file_size for m in members) > MOST_UNPACKED:
            raise zipfile.BadZipFile(f"its libraries have more than {MOST_UNPACKED >> 20} MB")
        return [wheel.read(m) for m in members]


def _by_magic(data: bytes) -> list[bytes]:
    """Candidates of the right size with the firmware's first bytes (files without symbols)."""
    out: list[bytes] = []
    at = data.find(_MAGIC)
    while at >= 0 and at + SIZE <= len(data):
        out.append(data[at : at + SIZE])
        at = data.find(_MAGIC, at + 1)
    return out


def _from_elf(data: bytes) -> tuple[str, bytes]:
    """Version text and bytes by the symbols fw_target_version, _size, _data; empty where there are none."""
    try:
        symbols = _elf_symbols(data)
        size = struct.unpack_from("<I", data, symbols["fw_target_size"])[0]
        version = ".".join(str(v) for v in struct.unpack_from("<4i", data, symbols["fw_target_version"]))
        start = symbols["fw_target_data"]
    except (LookupError, OverflowError, struct.error):
        return "", b""
    return version, data[start : start + size]


def _elf_symbols(data: bytes) -> dict[str, int]:
    """Name -> file offset of the fw_target symbols of a little-endian 64-bit ELF file."""
    if data[:6] != b"\x7fELF\x02\x01":
        return {}
    phoff, shoff = struct.unpack_from("<QQ", data, 32)
    phsize, phnum, shsize, shnum = struct.unpack_from("<4H", data, 54)
    loads = [struct.unpack_from("<IIQQQQ", data, phoff + i * phsize) for i in range(phnum)]
    sections = [struct.unpack_from("<IIQQQQII", data, shoff + i * shsize) for i in range(shnum)]
    out: dict[str, int] = {}
    for _, kind, _, _, offset, size, link, _ in sections:
        if kind not in (2, 11):  # SYMTAB, DYNSYM
            continue
        names = sections[link][4]
        for at in range(offset, offset + size, 24):
            name_offset, _, _, _, value = struct.unpack_from("<IBBHQ", data, at)
            name = data[names + name_offset : names + name_offset + 24].split(b"\0")[0].decode("ascii", "replace")
            if name.startswith("fw_target_"):
                out.update((name, value - v + o) for t, _, o, v, _, n in loads if t == 1 and v <= value < v + n)
    return out
