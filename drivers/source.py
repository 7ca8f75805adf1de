"""The source protocol, its base class for drivers, and opening a source by its text."""

from __future__ import annotations

import itertools
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from difflib import get_close_matches
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import TYPE_CHECKING, Any, Protocol, Self
from urllib.parse import parse_qsl, quote, unquote_plus

from stereo_sfm.drivers import registry
from stereo_sfm.drivers.driver import Driver
from stereo_sfm.drivers.options import SourceOptions, read_options
from stereo_sfm.errors import StereoSfmError, did_you_mean
from stereo_sfm.storage.remote import Remote, is_uri, place

if TYPE_CHECKING:
    from stereo_sfm.calib.rig import Rig
    from stereo_sfm.drivers.rig_option import RigOption
    from stereo_sfm.types import I64, StereoImage, Trajectory

SURE, LIKELY = 0.7, 0.6  # likeness of a word to a kind of source: of one that may be a folder, of one before a colon
MOST_BESIDE = 1000  # names in a folder among which a mistyped one is looked for
_NO_COUNTERS: Mapping[str, float] = MappingProxyType({})


@dataclass(frozen=True, eq=False)
class Stamps:
    """The stamps of the frames of a source, known without reading pixels."""

    stamp_ns: I64  # (N,) of the left images
    skew_ms: float = float("nan")  # largest difference between left and right stamps; NaN: not known
    others: Mapping[str, I64] = field(default_factory=dict[str, "I64"])  # stamps of other recorded sensors, by name
    assumed_hz: float = 0.0  # the rate they were made up with, where nothing tells them; 0: they are known


class Source(Protocol):
    """A source of images. Drivers inherit defaults from `BaseSource`."""

    @property
    def name(self) -> str:
        """Readable name: "sim:loop", "euroc:mh01"."""
        ...

    @property
    def rig(self) -> Rig:
        """Known when the source is open, before the first frame."""
        ...

    @property
    def ground_truth(self) -> Trajectory | None:
        """world_T_cam0 where the source has it."""
        ...

    @property
    def frame_count(self) -> int | None:
        """None when unknown (live)."""
        ...

    @property
    def live(self) -> bool:
        """Frames arrive whether or not they are consumed."""
        ...

    @property
    def counters(self) -> Mapping[str, float]:
        """Counters of a live source (stereo_sfm.drivers.live.counters); empty for files."""
        ...

    def other_reading(self) -> tuple[str, Rig] | None:
        """Another calibration that the source may mean, and what would then be so ("the images are rectified
        already"), for images that contradict `rig`; None where its calibration has one meaning."""
        ...

    def stamps(self) -> Stamps | None:
        """The stamps of all frames if known without reading pixels, else None."""
        ...

    def at(self, positions: Sequence[int]) -> Iterator[StereoImage]:
        """The frames at ascending positions (0 is the first frame of the iteration).

        Sources with random access do not read or render the frames between.
        """
        ...

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

    def __iter__(self) -> Iterator[StereoImage]: ...


def chosen_frames(images: Iterator[StereoImage], positions: Sequence[int]) -> Iterator[StereoImage]:
    """The frames at ascending positions of an iteration, which is read up to the last of them."""
    wanted = iter(positions)
    position = next(wanted, None)
    for number, image in enumerate(images if position is not None else ()):
        if number == position:
            yield image
            position = next(wanted, None)
            if position is None:
                return


class BaseSource(ABC):
    """A source with common defaults; a driver sets `name` and `rig` and implements `__iter__`."""

    name: str
    rig: Rig
    ground_truth: Trajectory | None = None
    frame_count: int | None = None
    live: bool = False
    counters: Mapping[str, float] = _NO_COUNTERS

    def other_reading(self) -> tuple[str, Rig] | None:
        return None

    def stamps(self) -> Stamps | None:
        return None

    def at(self, positions: Sequence[int]) -> Iterator[StereoImage]:
        return chosen_frames(iter(self), positions)

    def close(self) -> None:
        """Release resources; may be called twice."""
        return

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @abstractmethod
    def __iter__(self) -> Iterator[StereoImage]:
        """Frames in stamp order."""


@dataclass(frozen=True)
class Named:
    """A parsed source text: driver, place, options; validated, nothing opened yet."""

    kind: str
    driver: Driver[Any]
    place: str
    options: SourceOptions

    def open(self) -> Source:
        """The source, not yet entered."""
        return self.driver.open(self.place, self.options)


def look_up(spec: str | Path, rig: RigOption = None, **options: Any) -> Named:
    """Parse a source's text; arguments and errors as for `open_source`, but nothing is opened."""
    kind, place, query = _split(str(spec))
    given = {**dict(parse_qsl(query, keep_blank_values=True)), **options}
    if rig is not None:
        given["rig"] = rig
    found = registry.driver(kind)
    read = read_options(found.options, kind, given)
    found.check(place, read)
    return Named(kind, found, place, read)


