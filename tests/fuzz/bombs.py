"""Small files that expand to gigabytes or to minutes of work, and maps with valid checksums and invalid content."""

from __future__ import annotations

import hashlib
import io
import json
import random
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import lz4.frame
import numpy as np
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Chunk
from mcap.writer import MCAP0_MAGIC, Writer

from stereo_sfm.log.image_log import RIG_FILE, TRUTH_FILE
from stereo_sfm.log.provenance import CONFIG_FILE, TOTALS
from stereo_sfm.log.repair import spans
from tests.drivers.dataset_folders import RIG, make_images

Case = tuple[str, list[str]]
GIB = 1 << 30
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"


def zstd_zeros(size: int, state_size: bool = True) -> bytes:
    """A zstd frame of zeros, made chunk by chunk."""
    out = zstandard.ZstdCompressor(write_content_size=state_size).compressobj(size if state_size else -1)
    pieces = [out.compress(bytes(1 << 24)) for _ in range(size >> 24)]
    return b"".join(pieces) + out.flush()


def lz4_zeros(size: int) -> bytes:
    """An lz4 frame of zeros."""
    out = lz4.frame.LZ4FrameCompressor()
    return out.begin() + b"".join(out.compress(bytes(1 << 24)) for _ in range(size >> 24)) + out.flush()


def _file(*chunks: Chunk) -> bytes:
    builder = RecordBuilder()
    for chunk in chunks:
        chunk.write(builder)
    return MCAP0_MAGIC + builder.end()


def _chunk(compression: str, data: bytes, size: int) -> Chunk:
    return Chunk(compression, data, 0, 0, 0, size)


def _empty_records(count: int) -> bytes:
    return zstandard.compress(struct.pack("<BQ", 0x80, 0) * count)


def _with_attachment(path: Path, source: Path, name: str, data: bytes) -> None:
    from mcap.reader import make_reader

    with source.open("rb") as stream, path.open("wb") as out:
        reader, writer = make_reader(stream), Writer(out)
        writer.start()
        ids: dict[int, int] = {}
        for schema, channel, m in reader.iter_messages():
            if channel.id not in ids:
                to = writer.register_schema(schema.name, schema.encoding, schema.data) if schema else 0
                ids[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, to)
            writer.add_message(ids[channel.id], m.log_time, m.data, m.publish_time, m.sequence)
        for a in reader.iter_attachments():
            content = data if a.name == name else a.data
            writer.add_attachment(a.create_time, a.log_time, a.name, a.media_type, content)
        if name not in (RIG_FILE, TRUTH_FILE):
            writer.add_attachment(0, 0, name, "", data)
        for m in reader.iter_metadata():
            writer.add_metadata(m.name, {} if name == TOTALS and m.name == TOTALS else m.metadata)
        writer.finish()


def _lying_summary(source: Path) -> bytes:
    """Its footer points to the chunks as if they were the summary."""
    raw = bytearray(source.read_bytes())
    with source.open("rb") as stream:
        first = next(s for s in spans(stream) if s.opcode == Opcode.CHUNK)
    footer = len(raw) - len(MCAP0_MAGIC) - 29
    struct.pack_into("<QQI", raw, footer + 9, first.offset, 0, 0)
    return bytes(raw)


def _huge_index(source: Path) -> bytes:
    """Every offset and length of the summary section is as large as it can be."""
    raw = bytearray(source.read_bytes())
    with source.open("rb") as stream:
        for span in spans(stream):
            if span.opcode in (Opcode.CHUNK_INDEX, Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX):
                at = span.offset + 9 + (16 if span.opcode == Opcode.CHUNK_INDEX else 0)
                raw[at : at + 16] = b"\xff" * 7 + b"\x7f" + b"\xff" * 7 + b"\x7f"
    footer = len(raw) - len(MCAP0_MAGIC) - 29
    raw[footer + 25 : footer + 29] = bytes(4)  # no checksum
    return bytes(raw)


def _holes(path: Path, index: bool) -> None:
    """A closed file with a schema of 3 GiB that takes no disk; it is all of the index, or stands before it."""
    with path.open("wb") as out:
        out.write(MCAP0_MAGIC + struct.pack("<BQ", Opcode.SCHEMA, 3 * GIB))
        out.seek(3 * GIB, io.SEEK_CUR)
        out.write(struct.pack("<BQQQI", Opcode.FOOTER, 20, len(MCAP0_MAGIC) * index, 0, 0) + MCAP0_MAGIC)


