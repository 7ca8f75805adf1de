"""`PLAN.toml`: which bucket, which stores, within which limits; and the walks that there are.

    ROOT/STORE/walks/ROBOT/2026-11-25_2200.mcap             a recording
    ROOT/STORE/walks/ROBOT/00007_2026-11-25_220000/         segments, as the service sends them, or a session's own map
    ROOT/STORE/map/                                         versions of its map
    ROOT/STORE/work/                                        sessions' maps and results, one folder a walk
    ROOT/STORE/catalogue/                                   tables of its nights

All of a store is below one prefix, so that rights can be given by store.
"""

from __future__ import annotations

import contextlib
import dataclasses
import datetime
import hashlib
import json
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from stereo_sfm.config import Config, read_toml
from stereo_sfm.config import load as load_config
from stereo_sfm.errors import StereoSfmError, require
from stereo_sfm.presets import PRESETS, preset
from stereo_sfm.settings import explained, line, number, path, read, word
from stereo_sfm.storage import objects
from stereo_sfm.storage.folders import SUM, SUMS
from stereo_sfm.storage.remote import Remote, is_uri

SEE = "stereo-sfm fleet run --print-plan"
UNDATED = "undated"
_NIGHT = re.compile(r"(\d{4})([-_])(\d\d)\2(\d\d)")  # ROS names its bags rosbag2_2026_11_25-22_00_00
_WHOLE = (SUMS, "map.json")  # one of them in a folder says that all of it has arrived


@dataclass(frozen=True)
class FleetConfig:
    """Where everything is."""

    root: str = line("", "Folder in a bucket with a folder for each store, as s3://BUCKET")
    stores: str = line("", "Names of the stores, separated by commas; empty: all there are")
    keep_images_days: int = number(
        0, 0, 36500, "Days after which recordings are deleted, for people are in them; 0: never"
    )
    keep_versions: int = number(
        0, 0, 36500, "Versions of a store whose files are kept, besides those that robots were given; 0: all"
    )


@dataclass(frozen=True)
class TrackingConfig:
    """What decides poses and maps."""

    config: str = path("Configuration file of `stereo-sfm run -c`")
    preset: str = word("default", tuple(PRESETS), "Preset that the configuration file refines")


@dataclass(frozen=True)
class JobConfig:
    """Limits of each walk and of each night of a store."""

    minutes: float = number(60.0, 0, 1e5, "Minutes, after which it counts as failed; 0: no limit")
    memory_gb: float = number(4.0, 0, 1e4, "Gigabytes of memory that are reserved for it, and the most that it gets")
    retries: int = number(5, 0, 100, "Tries after its worker or computer died")


@dataclass(frozen=True)
class Walk:
    """One recording, or the map that a robot made of it; or a store whose walks cannot be listed, and why."""

    store: str
    night: str  # YYYY-MM-DD
    robot: str
    name: str  # unique in its store
    source: str  # address in a bucket, or any other source
    state: str = ""  # tells what was sent from what is sent again under its name
    bytes: int = 0
    error: str = ""  # of a store

    @property
    def key(self) -> str:
        """Of its result: another one for other bytes. A walk is in a map once, whichever program has mapped it."""
        about = [self.store, self.source, self.state]
        return f"{self.night}_{hashlib.sha256(json.dumps(about).encode()).hexdigest()[:16]}"


