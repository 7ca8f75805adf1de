"""Options of a source: one dataclass per driver, parsed from the query of a source's text or from keyword arguments.

A driver declares its options once, with types, defaults, limits and descriptions:

    @dataclass(frozen=True)
    class WebcamOptions(SourceOptions):
        fps: float = option(30.0, "images per second", low=1, high=240)
        flip: bool = option(False, "rotate the images by 180 degrees")

`webcam:0?fps=60&flip=1` and `open_source("webcam:0", fps=60, flip=True)` give the same options; an invalid value is a
one-line error. The help and the table of drivers are generated from the same declarations.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterator, Mapping
from dataclasses import Field, dataclass, field, fields
from pathlib import Path
from types import NoneType, UnionType
from typing import TYPE_CHECKING, Any, ClassVar, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from stereo_sfm.errors import StereoSfmError, did_you_mean

if TYPE_CHECKING:
    from stereo_sfm.drivers.rig_option import RigOption
else:
    RigOption = Any  # annotations are evaluated when options are read: nothing heavy is imported for that

O = TypeVar("O", bound="SourceOptions")  # noqa: E741

_FLAGS = dict.fromkeys(("", "1", "true", "yes", "on"), True) | dict.fromkeys(("0", "false", "no", "off"), False)
_NOTHING = ("auto", "none", "")  # texts that mean None


def option(
    default: Any,
    doc: str,
    *,
    low: float | None = None,
    high: float | None = None,
    read: Callable[[Any], Any] | None = None,
    file: bool = False,
) -> Any:
    """One field of a driver's options.

    Args:
        default: its default value.
        doc: description with its unit.
        low, high: limits of a number, both inclusive.
        read: converts the user's value, for types without a standard text form; raises ValueError with a description of
            valid values ("WIDTHxHEIGHT, such as 640x400").
        file: its text names a file, which a log records by its absolute path.
    """
    return field(default=default, metadata={"doc": doc, "low": low, "high": high, "read": read, "file": file})


@dataclass(frozen=True)
class SourceOptions:
    """Options of every driver; a driver's own options inherit from it.

    `GROUPS`: title -> names of the options listed under it; those of no group are listed first.
    """

    GROUPS: ClassVar[Mapping[str, tuple[str, ...]]] = {}

    rig: RigOption = option(  # noqa: RUF009
        None, "calibration instead of the source's own: a file of any format", read=lambda x: x, file=True
    )


def read_options(cls: type[O], source: str, given: Mapping[str, Any]) -> O:
    """A driver's options from user input.

    Args:
        cls: the driver's options.
        source: kind of the source, for messages ("t265").
        given: name -> text of a query, or the value itself.

    Raises:
        StereoSfmError: unknown option, or invalid value.
    """
    known = {f.name: f for f in fields(cls)}
    types = get_type_hints(cls)
    values: dict[str, Any] = {}
    for name, value in given.items():
        if name not in known:
            raise StereoSfmError(
                f"{source} has no option '{name}'{did_you_mean(name, known)} (it has: {', '.join(sorted(known))})"
            )
        values[name] = _read(source, known[name], types[name], value)
    return cls(**values)


@dataclass(frozen=True)
class OptionHelp:
    """Description of one option for users."""

    name: str
    default: str
    wanted: str
    doc: str


def grouped(cls: type[SourceOptions]) -> Iterator[tuple[str, list[OptionHelp]]]:
    """(title, options) of each group of a driver's options; the title of those of no group is empty."""
    of = {name: title for title, names in cls.GROUPS.items() for name in names}
    found = list(described(cls))
    for title in ("", *cls.GROUPS):
        yield title, [one for one in found if of.get(one.name, "") == title]


def described(cls: type[SourceOptions]) -> Iterator[OptionHelp]:
    """Descriptions of the options of a driver, in the order of their declaration."""
    types = get_type_hints(cls)
    for f in fields(cls):
        custom = f.metadata.get("read") is not None
        wanted = "" if custom else _wanted(types[f.name], f)
        default = "auto" if f.default is None and not custom else _shown(f.default)
        yield OptionHelp(f.name, default, wanted, str(f.metadata.get("doc", "")))


