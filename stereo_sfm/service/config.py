"""`robot.toml`: what the service runs, keeps and offers."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stereo_sfm.config import load as load_config
from stereo_sfm.config import parse_override, read_toml
from stereo_sfm.errors import StereoSfmError, require
from stereo_sfm.presets import PRESETS, preset
from stereo_sfm.service.outputs.settings import OutputsConfig, PageConfig, SecurityConfig
from stereo_sfm.settings import explained, line, merge, number, path, placed, read, switch, word
from stereo_sfm.storage.remote import Remote

if TYPE_CHECKING:
    from stereo_sfm.config import Config
    from stereo_sfm.drivers.choice import SourceChoice

SEE = "stereo-sfm serve --print-config"
MAP_MODES = ("extend", "localize", "new", "none")
RECORDING_MODES = ("off", "full", "lean", "black_box")


@dataclass(frozen=True)
class SourceConfig:
    """Where the images come from."""

    spec: str = line("", "A camera, recording or simulator, as `stereo-sfm run` takes it")
    rig: str = path("Calibration file to use instead of the source's own")
    camera_store: str = path("Folder of calibrations that self-calibration corrected, by camera; empty: none is kept")
    rectify: str = word("none", ("none", "pinhole", "wide"), "Rectify the images first")
    speed: float = number(1.0, 0.01, 1000, "Speed at which a recording is played")
    repeat: bool = switch(False, "Play a recording again and again")


@dataclass(frozen=True)
class TrackingConfig:
    """What decides poses and map."""

    config: str = path("Configuration file of `stereo-sfm run -c`")
    preset: str = word("default", tuple(PRESETS), "Preset that the configuration file refines")


@dataclass(frozen=True)
class MapConfig:
    """The saved map."""

    folder: str = path("Folder of the saved map", "store")
    mode: str = word(
        "extend",
        MAP_MODES,
        "Continue the saved map or begin it, localize in it without changing it, begin a new one, or keep none",
    )
    bucket: str = line("", "Store in a bucket whose released version is fetched at the start, to localize in it")
    robot: str = line("", "Name of this robot, where versions are released to some robots")
    save_every_min: float = number(
        5.0,
        0.05,
        1440,
        "Most minutes between two saves; a new session is saved more often",
    )


@dataclass(frozen=True)
class RecordingConfig:
    """What is recorded, and how much of it is kept."""

    folder: str = path("Folder of the recordings", "recordings")
    mode: str = word(
        "off", RECORDING_MODES, "Nothing, everything, everything but images, or images of the last minutes only"
    )
    image_format: str = word("png", ("png", "raw", "jpeg"), "Format of the images; JPEG is lossy")
    segment_min: float = number(1.0, 0.02, 1440, "Minutes after which a new segment begins")
    segment_mb: float = number(2000.0, 1, 1e6, "Megabytes after which a new segment begins")
    quota_gb: float = number(20.0, 0.01, 1e6, "Gigabytes of all recordings; the oldest unmarked are deleted")
    quota_percent: float = number(80.0, 1, 100, "The same in percent of the disk")
    min_free_gb: float = number(1.0, 0, 1e6, "Gigabytes that stay free: below that no images are recorded")
    black_box_min: float = number(10.0, 0.05, 1e5, "Minutes of images that a black box keeps")
    mark_before_s: float = number(30.0, 0, 86400, "Seconds before a mark that are kept")
    mark_after_s: float = number(30.0, 0, 86400, "Seconds after a mark that are kept")
    upload: str = line(
        "", "Folder in a bucket that recordings are sent to, as s3://BUCKET/ROBOT; empty: they stay here"
    )
    upload_mbit: float = number(0.0, 0, 1e5, "Most megabits a second for that; 0: no limit")
    mark_losses: bool = switch(True, "Mark the places where tracking was lost")


@dataclass(frozen=True)
class WatchdogConfig:
    """When a stage counts as hung."""

    silent_s: float = number(1.0, 0.5, 60, "Seconds without a message from a stage")


@dataclass(frozen=True)
class RobotConfig:
    """The whole service."""

    source: SourceConfig = field(default_factory=SourceConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    map: MapConfig = field(default_factory=MapConfig)
    recording: RecordingConfig = field(default_factory=RecordingConfig)
    outputs: OutputsConfig = field(default_factory=OutputsConfig)
    page: PageConfig = field(default_factory=PageConfig)
    security: SecurityConfig = field(default_factory=SecurityConfig)
    watchdog: WatchdogConfig = field(default_factory=WatchdogConfig)

    def section(self, output: str) -> Any:
        """The section of an output."""
        return self.page if output == "page" else getattr(self.outputs, output)

    def pipeline(self) -> Config:
        """The configuration of the stages: without the bundle adjustment after a session, which nobody waits for.

        Raises:
            StereoSfmError: its file is invalid.
        """
        config = load_config(self.tracking.config or None, (), preset(self.tracking.preset))
        return dataclasses.replace(config, mapper=dataclasses.replace(config.mapper, final_iterations=0))

    def opener(self) -> SourceChoice:
        """The source, not yet opened.

        Raises:
            StereoSfmError: none is named, or it is invalid.
        """
        from stereo_sfm.drivers.choice import SourceChoice
        from stereo_sfm.drivers.source import is_device

        s = self.source
        if not s.spec:
            raise StereoSfmError('robot.toml names no source: add [source] spec = "t265:" or another')
        device = is_device(s.spec)
        choice = SourceChoice.of(
            s.spec, s.rig or None, rectify=s.rectify, speed=None if device else s.speed,
            camera_store=s.camera_store or None,
        )  # fmt: skip
        return dataclasses.replace(choice, repeat=s.repeat and not device)


def load(file: Path | str | None = None, overrides: Iterable[str] = ()) -> RobotConfig:
    """Defaults, a TOML file, then `section.key=value` overrides. Paths are relative to the file's folder, but for the
    source of an override.

    Raises:
        StereoSfmError: the file cannot be read, has an unknown key, or a value that its setting does not take.
    """
    from stereo_sfm.drivers.source import absolute
    from stereo_sfm.service.outputs.pose_socket import Place

    data: dict[str, Any] = {}
    folder = Path() if file is None else Path(file).expanduser().resolve().parent
    if file is not None:
        data = read_toml(Path(file).expanduser(), SEE)
        source = data.get("source")
        if isinstance(source, dict) and isinstance(source.get("spec"), str):
            data = merge(data, {"source": {"spec": absolute(source["spec"], folder=folder)}})
    for override in overrides:
        data = merge(data, parse_override(override, RobotConfig()))
    config = read(RobotConfig(), data, SEE)
    for name, address in (("recording.upload", config.recording.upload), ("map.bucket", config.map.bucket)):
        if address:
            Remote.of(address)
            require(("obstore",), "fleet", name)
    if not config.map.folder.strip("/"):
        raise StereoSfmError(f"map.folder is '{config.map.folder}': name a folder")
    if config.map.bucket and config.map.mode != "localize":
        raise StereoSfmError('map.bucket is for map.mode = "localize": other modes change the map on the robot')
    if config.outputs.pose_socket.enabled:
        Place.read(config.outputs.pose_socket.address)
    return config if file is None else placed(config, folder)


def explain(config: RobotConfig) -> str:
    """The configuration as TOML, with the description of every setting as a comment above it."""
    return explained(config)