@dataclass(frozen=True)
class Plan:
    """The content of a plan."""

    fleet: FleetConfig = field(default_factory=FleetConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    job: JobConfig = field(default_factory=JobConfig)
    listed: tuple[Walk, ...] = ()  # walks that the plan names itself

    @property
    def root(self) -> Remote:
        return Remote.of(self.fleet.root)

    def config(self) -> Config:
        """Of all walks.

        Raises:
            StereoSfmError: its file is invalid.
        """
        return load_config(self.tracking.config or None, (), preset(self.tracking.preset))


def load_plan(file: Path) -> Plan:
    """Read a plan. The configuration file's path is relative to the plan's folder.

    Raises:
        StereoSfmError: it cannot be read, has an unknown key, or names no place.
    """
    require(("obstore",), "fleet", "a fleet")
    data = read_toml(file)
    walks = data.pop("walk", [])
    sections = {f.name: data.pop(f.name) for f in dataclasses.fields(Plan) if f.name in data and f.name != "listed"}
    plan = dataclasses.replace(read(Plan(), {**data, **sections}, SEE), listed=tuple(_listed(file, walks)))
    if not is_uri(plan.fleet.root):
        raise StereoSfmError(f'{file} names no place: add [fleet] root = "s3://BUCKET"')
    Remote.of(plan.fleet.root)
    if plan.tracking.config:
        config = str(file.absolute().parent / Path(plan.tracking.config).expanduser())
        plan = dataclasses.replace(plan, tracking=dataclasses.replace(plan.tracking, config=config))
    return plan


def _listed(file: Path, walks: Any) -> Iterator[Walk]:
    wanted = {"store", "night", "robot", "source"}
    for walk in walks if isinstance(walks, list) else [None]:
        if not isinstance(walk, dict) or walk.keys() != wanted or not all(isinstance(v, str) for v in walk.values()):
            raise StereoSfmError(f"{file}: each [[walk]] has the texts {', '.join(sorted(wanted))}, and no others")
        if any("/" in walk[name] or not walk[name] for name in ("store", "robot")):
            raise StereoSfmError(f"{file}: store and robot of a [[walk]] are names without slashes")
        if night_of(walk["night"]) != walk["night"]:
            raise StereoSfmError(f"{file}: the night of a [[walk]] is a date such as 2026-11-25")
        name = f"{walk['robot']}/{hashlib.sha256(walk['source'].encode()).hexdigest()[:12]}"
        yield Walk(name=name, **walk)


def night_of(name: str) -> str:
    """The date in a name, else `UNDATED`."""
    for year, _, month, day in _NIGHT.findall(name):
        with contextlib.suppress(ValueError):
            return datetime.date(int(year), int(month), int(day)).isoformat()
    return UNDATED


def explain(plan: Plan) -> str:
    """The plan as TOML, with the description of every setting as a comment above it."""
    return explained(dataclasses.replace(plan, listed=()))


def stores_of(plan: Plan) -> list[str]:
    """Their names, sorted where the plan does not name them.

    Raises:
        StereoSfmError: there is no such bucket, or no right to list it.
    """
    wanted = list(dict.fromkeys(name.strip() for name in plan.fleet.stores.split(",") if name.strip()))
    return wanted or sorted({*objects.folders(plan.root), *(walk.store for walk in plan.listed)})


def find_walks(plan: Plan) -> tuple[list[Walk], list[str]]:
    """All walks of the plan's stores by store, night and name; and the addresses of what is none, or not whole yet.

    A store that cannot be listed is a walk with an error, and stops no other one.

    Raises:
        StereoSfmError: there is no such bucket, or none of the stores can be listed.
    """
    stores = stores_of(plan)
    walks, waiting = [walk for walk in plan.listed if walk.store in stores], list[str]()
    lost: list[Walk] = []
    for store in stores:
        place = plan.root / store / "walks"
        try:
            found, others = _walks_of(store, place)
        except StereoSfmError as error:
            lost.append(Walk(store, UNDATED, "", "", str(place), error=str(error)))
        else:
            walks += found
            waiting += others
    if lost and len(lost) == len(stores):
        raise StereoSfmError(lost[0].error)
    return sorted(walks + lost, key=lambda w: (w.store, w.night, w.name)), waiting


def _walks_of(store: str, place: Remote) -> tuple[list[Walk], list[str]]:
    """Of one store."""
    found: dict[str, list[tuple[str, int, str]]] = {}
    for name, size, tag in objects.listed(place):
        if not name.endswith(SUM):
            found.setdefault("/".join(name.split("/")[:2]), []).append((name, size, tag))
    walks, waiting = list[Walk](), list[str]()
    for name, files in found.items():
        robot, _, own = name.partition("/")
        size = sum(size for _, size, _ in files)
        is_file = files[0][0] == name
        if is_file and not size and not own.endswith(".mcap"):  # it stands for a folder that is empty now
            continue
        names = {file.rpartition("/")[2] for file, _, _ in files}
        if own.endswith(".mcap") if is_file else not names.isdisjoint(_WHOLE):
            state = hashlib.sha256(repr(files).encode()).hexdigest()[:16]
            walks.append(Walk(store, night_of(own), robot, name, str(place / name), state, size))
        else:
            waiting.append(str(place / name))
    return walks, waiting