def recordings(folder: Path, sources: list[Path]) -> list[Case]:
    """Chunks, indexes and attachments of MCAP files."""
    own = sources[0]
    big, small = 2 * GIB, 1 << 20
    raw = {
        "zstd of 2 GiB, stated": _file(_chunk("zstd", zstd_zeros(big), big)),
        "zstd of 2 GiB, stated 1 MiB": _file(_chunk("zstd", zstd_zeros(big), small)),
        "zstd of 2 GiB, not stated by itself": _file(_chunk("zstd", zstd_zeros(big, False), small)),
        "zstd frame that states 2^60": _file(
            _chunk("zstd", b"\x28\xb5\x2f\xfd\xe0" + struct.pack("<Q", 1 << 60), small)
        ),
        "lz4 of 1 GiB, stated": _file(_chunk("lz4", lz4_zeros(GIB), GIB)),
        "lz4 of 1 GiB, stated 1 MiB": _file(_chunk("lz4", lz4_zeros(GIB), small)),
        "2^63 bytes stated": _file(_chunk("", b"", 1 << 63)),
        "four million records": _file(_chunk("zstd", _empty_records(4_000_000), 36_000_000)),
        "ten times 192 MiB": _file(*[_chunk("zstd", zstd_zeros(192 << 20), 192 << 20)] * 10),
        "summary of chunks": _lying_summary(own),
        "huge index": _huge_index(own),
        "record of 2^63": MCAP0_MAGIC + struct.pack("<BQ", Opcode.CHUNK, (1 << 63) - 1) + bytes(100),
        "chunk with data of 2^62": MCAP0_MAGIC
        + struct.pack("<BQ", Opcode.CHUNK, 48)
        + struct.pack("<QQQIIQ", 0, 0, 9, 0, 0, 1 << 62)
        + bytes(8),
    }
    aliases = "stereo_sfm_rig: 1\n" + _aliases() + "left: *n\n"
    attached = {
        "rig of aliases": (RIG_FILE, aliases.encode()),
        "rig of brackets": (RIG_FILE, b"stereo_sfm_rig: 1\nleft: " + b"[" * 100_000),
        "truth of 2 GiB": (TRUTH_FILE, npz_zeros(2 * GIB)),
        "truth whose header states 2^50": (TRUTH_FILE, npz({"stamp_ns": npy_header(1 << 50), "poses": npy_header(1)})),
        "truth of texts": (TRUTH_FILE, npz({"stamp_ns": npy(np.array(["a"])), "poses": npy(np.array(["b"]))})),
        "truth of another shape": (TRUTH_FILE, npz({"stamp_ns": npy(np.zeros(3, int)), "poses": npy(np.eye(4))})),
        "configuration of brackets": (CONFIG_FILE, b"a = " + b"[" * 100_000),
        "configuration that is no text": (CONFIG_FILE, b"\xff\xfe\x00"),
        "totals without numbers": (TOTALS, b""),
    }
    cases: list[Case] = []
    for i, (name, data) in enumerate(raw.items()):
        path = folder / f"r{i}.mcap"
        path.write_bytes(data)
        cases += [(name, ["info", str(path)]), (name, ["recover", str(path), "-o", str(folder / f"m{i}.mcap")])]
    for name, index in (("holes", False), ("an index of holes", True)):
        path = folder / f"h{index:d}.mcap"
        _holes(path, index)
        cases += [(name, ["info", str(path)]), (name, ["recover", str(path), "-o", str(folder / f"mh{index:d}.mcap")])]
    for i, (name, (kind, data)) in enumerate(attached.items()):
        path = folder / f"a{i}.mcap"
        _with_attachment(path, own, kind, data)
        cases += [(name, ["info", str(path)]), (name, ["frames", str(path)])]
    return cases


def huge_png(width: int, height: int) -> bytes:
    """A PNG whose header is right and whose pixels are missing."""
    head = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    data = b"IDAT" + zlib.compress(bytes(1000))
    chunks = [struct.pack(">I", len(c) - 4) + c + struct.pack(">I", zlib.crc32(c)) for c in (head, data, b"IEND")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)


