"""Files that a user names: regular ones only, and of a size that can be what they claim to be.

JSON and YAML, too: values may be nested more deeply than a parser can follow, and the aliases of a few hundred bytes of
YAML expand to billions of values.
"""

from __future__ import annotations

import errno
import json
import os
import stat
from collections.abc import Iterator
from io import BufferedReader
from pathlib import Path
from typing import Any

from stereo_sfm.errors import StereoSfmError

MOST_TEXT = 1 << 30  # bytes of a text: a trajectory of a day at 30 Hz has some 200 MB
MOST_BYTES = 2 << 30  # of any file that is read as a whole
MOST_JSON = 64 << 20  # bytes; the numbers of a short run take some kilobytes
MOST_YAML = 1 << 16  # bytes of what describes one picture
MOST_DEPTH = 32  # of YAML
MOST_VALUES = 1_000_000  # of YAML, with every alias written out
MOST_CHARS = 1 << 16  # of one value of YAML
MOST_HEADER = 1 << 12  # bytes of the first line that are looked at


def with_plain_numbers(tree: Any) -> Any:
    """Nested values whose whole numbers have 64 bits at most, as everything here has them.

    Raises:
        ValueError: one has more.
    """
    waiting = [tree]
    while waiting:
        value = waiting.pop()
        if isinstance(value, dict):
            waiting += [*value, *value.values()]
        elif isinstance(value, (list, tuple, set)):  # YAML has pairs and sets, too
            waiting += value
        elif isinstance(value, int) and not -(1 << 63) <= value < 1 << 63:
            raise ValueError(f"a whole number of {value.bit_length()} bits is too large")
    return tree


def visible(folder: Path, pattern: str = "") -> Iterator[Path]:
    """What is in a folder, in no order, without names that begin with a dot: macOS keeps attributes in ._NAME.

    Args:
        folder: it exists. pattern: of the names, as for `Path.glob`; "": all.

    Raises:
        OSError: the folder cannot be read.
    """
    return (p for p in (folder.glob(pattern) if pattern else folder.iterdir()) if not p.name.startswith("."))


class NotAFile(StereoSfmError, OSError):
    """A pipe, a device, a folder, or a file too large for what it should be.

    An OSError, too: to who takes a file that cannot be read for a damaged one, it is one.
    """

    @classmethod
    def of(cls, path: Path, why: str) -> NotAFile:
        """For a message."""
        return cls(errno.EINVAL, why, str(path))

    def __str__(self) -> str:
        return f"cannot read {self.filename}: {self.strerror}"


def open_regular(path: Path, most: int | None = None) -> BufferedReader:
    """Open a file for reading. A pipe or a device is refused: it may never end, or hold the reader up.

    Args:
        path: the file. most: bytes.

    Raises:
        NotAFile: it is no regular file, or is larger.
        OSError: it cannot be opened.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    about = os.fstat(descriptor)
    if not stat.S_ISREG(about.st_mode):
        os.close(descriptor)
        raise NotAFile.of(path, "it is not a file")
    if most is not None and about.st_size > most:
        os.close(descriptor)
        raise NotAFile.of(path, f"it has {about.st_size / 1e6:.0f} MB, more than {most / 1e6:.0f}")
    return os.fdopen(descriptor, "rb")


def refuse_pipe(path: Path) -> None:
    """Check that a file may be written: opening a pipe of a name waits for a reader. /dev/stdout is none.

    Raises:
        StereoSfmError: it is such a pipe.
    """
    if Path(os.path.realpath(path)).is_fifo():  # of links that go round nothing is said here
        raise StereoSfmError(f"cannot use {path}: it is not a file but a pipe")


def read_bytes(path: Path, most: int = MOST_BYTES) -> bytes:
    """The bytes of a file.

    Raises:
        NotAFile: it is no regular file, or is larger than this many bytes.
        OSError: it cannot be read.
    """
    with open_regular(path, most) as file:
        return file.read()


def read_text(path: Path, most: int = MOST_TEXT, encoding: str = "utf-8-sig") -> str:
    """The text of a file.

    Args:
        path: the file. most: bytes. encoding: of the text; by default UTF-8, with or without its mark.

    Raises:
        NotAFile: it is no regular file, or is larger.
        OSError: it cannot be read. UnicodeError: it is something else.
    """
    return read_bytes(path, most).decode(encoding)


def first_line(path: Path) -> str:
    """The first line of a text, without reading the rest. Errors as of `open_regular`."""
    with open_regular(path) as file:
        return file.readline(MOST_HEADER).decode("utf-8-sig", "replace")


def read_json(path: Path, most: int = MOST_JSON) -> Any:
    """The value in a file.

    Raises:
        NotAFile: it is no regular file, or is larger than this many bytes.
        OSError: it cannot be read. ValueError: it is not JSON, or nested too deeply.
    """
    try:
        return with_plain_numbers(json.loads(read_text(path, most)))
    except RecursionError:
        raise ValueError("nested too deeply") from None


def read_yaml(path: Path, most: int = MOST_YAML) -> Any:
    """The value in a file.

    Args:
        path: the file. most: bytes.

    Raises:
        NotAFile: it is no regular file, or is larger.
        OSError: it cannot be read. ValueError: as `count_values`.
    """
    import yaml

    text = read_text(path, most)
    count_values(text)
    try:
        loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # not every build has the fast one
        return with_plain_numbers(yaml.load(text, loader))
    except yaml.YAMLError as error:
        raise ValueError(_said(error)) from None
    except (ArithmeticError, AttributeError, LookupError, TypeError) as error:  # a tag whose value is none of its kind
        raise ValueError(f"a value is not what its tag says ({error})") from None


def count_values(text: str, before: int = 0) -> int:
    """How many values YAML has with every alias written out, added to those counted before; none of them is made.

    Raises:
        ValueError: it is not YAML, or nested more deeply, or with larger or more values than the limits here.
    """
    import yaml

    try:
        return _count(text, before)
    except yaml.YAMLError as error:
        raise ValueError(_said(error)) from None


def _count(text: str, total: int) -> int:
    import yaml
    from yaml.events import AliasEvent, CollectionEndEvent, CollectionStartEvent, ScalarEvent

    named: dict[str | None, int] = {}  # values of what an alias may name
    inside: list[tuple[str | None, int]] = []  # the collections that are open: name, values before them
    for event in yaml.parse(text, getattr(yaml, "CSafeLoader", yaml.SafeLoader)):
        if isinstance(event, AliasEvent):
            if event.anchor not in named or any(name == event.anchor for name, _ in inside):
                raise ValueError("a value contains itself")
            total += named[event.anchor]
        elif isinstance(event, CollectionStartEvent):
            inside.append((event.anchor, total))
            total += 1
        elif isinstance(event, CollectionEndEvent):
            name, before = inside.pop()
            named[name] = total - before
        elif isinstance(event, ScalarEvent):
            named[event.anchor] = 1
            total += 1
            if len(event.value) > MOST_CHARS:
                raise ValueError(f"a value has {len(event.value)} characters")
        if len(inside) > MOST_DEPTH:
            raise ValueError("nested too deeply")
        if total > MOST_VALUES:
            raise ValueError(f"it has more than {MOST_VALUES} values with every alias written out")
    return total


def _said(error: Exception) -> str:
    mark = getattr(error, "problem_mark", None)
    return f"not YAML{f' (line {mark.line + 1})' if mark else ''}"
