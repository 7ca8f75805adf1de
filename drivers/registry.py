"""The drivers that are installed: entry points of the group `stereo_sfm.drivers`, of this and other packages."""

from __future__ import annotations

import functools
import itertools
import logging
import tomllib
from collections.abc import Iterator
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any

from stereo_sfm.drivers.driver import Certainty, Driver
from stereo_sfm.errors import StereoSfmError

log = logging.getLogger("stereo_sfm")

GROUP = "stereo_sfm.drivers"
MOST_FILES = 10_000  # that are looked at for images
ABOVE = 3  # folders between the images of one camera and those of both
_OURS = "stereo-sfm"
_PROJECT = Path(__file__).resolve().parents[1] / "pyproject.toml"  # in a checkout; an installed package has none


@functools.cache
def _found() -> dict[str, EntryPoint]:
    """Kind -> entry point of its driver, sorted by kind.

    In a checkout our own come from pyproject.toml: the installed metadata may be missing or outdated.
    """
    ours = _declared()
    others = [e for e in entry_points(group=GROUP) if not ours or e.dist is None or e.dist.name != _OURS]
    found: dict[str, EntryPoint] = {}
    for entry in sorted([*ours, *others], key=lambda e: (e.name, e.value)):
        known = found.setdefault(entry.name, entry)
        if known.value != entry.value:
            raise StereoSfmError(
                f"two drivers are called '{entry.name}': {known.value} and {entry.value}; uninstall one of them"
            )
    return found


def _declared() -> list[EntryPoint]:
    if not _PROJECT.is_file():
        return []
    project = tomllib.loads(_PROJECT.read_text("utf-8")).get("project", {})
    table: dict[str, str] = project.get("entry-points", {}).get(GROUP, {}) if project.get("name") == _OURS else {}
    return [EntryPoint(name, value, GROUP) for name, value in table.items()]


def kinds() -> tuple[str, ...]:
    """The kinds of sources that can be opened; imports no driver."""
    return tuple(_found())


@functools.cache
def driver(kind: str) -> Driver[Any]:
    """The driver of a kind, one of `kinds()`.

    Raises:
        StereoSfmError: its package is broken.
    """
    entry = _found()[kind]
    try:
        loaded = entry.load()
    except Exception as error:
        raise StereoSfmError(f"the driver '{kind}' ({entry.value}) cannot be loaded: {error!r}") from error
    if not isinstance(loaded, Driver):
        raise StereoSfmError(f"the driver '{kind}' ({entry.value}) is not a stereo_sfm.drivers.driver.Driver")
    return loaded  # pyright: ignore[reportUnknownVariableType]


def drivers() -> Iterator[tuple[str, Driver[Any]]]:
    """(kind, driver) of all drivers; a broken one gives a warning."""
    for kind in kinds():
        try:
            found = driver(kind)
        except StereoSfmError as error:
            log.warning("%s", error)
        else:
            yield kind, found


def recognise(path: Path) -> str:
    """The kind of an existing file or folder: that of the most confident driver.

    Raises:
        StereoSfmError: no driver recognises it; the message says what it is instead, where that is known.
    """
    kind = _recognised(path)
    if kind is None:
        others = "'stereo-sfm sources' lists KITTI, EuRoC and all others"
        raise StereoSfmError(f"{path} is not a known kind of dataset{_instead(path)} ({others})")
    return kind


def _recognised(path: Path) -> str | None:
    certainty = {kind: found.recognise(path) for kind, found in drivers()}
    best = max(certainty, key=certainty.__getitem__, default=None)  # the first of equally confident ones
    return None if best is None or certainty[best] is Certainty.NO else best


def _instead(path: Path) -> str:
    from stereo_sfm.pixels import SUFFIXES

    if (path / "map.json").is_file():
        return f" but a map: 'stereo-sfm map info {path}' describes it"
    if not path.is_dir():
        return ""
    if not any(p.suffix.lower() in SUFFIXES for p in itertools.islice(path.rglob("*"), MOST_FILES)):
        return ": there are no images in it"
    above = next((p for p in path.absolute().parents[:ABOVE] if _recognised(p) is not None), None)
    near = f", did you mean the folder above, {above}?" if above is not None else ":"
    return f"{near} two folders of images are 'images:{path}?left=FOLDER&right=FOLDER'"
