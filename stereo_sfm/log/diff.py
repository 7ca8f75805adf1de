"""Compare two logs: the first message of every topic in which they differ. Wall-clock times are not compared."""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from google.protobuf.message import DecodeError
from mcap.exceptions import McapError
from mcap_protobuf.decoder import DecoderFactory

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.log import images, topics
from stereo_sfm.log.provenance import CONFIG_FILE
from stereo_sfm.log.reader import LogReader, Record

IMAGE_SCHEMAS = ("foxglove.RawImage", "foxglove.CompressedImage")


@dataclass(frozen=True)
class Difference:
    """The first difference of two logs in a topic."""

    topic: str
    frame_id: int  # -1: the topic as a whole
    stamp_ns: int
    field: str
    a: str
    b: str

    def __str__(self) -> str:
        where = f"{self.topic} frame {self.frame_id} at {self.stamp_ns} ns" if self.frame_id >= 0 else self.topic
        return f"{where}: {self.field}: {self.a} != {self.b}"


def compared(topic: str, a: LogReader, b: LogReader) -> bool:
    """Whether a topic is compared: by the table of topics; topics of other programs always are."""
    row = topics.BY_NAME.get(topic)
    return row is None or row.topic.compare or (topic not in _names(a) and topic not in _names(b))


def _names(reader: LogReader) -> set[str]:
    return {t.topic for t in reader.topics}


def diff(a: LogReader, b: LogReader, only: Collection[str] = (), tolerance: float = 0.0) -> list[Difference]:
    """The first difference of every topic that has one, in the order of time; empty when the logs are the same.

    Args:
        a: one log.
        b: the other.
        only: topics to look at, all that are compared when empty.
        tolerance: tolerance for the numbers of a message.

    Raises:
        StereoSfmError: `only` names a topic that neither log has.
    """
    everywhere = _names(a) | _names(b)
    unknown = sorted(set(only) - everywhere)
    if unknown:
        raise StereoSfmError(f"neither file has the topic {unknown[0]} (there are: {', '.join(sorted(everywhere))})")
    names = sorted(t for t in everywhere if (t in only if only else compared(t, a, b)))
    found = _attachment(a, b) if not only else []
    both = [t for t in names if t in _names(a) and t in _names(b)]
    for topic in names:
        if topic not in both:
            present = topic in _names(a)
            found.append(Difference(topic, -1, -1, "messages", *_sides(present, "present", "missing")))
    return sorted([*found, *_Comparison(tolerance).run(a, b, both)], key=lambda d: (d.stamp_ns, _rank(d.topic)))


def _sides(first: bool, one: str, other: str) -> tuple[str, str]:
    return (one, other) if first else (other, one)


def _rank(topic: str) -> tuple[int, str]:
    names = [t.name for t in topics.TABLE]
    return (names.index(topic) if topic in names else len(names), topic)


def _attachment(a: LogReader, b: LogReader) -> list[Difference]:
    one, other = a.attachment("calibration.yaml"), b.attachment("calibration.yaml")
    if one == other or one is None or other is None:
        return []
    lines = itertools.zip_longest(
        one.decode(errors="replace").splitlines(), other.decode(errors="replace").splitlines(), fillvalue="(nothing)"
    )
    left, right = next(((x, y) for x, y in lines if x != y), ("one", "another encoding"))
    return [Difference("calibration.yaml", -1, -1, "line", left.strip(), right.strip())]


def _lines(text: bytes) -> list[str]:
    return text.decode(errors="replace").splitlines()


class _Comparison:
    """Both files read side by side, each topic's messages matched in their order."""

    def __init__(self, tolerance: float) -> None:
        self._tolerance = tolerance
        self._decoders: dict[tuple[int, str], Callable[[bytes], Any]] = {}
        self._factories = (DecoderFactory(), DecoderFactory())

    def run(self, a: LogReader, b: LogReader, names: Collection[str]) -> list[Difference]:
        """First difference per topic."""
        found: dict[str, Difference] = {}
        waiting: dict[str, tuple[deque[Record], deque[Record]]] = {t: (deque(), deque()) for t in names}
        for side, record in _interleaved(a.messages(names), b.messages(names)):
            if record.topic in found:
                continue
            queues = waiting[record.topic]
            queues[side].append(record)
            while queues[0] and queues[1] and record.topic not in found:
                difference = self._messages(queues[0].popleft(), queues[1].popleft())
                if difference is not None:
                    found[record.topic] = difference
            if record.topic in found:
                queues[0].clear()
                queues[1].clear()
        for topic, (left, right) in waiting.items():
            if left or right:
                extra = (left or right)[0]
                found[topic] = Difference(
                    topic, extra.sequence, extra.log_time, "message", *_sides(bool(left), "present", "missing")
                )
        return list(found.values())

    def _messages(self, a: Record, b: Record) -> Difference | None:
        if (a.sequence, a.log_time, a.data) == (b.sequence, b.log_time, b.data):
            return None
        for field, one, other in (("frame id", a.sequence, b.sequence), ("log_time", a.log_time, b.log_time)):
            if one != other:
                return Difference(a.topic, a.sequence, a.log_time, field, str(one), str(other))
        try:
            found = self._content(a, b)
        except (McapError, DecodeError, ValueError, TypeError, LookupError):  # one of them is damaged
            found = ("bytes", f"{len(a.data)} bytes", f"{len(b.data)} other bytes")
        return Difference(a.topic, a.sequence, a.log_time, *found) if found else None

    def _content(self, a: Record, b: Record) -> tuple[str, str, str] | None:
        names = tuple(r.schema.name if r.schema else "" for r in (a, b))
        if names[0] in IMAGE_SCHEMAS and names[1] in IMAGE_SCHEMAS:
            return _pixels(self._decode(0, a), self._decode(1, b))
        if names[0] != names[1]:
            return "schema", names[0] or "none", names[1] or "none"
        if a.channel.message_encoding != "protobuf":
            return "bytes", f"{len(a.data)} bytes", f"{len(b.data)} other bytes"
        return _fields(self._decode(0, a), self._decode(1, b), "", self._tolerance)

    def _decode(self, side: int, record: Record) -> Any:
        key = (side, record.topic)
        if key not in self._decoders:
            decoder = self._factories[side].decoder_for(record.channel.message_encoding, record.schema)
            assert decoder is not None
            self._decoders[key] = decoder
        return self._decoders[key](record.data)


