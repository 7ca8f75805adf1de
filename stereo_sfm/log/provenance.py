"""The origin of a file: versions, source and configuration, as metadata and attachments."""

from __future__ import annotations

import hashlib
import platform
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version

from stereo_sfm import __version__
from stereo_sfm.calib.formats.native import rig_to_text
from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import Config, dump
from stereo_sfm.errors import printable
from stereo_sfm.log.machine import arithmetic
from stereo_sfm.log.reader import LogReader
from stereo_sfm.log.topics import SCHEMA_VERSION
from stereo_sfm.log.writer import LogWriter

METADATA = "stereo_sfm"
TOTALS = "totals"  # counts, written at the end
ENDED_EARLY = {"ended": "early"}  # in the metadata of a run that was killed
CONFIG_FILE = "config.toml"
SOURCE_RIG_FILE = "source_calibration.yaml"
VERSIONS_FILE = "versions.txt"
_PACKAGES = (
    "numpy",
    "scipy",
    "numba",
    "opencv-python-headless",
    "gtsam",
    "mcap",
    "protobuf",
    "foxglove-schemas-protobuf",
    "zstandard",
    "depthai",
)


@dataclass(frozen=True, eq=False)
class Opening:
    """How a run was started, besides the source's name: what a replay must repeat."""

    rectify: str = "none"  # none | pinhole | wide
    rig: Rig | None = None  # calibration that replaced the source's own, before rectification
    map_in: str = ""  # folder of the saved map that the run started from
    map_sha256: str = ""  # of its map.json, which holds the checksums of the rest
    localize_only: bool = False
    frame_skip: int = 1  # every K-th frame of the source


def write_provenance(
    writer: LogWriter,
    *,
    source: str,
    serial: str,
    mode: str,
    image_format: str,
    config: Config | None = None,
    opening: Opening | None = None,
) -> None:
    """Record the origin of everything in the file.

    Args:
        writer: the open file.
        source: the source's name.
        serial: serial number of the device, "" for none.
        mode: how the file was made: "record", "inline", "lockstep", "realtime".
        image_format: one of `images.FORMATS`.
        config: what decided the results of a run.
        opening: how the run was started.
    """
    values = {
        "version": __version__,
        "schema_version": SCHEMA_VERSION,
        "source": source,
        "device_serial": serial,
        "mode": mode,
        "image_format": image_format,
    }
    if opening is not None and opening.rectify != "none":
        values["rectify"] = opening.rectify
    if opening is not None and opening.frame_skip != 1:
        values["frame_skip"] = str(opening.frame_skip)
    if opening is not None and opening.map_in:
        values |= {"map_in": opening.map_in, "map_sha256": opening.map_sha256}
        values["localize_only"] = str(opening.localize_only).lower()
    if opening is not None and opening.rig is not None:
        writer.attach(SOURCE_RIG_FILE, rig_to_text(opening.rig), "application/yaml")
    if config is not None:
        text = printable(dump(config))
        values |= {"seed": str(config.seed), "config_sha256": config_hash(text)}
        writer.attach(CONFIG_FILE, text, "application/toml")
    writer.metadata(METADATA, {name: printable(value) for name, value in values.items()})
    writer.attach(VERSIONS_FILE, versions())


def config_hash(text: str) -> str:
    """Twelve digits that tell two configurations apart."""
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def versions() -> str:
    """One line per package, and per choice of machine code, that results depend on."""
    lines = [f"stereo-sfm {__version__}", f"python {platform.python_version()}", f"machine {platform.machine()}"]
    for package in _PACKAGES:
        try:
            lines.append(f"{package} {version(package)}")
        except PackageNotFoundError:
            lines.append(f"{package} missing")
    lines += [f"{name} {value}" for name, value in arithmetic().items()]
    return "\n".join(lines) + "\n"


def other_conditions(a: LogReader, b: LogReader) -> list[str]:
    """Differences of the packages and the machine code of two runs, "name: a -> b"."""
    one, other = (_by_name(reader.attachment(VERSIONS_FILE) or b"") for reader in (a, b))
    names = [name for name in one if name in other and one[name] != other[name]]
    return [f"{name}: {one[name]} -> {other[name]}" for name in names]


def _by_name(text: bytes) -> dict[str, str]:
    pairs = (line.partition(" ") for line in text.decode(errors="replace").splitlines())
    return {name: value for name, _, value in pairs}