def _shown(default: Any) -> str:
    if isinstance(default, bool):
        return "on" if default else "off"
    if isinstance(default, tuple):
        return "x".join(str(part) for part in default)  # pyright: ignore[reportUnknownVariableType]
    return "" if default is None else f"{default:g}" if isinstance(default, float) else str(default)


def _read(source: str, f: Field[Any], kind: Any, value: Any) -> Any:
    """One value, of the field's type and within its limits."""
    custom: Callable[[Any], Any] | None = f.metadata.get("read")
    try:
        return custom(value) if custom is not None else _limited(f, _convert(kind, value))
    except ValueError as error:
        wanted = str(error) if custom is not None else _wanted(kind, f) + did_you_mean(str(value), _words(kind))
        raise StereoSfmError(f"{source}: option {f.name}={value}: it must be {wanted}") from None


def read_size(value: Any) -> tuple[int, int]:
    """WIDTHxHEIGHT of a user. Raises ValueError with what it must be."""
    width, _, height = value.partition("x") if isinstance(value, str) else (str(value[0]), "", str(value[1]))
    if not (width.isdigit() and height.isdigit() and 64 <= int(width) <= 4096 and 64 <= int(height) <= 4096):
        raise ValueError("WIDTHxHEIGHT, such as 640x400 or 1280x800")
    return int(width), int(height)


def _convert(kind: Any, value: Any) -> Any:
    """A value of a type from itself or from text. Raises ValueError for invalid values."""
    if _optional(kind):
        if value is None or (isinstance(value, str) and value.lower() in _NOTHING):
            return None
        return _convert(_inner(kind), value)
    if get_origin(kind) is Literal:
        word = str(value).lower()
        if word not in get_args(kind):
            raise ValueError(word)
        return word
    if kind is bool:
        return _flag(value)
    if kind is int:
        return _whole(value)
    if kind is float:
        if isinstance(value, bool | None):
            raise ValueError(value)
        return float(value)
    return Path(value).expanduser() if kind is Path else str(value)


def _flag(value: Any) -> bool:
    word = str(value).lower()
    if word not in _FLAGS:
        raise ValueError(word)
    return _FLAGS[word]


def _whole(value: Any) -> int:
    if isinstance(value, str):
        return int(value)
    if isinstance(value, bool | float | None):
        raise ValueError(value)
    return operator.index(value)


def _limited(f: Field[Any], value: Any) -> Any:
    low, high = f.metadata.get("low"), f.metadata.get("high")
    if isinstance(value, int | float) and not isinstance(value, bool):
        above = low is None or value >= low
        if not (above and (high is None or value <= high)):
            raise ValueError(value)
    return value


def _wanted(kind: Any, f: Field[Any]) -> str:
    """Description of the valid values."""
    auto = "auto or " if _optional(kind) else ""
    kind = _inner(kind)
    if get_origin(kind) is Literal:
        return f"{auto}one of {', '.join(get_args(kind))}"
    if kind not in (int, float):
        return auto + {bool: "on or off", Path: "a path"}.get(kind, "text")
    number = "a whole number" if kind is int else "a number"
    low, high = f.metadata.get("low"), f.metadata.get("high")
    if low is None or high is None:
        return auto + number
    return f"{auto}{number} from {low:g} to {high:g}"


def _words(kind: Any) -> tuple[str, ...]:
    """The values of a Literal."""
    kind = _inner(kind)
    return get_args(kind) if get_origin(kind) is Literal else ()


def _optional(kind: Any) -> bool:
    return get_origin(kind) in (Union, UnionType) and NoneType in get_args(kind)


def _inner(kind: Any) -> Any:
    """T of T | None."""
    return next(k for k in get_args(kind) if k is not NoneType) if _optional(kind) else kind