def _interleaved(a: Iterator[Record], b: Iterator[Record]) -> Iterator[tuple[int, Record]]:
    """One of each in turn, so that neither side gets far ahead."""
    for one, other in itertools.zip_longest(a, b):
        if one is not None:
            yield 0, one
        if other is not None:
            yield 1, other


def _pixels(a: Any, b: Any) -> tuple[str, str, str] | None:
    """Images are equal if their pixels are, regardless of the compression."""
    one, other = (_decode_image(m) for m in (a, b))
    if one.shape != other.shape:
        return "size", f"{one.shape[1]}x{one.shape[0]}", f"{other.shape[1]}x{other.shape[0]}"
    row, column = np.unravel_index(int(np.argmax(_unequal(one, other))), one.shape)
    if not _unequal(one, other)[row, column]:
        return None if a.frame_id == b.frame_id else ("frame_id", a.frame_id, b.frame_id)
    return f"pixel ({column}, {row})", str(one[row, column]), str(other[row, column])


def _unequal(a: Any, b: Any) -> Any:
    return (a != b) & ~((a != a) & (b != b))


def _decode_image(message: Any) -> Any:
    if message.DESCRIPTOR.full_name == "foxglove.CompressedImage":
        return images.decode_file(message.data)
    if message.encoding.lower() == "32fc1":
        return images.decode_depth(message.data, message.width, message.height, message.step, message.encoding)
    return images.decode_raw(message.data, message.width, message.height, message.step, message.encoding)


def _fields(a: Any, b: Any, prefix: str, tolerance: float) -> tuple[str, str, str] | None:
    """First field, in the order of the schema, in which two protobuf messages differ."""
    names = [f.name for f in a.DESCRIPTOR.fields]
    names += [f.name for f in b.DESCRIPTOR.fields if f.name not in names]
    for name in names:
        path = f"{prefix}{name}"
        if name not in a.DESCRIPTOR.fields_by_name or name not in b.DESCRIPTOR.fields_by_name:
            return path, *_sides(name in a.DESCRIPTOR.fields_by_name, "present", "not in the schema")
        found = _values(getattr(a, name), getattr(b, name), path, tolerance)
        if found is not None:
            return found
    return None


def _values(a: Any, b: Any, path: str, tolerance: float) -> tuple[str, str, str] | None:
    if hasattr(a, "__len__") and not isinstance(a, (str, bytes)):
        if len(a) != len(b):
            return f"{path} (count)", str(len(a)), str(len(b))
        for i, (one, other) in enumerate(zip(a, b, strict=True)):
            found = _values(one, other, f"{path}[{i}]", tolerance)
            if found is not None:
                return found
        return None
    if hasattr(a, "DESCRIPTOR"):
        return _fields(a, b, f"{path}.", tolerance)
    return None if _same(a, b, tolerance) else (path, _show(a), _show(b))


def _same(a: Any, b: Any, tolerance: float) -> bool:
    if isinstance(a, float) and isinstance(b, float):
        return a == b or (a != a and b != b) or abs(a - b) <= tolerance
    return bool(a == b)


def _show(value: Any) -> str:
    if isinstance(value, bytes):
        return f"{len(value)} bytes {value[:8].hex()}..."
    return repr(value)


def configurations(a: LogReader, b: LogReader) -> list[str]:
    """Lines of the configuration that differ, "a -> b": the usual reason why two runs differ."""
    one, other = a.attachment(CONFIG_FILE), b.attachment(CONFIG_FILE)
    if one is None or other is None or one == other:
        return []
    first, second = _lines(one), _lines(other)
    return [f"{x.strip()} -> {y.strip()}" for x, y in itertools.zip_longest(first, second, fillvalue="") if x != y]