def huge_jpeg(width: int, height: int) -> bytes:
    """A JPEG whose header states another size."""
    small = cv2.imencode(".jpg", np.zeros((8, 8), np.uint8))[1].tobytes()
    at = small.index(b"\xff\xc0")
    return small[: at + 5] + struct.pack(">HH", height, width) + small[at + 9 :]


def images(folder: Path) -> list[Case]:
    """Image folders whose files state sizes that no camera has."""
    files = {
        "png of 60,000 px": huge_png(60_000, 60_000),
        "png of 20,000 px": huge_png(20_000, 20_000),
        "png of 2^31 px": huge_png(2**31 - 1, 2**31 - 1),
        "png of no px": huge_png(0, 0),
        "jpeg of 60,000 px": huge_jpeg(60_000, 60_000),
        "jpeg of 65,535 px": huge_jpeg(65_535, 65_535),
        "pgm of 60,000 px": b"P5\n60000 60000\n255\n" + bytes(100),
        "tiff of 2^30 px": _tiff(1 << 30),
        "bmp of 60,000 px": b"BM"
        + struct.pack("<IIIIiiHHIIiiII", 100, 0, 54, 40, 60_000, 60_000, 1, 24, 0, 0, 0, 0, 0, 0),
    }
    cases: list[Case] = []
    for i, (name, data) in enumerate(files.items()):
        root = make_images(folder / f"i{i}", ["0.png", "1.png"])
        for path in root.glob("*/*.png"):
            path.write_bytes(data)
        cases += [(name, ["frames", str(root)]), (name, ["info", str(root)])]
    return cases


def _tiff(size: int) -> bytes:
    tags = [(256, size), (257, size), (258, 8), (259, 1), (262, 1), (273, 8), (278, size), (279, 64)]
    entries = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags)
    return b"II*\0" + struct.pack("<IH", 8, len(tags)) + entries + bytes(100)


def _aliases() -> str:
    return "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
        f"{b}: &{b} [{', '.join([f'*{a}'] * 9)}]\n" for a, b in zip("abcdefghijklm", "bcdefghijklmn", strict=True)
    )


def calibrations(folder: Path) -> list[Case]:
    """Texts that expand to more than a calibration."""
    laughs = "".join(f'<!ENTITY l{i} "{f"&l{i - 1};" * 10}">' for i in range(1, 10))
    texts = {
        "rig.yaml": "stereo_sfm_rig: 1\n" + _aliases() + "left: *n\n",
        "brackets.yaml": "cam0: " + "[" * 200_000,
        "braces.yaml": "cam0: " + "{a: " * 50_000,
        "itself.yaml": "cam0: &a {camera_model: pinhole, intrinsics: *a, resolution: *a}\n",
        "merge.yaml": "cam0: &a\n  <<: *a\n",
        "sexagesimal.yaml": "cam0: {intrinsics: [1" + ":59" * 100_000 + "]}\n",
        "long.yaml": "cam0: [" + "1, " * 150_000 + "1]\n",
        "spaces.yaml": "cam0:" + " " * (8 << 20),
        "size.yaml": RIG.replace("[64, 48]", "[1000000000, 1000000000]"),
        "exponent.yaml": RIG.replace("[64, 48]", "[1e300, 1e300]"),
        "brackets.json": '{"K": ' + "[" * 200_000,
        "number.json": '{"K": ' + "9" * 1_000_000 + "}",
        "matrix.yml": "%YAML:1.0\n---\nM1: !!opencv-matrix\n  rows: 90000\n  cols: 90000\n  dt: d\n  data: [1]\n",
        "laughs.xml": f'<!DOCTYPE x [<!ENTITY l0 "haha">{laughs}]>\n<opencv_storage><M1>&l9;</M1></opencv_storage>',
        "deep.xml": "<opencv_storage>" + "<a>" * 100_000,
    }
    for name, text in texts.items():
        (folder / name).write_text(text)
    output = str(folder / "out.yaml")
    return [(n, ["convert-calib", str(folder / n), output, "--to", "rig", "--overwrite"]) for n in texts]


def npy_header(rows: int) -> bytes:
    """A header for so many numbers, and none of them."""
    out = io.BytesIO()
    np.lib.format.write_array_header_1_0(out, {"descr": "<i8", "fortran_order": False, "shape": (rows,)})
    return out.getvalue()


