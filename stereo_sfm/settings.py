"""A setting: a dataclass field with a default, a description and its valid values. One validator for all.

Names carry their unit as the suffix `_px`, `_m`, `_s`, `_deg`, `_bits`; a standard deviation is `sigma_UNIT` or
`..._sigma_UNIT`; a multiple of one is `..._sigmas`. What has no unit is a count or a ratio.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Iterator
from dataclasses import field
from operator import attrgetter
from pathlib import Path
from typing import Any, TypeVar

from stereo_sfm.errors import StereoSfmError, did_you_mean

T = TypeVar("T")
KINDS: dict[object, str] = {float: "a number", int: "a whole number", bool: "true or false", str: "a text"}


def number(default: float, least: float, most: float, text: str) -> Any:
    """A number from `least` to `most`; `text` describes it in one sentence without its full stop."""
    return field(default=default, metadata={"text": text, "range": (least, most)})


def word(default: str, words: Iterable[str], text: str) -> Any:
    """One of these words."""
    return field(default=default, metadata={"text": text, "words": tuple(words)})


def switch(default: bool, text: str) -> Any:
    """True or false."""
    return field(default=default, metadata={"text": text})


def path(text: str, default: str = "") -> Any:
    """The path of a file or folder: in a file of settings, relative to the file's folder."""
    return field(default=default, metadata={"text": text, "path": True})


def line(default: str, text: str) -> Any:
    """Any text of one line."""
    return field(default=default, metadata={"text": text})


def walk(section: Any, place: str = "") -> Iterator[tuple[str, dataclasses.Field[Any], Any]]:
    """Every setting of a tree of dataclasses: its dotted name, its field, its value."""
    for f in dataclasses.fields(section):
        value = getattr(section, f.name)
        if dataclasses.is_dataclass(value):
            yield from walk(value, f"{place}{f.name}.")
        else:
            yield place + f.name, f, value


def check(tree: Any) -> None:
    """Check that every value is valid for its setting.

    Raises:
        StereoSfmError: an unknown word or a number out of range.
    """
    for name, f, value in walk(tree):
        words: tuple[str, ...] = f.metadata.get("words", ())
        if words and value not in words:
            raise StereoSfmError(
                f"configuration: {name} is '{value}'{did_you_mean(value, words)}: choose one of {', '.join(words)}"
            )
        if "range" not in f.metadata:
            continue
        least, most = f.metadata["range"]
        if isinstance(value, bool) or not least <= value <= most:  # Python takes True for 1
            shown = plain(value)[:80]
            raise StereoSfmError(f"configuration: {name} is {shown}: it must be from {least:g} to {most:g}")


def plain(value: float) -> str:
    """A number as text, whole numbers with all digits."""
    return f"{value:g}" if isinstance(value, float) else str(value)


def placed(tree: T, folder: Path) -> T:
    """A tree of settings whose paths are absolute. Args: folder, that relative ones begin in."""
    changed: dict[str, Any] = {}
    for name, f, value in walk(tree):
        if value and "path" in f.metadata and "://" not in value:
            *sections, key = name.split(".")
            at = changed
            for section in sections:
                at = at.setdefault(section, {})
            at[key] = str(folder / Path(value).expanduser())
    return read(tree, changed, "")


def merge(base: dict[str, Any], extra: dict[str, Any]) -> dict[str, Any]:
    """Nested values with those of `extra` in place of their own."""
    out = dict(base)
    for key, value in extra.items():
        old = out.get(key)
        out[key] = merge(old, value) if isinstance(old, dict) and isinstance(value, dict) else value
    return out


def read(tree: T, data: dict[str, Any], see: str) -> T:
    """A tree of settings with some of its values replaced.

    Args:
        tree: the defaults. data: nested plain values, as of a TOML file. see: the command that shows every key.

    Raises:
        StereoSfmError: an unknown key, a value of the wrong type, or one that its setting does not take.
    """
    import dacite

    check_names(tree, data, see)
    rules = dacite.Config(strict=True, type_hooks={float: _as_float}, cast=[tuple])
    try:
        done = dacite.from_dict(type(tree), merge(dataclasses.asdict(tree), data), rules)  # pyright: ignore[reportArgumentType]
    except dacite.WrongTypeError as error:
        wanted = KINDS.get(error.field_type, getattr(error.field_type, "__name__", str(error.field_type)))
        raise StereoSfmError(
            f"configuration: {error.field_path} is {str(error.value)[:80]!r}: it must be {wanted} (see '{see}')"
        ) from None
    except dacite.DaciteError as error:
        raise StereoSfmError(f"configuration: {error} (see '{see}' for every key)") from None
    check(done)
    return done


def _as_float(value: Any) -> Any:
    if not isinstance(value, int) or isinstance(value, bool):
        return value
    try:
        return float(value)
    except OverflowError:  # more than 300 digits
        return math.inf if value > 0 else -math.inf


def check_names(tree: Any, data: dict[str, Any], see: str, place: str = "") -> None:
    """Check that every key of nested values is a setting.

    Raises:
        StereoSfmError: one is not; the message suggests the nearest setting.
    """
    own = {f.name: getattr(tree, f.name) for f in dataclasses.fields(tree)}
    for key, value in data.items():
        if key not in own:
            raise StereoSfmError(
                f"configuration: there is no {place}{key}{did_you_mean(key, own)} ('{see}' shows every key)"
            )
        if dataclasses.is_dataclass(own[key]):
            if not isinstance(value, dict):
                first = dataclasses.fields(own[key])[0].name
                raise StereoSfmError(f"configuration: {key} is a section of settings, as {key}.{first}")
            check_names(own[key], value, see, f"{place}{key}.")  # pyright: ignore[reportUnknownArgumentType]


def explained(tree: Any) -> str:
    """The tree as TOML, with the description and valid values of each setting as a comment above it."""
    import tomli_w

    lines: list[str] = []
    section = ""
    for name, f, value in walk(tree):
        head, _, key = name.rpartition(".")
        if head != section:
            about = type(attrgetter(head)(tree)).__doc__ or head
            lines.append(f"[{head}]\n# {about.splitlines()[0]}\n")
            section = head
        text = f"[{name}]\n{tomli_w.dumps(value)}" if isinstance(value, dict) else tomli_w.dumps({key: value})
        lines.append(f"# {f.metadata['text']}{_takes(f)}.\n{text}")
    return "\n".join(lines)


def _takes(f: dataclasses.Field[Any]) -> str:
    if "words" in f.metadata:
        return f" ({' | '.join(f.metadata['words'])})"
    if "range" in f.metadata:
        least, most = f.metadata["range"]
        return f" (from {least:g} to {most:g})"
    return ""
