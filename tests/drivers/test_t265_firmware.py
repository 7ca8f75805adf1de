"""Extraction of the firmware from files like those of librealsense, and rejection of all others."""

from __future__ import annotations

import hashlib
import struct
import zipfile
from pathlib import Path

import pytest

from stereo_sfm import cli
from stereo_sfm.drivers.t265 import firmware
from stereo_sfm.errors import StereoSfmError

BLOB = b"MA2x" + bytes(range(256)) * ((firmware.SIZE - 4) // 256 + 1)
BLOB = BLOB[: firmware.SIZE]
ACCEPTED = frozenset({hashlib.sha1(BLOB).hexdigest()})


def library(blob: bytes, version: tuple[int, int, int, int]) -> bytes:
    """A minimal 64-bit ELF file with the three symbols, data loaded at another address than its offset."""
    names = b"\0fw_target_data\0fw_target_size\0fw_target_version\0other\0"
    data = struct.pack("<I4i", len(blob), *version) + blob
    header, phdr, section = 64, 56, 64
    at_names = header + phdr
    at_symbols = at_names + len(names)
    symbol = [
        struct.pack("<IBBHQQ", names.index(n) if n else 0, 0x11, 0, 1, 0x200000 + at if n else 0, 0)
        for n, at in zip((b"", b"fw_target_data", b"fw_target_size", b"fw_target_version"), (0, 20, 0, 4), strict=True)
    ]
    at_data = at_symbols + 24 * len(symbol)
    at_sections = at_data + len(data)
    elf = b"\x7fELF\x02\x01\x01" + bytes(9)
    elf += struct.pack("<HHIQQQIHHHHHH", 3, 62, 1, 0, header, at_sections, 0, header, phdr, 1, section, 3, 0)
    elf += struct.pack("<IIQQQQQQ", 1, 6, at_data, 0x200000, 0x200000, len(data), len(data), 4096)
    elf += names + b"".join(symbol) + data
    elf += bytes(section)
    elf += struct.pack("<IIQQQQIIQQ", 0, 11, 0, 0, at_symbols, 24 * len(symbol), 2, 0, 8, 24)
    return elf + struct.pack("<IIQQQQIIQQ", 0, 3, 0, 0, at_names, len(names), 0, 0, 1, 0)


def test_by_symbols(tmp_path: Path) -> None:
    path = tmp_path / "librealsense2.so"
    path.write_bytes(library(BLOB, (0, 2, 0, 951)))
    version, data = firmware._from_elf(path.read_bytes())
    assert (version, data == BLOB) == ("0.2.0.951", True)
    assert firmware.extract(path, ACCEPTED).data == BLOB


def test_another_version_is_named(tmp_path: Path) -> None:
    path = tmp_path / "librealsense2.so"
    path.write_bytes(library(BLOB[:1000], (0, 1, 0, 279)))
    with pytest.raises(StereoSfmError, match=r"contains firmware 0\.1\.0\.279"):
        firmware.extract(path, ACCEPTED)


def test_a_wheel_and_files_without_symbols(tmp_path: Path) -> None:
    wheel = tmp_path / "pyrealsense2-2.53.1-cp39-cp39-win_amd64.whl"
    with zipfile.ZipFile(wheel, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("pyrealsense2/__init__.py", "")
        archive.writestr("pyrealsense2/pyrealsense2.pyd", b"MZ" + b"MA2x" + bytes(50) + BLOB + b"tail")
    assert firmware.extract(wheel, ACCEPTED).data == BLOB
    plain = tmp_path / firmware.FILE_NAME
    plain.write_bytes(BLOB)
    assert firmware.extract(plain, ACCEPTED).data == BLOB


@pytest.mark.parametrize(
    "content", [b"", b"text", b"\x7fELF\x02\x01", b"\x7fELF\x02\x01" + b"\xff" * 200, b"MA2x", BLOB]
)
def test_files_without_the_firmware(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "file"
    path.write_bytes(content)
    with pytest.raises(StereoSfmError, match=r"no T265 firmware 0\.2\.0\.951") as caught:
        firmware.extract(path)
    assert "\n" not in str(caught.value)


def test_a_wheel_that_unpacks_to_too_much(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    wheel = tmp_path / "pyrealsense2.whl"
    with zipfile.ZipFile(wheel, "w", zipfile.ZIP_DEFLATED) as archive:
        for number in range(3):
            archive.writestr(f"{number}.so", bytes(1 << 20))
    monkeypatch.setattr(firmware, "MOST_UNPACKED", (3 << 20) - 1)
    with pytest.raises(StereoSfmError, match=r"cannot read .*whl: its libraries have more than 2 MB"):
        firmware.extract(wheel)


@pytest.mark.parametrize("at", [30, 60, 100, 130])
def test_a_damaged_wheel(at: int, tmp_path: Path) -> None:
    wheel = tmp_path / "pyrealsense2.whl"
    with zipfile.ZipFile(wheel, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.so", bytes(range(256)))
    data = bytearray(wheel.read_bytes())
    for place in (at, data.index(b"PK\x01\x02") + 8):  # bytes of the library, and the flags of the list: encrypted
        data[place] ^= 1
        wheel.write_bytes(data)
        with pytest.raises(StereoSfmError, match="cannot read"):
            firmware.extract(wheel)


def test_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    monkeypatch.delenv(firmware.ENVIRONMENT, raising=False)
    monkeypatch.setattr(firmware, "extract", lambda path: firmware.Firmware(BLOB))
    assert cli.main(["t265", "firmware", "check"]) == 2
    assert cli.main(["t265", "firmware", "extract", "x.whl"]) == 0
    assert firmware.default_path().read_bytes() == BLOB
    assert cli.main(["t265", "firmware", "extract", "x.whl"]) == 2
    assert cli.main(["t265", "firmware", "check"]) == 2  # it is not the real one
    message = capsys.readouterr()
    assert "written to" in message.out
    assert "--overwrite" in message.err and "is not T265 firmware" in message.err


def test_no_firmware_is_in_this_repository() -> None:
    root = Path(firmware.__file__).parents[2]
    big = [p for p in (*root.glob("drivers/**/*"), *root.glob("tests/**/*")) if p.is_file() and p.stat().st_size > 5e6]
    assert not [p for p in big if p.read_bytes()[:4] == b"MA2x"]