def npy(array: Any) -> bytes:
    """An array as np.save writes it."""
    out = io.BytesIO()
    np.save(out, array)
    return out.getvalue()


def npz(files: dict[str, bytes]) -> bytes:
    """Arrays in one file."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in files.items():
            archive.writestr(f"{name}.npy", data)
    return out.getvalue()


def npz_zeros(size: int) -> bytes:
    """An npz file of zeros, made chunk by chunk."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name in ("stamp_ns", "poses"):
            with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
                entry.write(npy_header(size // 16))
                for _ in range(size >> 25):
                    entry.write(bytes(1 << 24))
    return out.getvalue()


def _sign(folder: Path) -> None:
    """Make the checksums of a map those of its files."""
    head = json.loads((folder / "map.json").read_text())
    for name in head["sha256"]:
        path = next(folder / f"{name}{end}" for end in (".npz", ".yaml") if (folder / f"{name}{end}").exists())
        head["sha256"][name] = hashlib.sha256(path.read_bytes()).hexdigest()
    (folder / "map.json").write_text(json.dumps(head))


def crafted_map(folder: Path, rng: random.Random) -> Case:
    """Change one array of a map, with the right checksum."""
    name = rng.choice(("keyframes", "points", "observations", "corners"))
    with np.load(folder / f"{name}.npz") as data:
        columns = dict(data)
    column = rng.choice(sorted(columns))
    changes: dict[str, Callable[[Any], Any]] = {
        "shorter": lambda a: a[:-1],
        "longer": lambda a: np.concatenate([a, a[:1]]),
        "empty": lambda a: a[:0],
        "flat": lambda a: a.ravel(),
        "deep": lambda a: a[..., None],
        "huge": lambda a: np.full_like(a, np.iinfo(a.dtype).max if a.dtype.kind in "iu" else np.inf),
        "nan or negative": lambda a: np.full_like(a, -1) if a.dtype.kind == "i" else a * np.nan,
        "text": lambda a: a.astype(str),
        "complex": lambda a: a.astype(complex),
        "same": lambda a: np.repeat(a[:1], len(a), 0),
        "backwards": lambda a: a[::-1],
    }
    kind = rng.choice(sorted(changes))
    columns[column] = changes[kind](columns[column])
    np.savez_compressed(folder / f"{name}.npz", **columns)
    _sign(folder)
    return kind, [column]


def maps(folder: Path, saved: Path) -> list[Case]:
    """Maps whose files are bombs with the right checksums."""
    import shutil

    cases: list[Case] = []
    files = {
        "points.npz of 2 GiB": ("points.npz", npz_zeros(2 * GIB)),
        "keyframes.npz that states 2^50": ("keyframes.npz", npz({"kf_ids": npy_header(1 << 50)})),
        "no arrays": ("corners.npz", npz({})),
        "rig of aliases": ("rig.yaml", ("stereo_sfm_rig: 1\n" + _aliases() + "left: *n\n").encode()),
    }
    for i, (name, (file, data)) in enumerate(files.items()):
        root = folder / f"m{i}"
        shutil.copytree(saved, root)
        (root / file).write_bytes(data)
        _sign(root)
        cases.append((name, ["map", "info", str(root)]))
    for i, text in enumerate(("[" * 200_000, '{"version": ' + "9" * 10_000 + "}", "{" + '"a":{' * 50_000)):
        root = folder / f"h{i}"
        shutil.copytree(saved, root)
        (root / "map.json").write_text(text)
        cases.append((f"map.json {i}", ["map", "info", str(root)]))
    return cases


def configurations(folder: Path) -> list[Case]:
    """TOML that is nested too deeply or holds huge numbers."""
    texts = ("seed = " + "[" * 100_000, "seed = " + "9" * 100_000, "a." * 50_000 + "b = 1", "a = {b = " * 20_000)
    for i, text in enumerate(texts):
        (folder / f"{i}.toml").write_text(text)
    files = [(f"toml {i}", ["config", "dump", "-c", str(folder / f"{i}.toml")]) for i in range(len(texts))]
    return [*files, ("set", ["config", "dump", "--set", "seed=" + "[" * 50_000])]