def open_source(spec: str | Path, rig: RigOption = None, **options: Any) -> Source:
    """Open a source by its text.

    Args:
        spec: `KIND:PLACE?OPTION=VALUE&...` (`sim:loop?camera=pinhole&seed=3`, `t265`, `oak?fps=20`), or a file or a
            folder of a recognised kind.
        rig: calibration instead of the source's own, or a calibration file.
        **options: of the driver, as typed values or as text; they override those in the text.

    Raises:
        StereoSfmError: unknown kind, missing or unrecognised folder, an unknown option, or
            any error found by the driver.
    """
    return look_up(spec, rig, **options).open()


def is_device(spec: str) -> bool:
    """Whether a source's text denotes a live camera."""
    kind = _kind(spec)
    return kind is not None and registry.driver(kind).cameras is not None


def path_of(spec: str) -> Path:
    """The file or folder of a source's text, if any."""
    head = spec.partition("?")[0]
    return Path(head.partition(":")[2] if _kind(spec) else spec if Path(spec).exists() else head).expanduser()


def absolute(spec: str, driver: Driver[Any] | None = None, folder: Path = Path()) -> str:
    """A source's text with absolute paths of what exists: its file or folder, and the files of its options.

    Args:
        spec: as for `open_source`. driver: which opens it; None: that of its kind. folder: from which its paths are.
    """
    kind = _kind(spec)
    if kind is None and (folder / Path(spec).expanduser()).exists():
        return _absolute(spec, folder)
    driver = registry.driver(kind) if driver is None and kind is not None else driver
    head, mark, query = spec.partition("?")
    name, colon, named = head.partition(":") if kind else ("", "", head)
    there = _absolute(named, folder) if driver is None or driver.of_files else named
    if "?" in there:  # what follows would be taken for options
        return spec
    files = set[str]() if driver is None else {one.name for one in fields(driver.options) if one.metadata.get("file")}
    parts = [part.partition("=") for part in query.split("&")]
    options = [f"{key}={quote(_absolute(unquote_plus(text), folder))}" if key in files else f"{key}{equals}{text}"
               for key, equals, text in parts]  # fmt: skip
    return f"{name}{colon}{there}{mark}{'&'.join(options)}"


def _absolute(text: str, folder: Path) -> str:
    path = folder / Path(text).expanduser()
    return str(path.resolve()) if text and not is_uri(text) and path.exists() else text


def _kind(text: str) -> str | None:
    """The kind at the beginning of a text, None if it is a path."""
    head = text.partition("?")[0]
    kind, colon, _ = head.partition(":")
    if kind not in registry.kinds():
        return None
    if not colon and Path(kind).exists() and registry.driver(kind).place.startswith(("FOLDER", "FILE")):
        return None  # a dataset of this kind needs a place: the folder of its name is meant
    return kind


def _split(text: str) -> tuple[str, str, str]:
    """(kind, place, query) of a source's text."""
    head, _, query = text.partition("?")
    kind = _kind(text)
    if kind is not None:
        named = head.partition(":")[2]
        return kind, local_place(named) if is_uri(named) and registry.driver(kind).cameras is None else named, query
    if is_uri(head):
        found = local_place(head)
        return (registry.recognise(Path(found)), found, query) if not is_uri(found) else ("mcap", found, query)
    if Path(text).expanduser().exists():
        head, query = text, ""
    path = Path(head).expanduser()
    if not path.exists():
        raise _unknown(head)
    return registry.recognise(path), str(path), query


def local_place(uri: str) -> str:
    """Where a source in a bucket is read: an MCAP file there, by ranges; others in a copy on this computer."""
    found = place(uri)
    if not isinstance(found, Remote):
        return str(found)
    if found.suffix == ".mcap":
        return str(found)
    from stereo_sfm.storage.folders import fetch

    return str(fetch(found))


def _unknown(text: str) -> StereoSfmError:
    kind, colon, _ = text.partition(":")
    near = get_close_matches(kind.lower(), registry.kinds(), 1, SURE if not colon else LIKELY)
    path = Path(text).expanduser()
    beside = _near_paths(path)
    if not near or (not colon and (beside or "/" in text or "." in text)):
        return StereoSfmError(f"no such file or folder: {text}{beside} ('stereo-sfm sources' lists other sources)")
    return StereoSfmError(
        f"unknown source '{text}', did you mean {near[0]}? ('stereo-sfm sources' lists all; "
        "there is no file or folder of this name)"
    )


def _near_paths(path: Path) -> str:
    """ ", did you mean NAME?" with a file or folder beside a path that does not exist."""
    try:
        names = [other.name for other in itertools.islice(path.parent.iterdir(), MOST_BESIDE)]
    except OSError:
        return ""
    return did_you_mean(path.name, names)
