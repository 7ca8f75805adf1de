"""The content of compressed chunks, messages and files up to a limit, in place of the library's own, which has none."""

from __future__ import annotations

import bz2
import shutil
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import IO, Any

import lz4.frame
import zstandard

from stereo_sfm.drivers.rosbag.checked import INFORMATION, METADATA, check_bag
from stereo_sfm.input_file import open_regular
from stereo_sfm.log.chunks import MAX_BYTES

BLOCK = 1 << 20  # bytes that are unpacked at a time
MOST_TIMES = 100  # the bytes of a compressed file; raw images of three real sequences are 1.2 to 1.7 times theirs


def _from_bz2(data: bytes) -> bytes:
    return _within(bz2.BZ2Decompressor().decompress(data, MAX_BYTES + 1))


def _from_lz4(data: bytes) -> bytes:
    return _within(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=MAX_BYTES + 1))


def from_zstd(data: bytes) -> bytes:
    """A frame's content.

    Raises:
        ValueError: it is larger than `MAX_BYTES`. ZstdError: it is damaged.
    """
    if zstandard.frame_content_size(data) > MAX_BYTES:  # the decompressor allocates what the frame states
        raise _too_large()
    return zstandard.ZstdDecompressor().decompress(data, max_output_size=MAX_BYTES)


def _within(content: bytes) -> bytes:
    if len(content) > MAX_BYTES:
        raise _too_large()
    return content


def _too_large() -> ValueError:
    return ValueError(f"a compressed part has more than {MAX_BYTES} bytes")


_LIMITED: dict[Any, Callable[[bytes], bytes]] = {bz2.decompress: _from_bz2, lz4.frame.decompress: _from_lz4}


def limit_chunks(reader: Any) -> None:
    """Let an open reader of a ROS 1 bag decompress its chunks within the limit."""
    reader.chunks = {
        at: chunk._replace(decompressor=_LIMITED.get(chunk.decompressor, chunk.decompressor))
        for at, chunk in reader.chunks.items()
    }


def limit_chunks_of_mcap() -> None:
    """Let the readers of .mcap files decompress their chunks within the limit."""
    from rosbags.rosbag2 import storage_mcap

    storage_mcap.DECOMPRESSORS.update(lz4=lambda data, _: _from_lz4(data), zstd=lambda data, _: from_zstd(data))


def unpacked_files(path: Path, metadata: dict[str, Any], opened: ExitStack) -> Path:
    """A bag whose files are compressed as wholes, without that; any other is returned as it is.

    Args:
        path: the bag. metadata: of `check_bag`. opened: keeps the unpacked files.

    Raises:
        ValueError: they hold more than `MOST_TIMES` their bytes, or than half the free space; as `check_bag`.
        ZstdError: damaged files. OSError: they cannot be read, or written.
    """
    about = metadata.get(INFORMATION, {})
    if str(about.get("compression_mode")).lower() != "file":
        return path
    import yaml

    folder = Path(opened.enter_context(TemporaryDirectory(prefix="bag")))
    free, names = shutil.disk_usage(folder).free // 2, [Path(str(name)) for name in about["relative_file_paths"]]
    for name in names:
        if not (path / name.name).is_file():
            raise ValueError(f"its file {name.name} is missing")
        with open_regular(path / name.name) as packed, (folder / name.stem).open("wb") as out:
            free -= _unpack(packed, out, min(free, MOST_TIMES * (path / name.name).stat().st_size))
    about.update(compression_mode="", compression_format="", relative_file_paths=[name.stem for name in names])
    (folder / METADATA).write_text(yaml.safe_dump(metadata), "utf-8")
    check_bag(folder)
    return folder


def _unpack(packed: IO[bytes], out: IO[bytes], most: int) -> int:
    """The bytes written."""
    done = 0
    with zstandard.ZstdDecompressor().stream_reader(packed, read_across_frames=True) as content:
        while block := content.read(BLOCK):
            done += len(block)
            if done > most:
                raise ValueError(
                    f"unpacked, a file would have more than {most / 1e6:.1f} MB; temporary files are in TMPDIR"
                )
            out.write(block)
    return done


def take_unpacking(reader: Any) -> bool:
    """Whether the messages of an open reader of a rosbag2 are compressed one by one: it then gives them as they are."""
    about = reader.storage.metadata
    packed = about.compression_mode == "message"
    if packed:
        reader.storage.metadata = about._replace(compression_mode=None)
    return packed
