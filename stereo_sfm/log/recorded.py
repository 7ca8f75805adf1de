"""Messages of a log as the project's types, and what a replay needs to know about a run."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from typing import Any

from google.protobuf.message import DecodeError

from stereo_sfm.config import Config
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.log import schema, topics
from stereo_sfm.log.attached import attached_config, attached_rig
from stereo_sfm.log.provenance import ENDED_EARLY, METADATA, SOURCE_RIG_FILE, Opening
from stereo_sfm.log.reader import LogReader, Record
from stereo_sfm.types import Applied, Dropped, StartCheck

TYPES: dict[str, type[Any]] = {topic.schema: message for message, topic in topics.OF.items()}


def messages(
    reader: LogReader, names: Collection[str] | None = None, start: int | None = None, until: int | None = None
) -> Iterator[tuple[Record, Any]]:
    """Records with their decoded messages: the project's dataclasses, or Foxglove's protobuf messages.

    Args:
        reader: the open file.
        names: topics, None for all. Messages of unknown schemas are omitted.
        start: first log time, inclusive. until: last log time, inclusive.

    Raises:
        StereoSfmError: a message, or the schema of a topic, is damaged.
    """
    decoders: dict[str, Callable[[bytes], Any] | None] = {}
    for record in reader.messages(names, start, until):
        if record.schema is None or record.channel.message_encoding != "protobuf":
            continue
        name = record.schema.name
        try:
            if name not in decoders:
                decoders[name] = _decoder(name, record.schema.data)
            decode = decoders[name]
            message = None if decode is None else decode(record.data)
        except (ValueError, DecodeError) as error:
            raise StereoSfmError(f"{reader.path}: {record.topic} cannot be read: {error}") from None
        if decode is not None:
            yield record, message


def _decoder(name: str, data: bytes) -> Callable[[bytes], Any] | None:
    if name in TYPES:
        return schema.decoder(TYPES[name], data)
    package, _, kind = name.partition(".")
    if package != "foxglove":
        return None
    try:
        return getattr(importlib.import_module(f"foxglove_schemas_protobuf.{kind}_pb2"), kind).FromString
    except (ImportError, AttributeError):
        return None


@dataclass(frozen=True)
class RecordedRun:
    """How a run was made."""

    source: str
    mode: str  # "inline", "lockstep", "realtime"
    image_format: str  # "none" when the images are elsewhere
    config: Config
    applied: list[Applied]
    dropped: list[Dropped]
    depth_frames: frozenset[int] = frozenset()  # images with a live depth
    opening: Opening = field(default_factory=Opening)  # of the source
    start_check: StartCheck | None = None  # that the run began with


def read_run(reader: LogReader) -> RecordedRun:
    """Configuration and schedule of a run.

    Raises:
        StereoSfmError: the file is a recording, not a run; or a run of a version with other settings.
    """
    config = attached_config(reader)
    if config is None:
        raise StereoSfmError(
            f"{reader.path} is not the log of a run: it has no configuration (use 'stereo-sfm run' instead)"
        )
    about = reader.metadata(METADATA)
    found: dict[str, list[Any]] = {topics.APPLIED: [], topics.DROPPED: [], topics.START_CHECK: []}
    for record, message in messages(reader, tuple(found)):
        found[record.topic].append(message)
    return RecordedRun(
        about.get("source", ""),
        about.get("mode", ""),
        about.get("image_format", ""),
        config,
        found[topics.APPLIED],
        found[topics.DROPPED],
        frozenset(record.sequence for record in reader.messages((topics.LIVE_DEPTH,))),
        read_opening(reader),
        next(iter(found[topics.START_CHECK]), None),
    )


def ended_early(reader: LogReader) -> bool:
    """Whether the log lacks the end of the run: the run was killed, or the file was cut off."""
    return bool(reader.truncated) or ENDED_EARLY.items() <= reader.metadata(METADATA).items()


def read_opening(reader: LogReader) -> Opening:
    """How the source of a run was opened."""
    about = reader.metadata(METADATA)
    return Opening(
        about.get("rectify", "none"),
        attached_rig(reader, SOURCE_RIG_FILE),
        about.get("map_in", ""),
        about.get("map_sha256", ""),
        about.get("localize_only") == "true",
        int(about.get("frame_skip", "1")),
    )
