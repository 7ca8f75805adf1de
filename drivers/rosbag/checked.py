"""What is checked of a bag before the rosbags library sees it, which opens files by their names and trusts their text.

A bag is a file, or a folder of files with metadata.yaml. In it, and in each .db3 and .mcap, stand the qualities of
service of the topics, a text that the library parses, too.
"""

from __future__ import annotations

import re
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

from mcap.reader import make_reader

from stereo_sfm.input_file import count_values, open_regular, read_yaml
from stereo_sfm.log.chunks import DAMAGE
from stereo_sfm.log.scan import build_index, summary_is_whole

METADATA = "metadata.yaml"
INFORMATION = "rosbag2_bagfile_information"  # the key of all that it says
MOST_METADATA = 4 << 20  # bytes: a bag in ten thousand files has some 1.5 MB
_ANOTHER_PATH = re.compile(r"[?#]|%[0-9a-fA-F]{2}")  # of a path in the address of a database
_QUALITIES = "offered_qos_profiles"


def check_bag(path: Path) -> dict[str, Any]:
    """Look at all files of a bag.

    Args:
        path: a bag's folder, or one of its files.

    Returns:
        The content of its metadata.yaml; empty where it has none.

    Raises:
        NotAFile: a pipe or a device among them, or a metadata.yaml larger than `MOST_METADATA`.
        ValueError: a text that is no YAML, or more than `count_values` allows; a path that the library cannot open.
        OSError: no such file.
    """
    files = sorted(p for p in path.iterdir() if p.exists() and not p.is_dir()) if path.is_dir() else [path]
    metadata, values = dict[str, Any](), 0
    for file in files:
        open_regular(file).close()
        if file.suffix == ".db3" and (found := _ANOTHER_PATH.search(str(file))):
            raise ValueError(f"the library takes {file} for another path: rename what has '{found[0]}' in its name")
        if file.name == METADATA:
            metadata = read_yaml(file, MOST_METADATA)
            texts = _of_topics(metadata)
        else:
            texts = _of_table(file) if file.suffix == ".db3" else _of_channels(file) if file.suffix == ".mcap" else []
        for text in texts:
            if isinstance(text, str):
                values = count_values(text, values + 1)
    return metadata


def _of_topics(metadata: Any) -> list[Any]:
    """The texts of the topics that a metadata.yaml lists."""
    try:
        topics = metadata[INFORMATION]["topics_with_message_count"]
        return [topic["topic_metadata"].get(_QUALITIES) for topic in topics]
    except (LookupError, TypeError, AttributeError):
        raise ValueError(f"its {METADATA} does not list its topics") from None


def _of_channels(file: Path) -> list[Any]:
    """The texts of a file's channels: those listed at its end, or, where the library reads all of it, all of them."""
    with open_regular(file) as stream:
        try:
            whole = summary_is_whole(stream)
            stream.seek(0)
            summary = make_reader(stream).get_summary() if whole else None
        except DAMAGE:
            summary = None
        listed = summary is not None and summary.schemas and (summary.statistics or summary.chunk_indexes)
        channels = summary.channels if summary is not None and listed else build_index(stream).channels
    return [channel.metadata.get(_QUALITIES) for channel in channels.values()]


def _of_table(file: Path) -> Iterator[Any]:
    """The texts in the table of topics; none where there is no such table, of which the library complains."""
    is_a_table = "EXISTS (SELECT 1 FROM sqlite_master WHERE type = 'table' AND name = 'topics')"
    try:
        with closing(sqlite3.connect(f"{file.resolve().as_uri()}?mode=ro&immutable=1", uri=True)) as connection:
            for (text,) in connection.execute(f"SELECT {_QUALITIES} FROM topics WHERE {is_a_table}"):
                yield text
    except sqlite3.Error:
        return
