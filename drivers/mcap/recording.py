"""What a recording of another program must offer to be a source."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import Protocol

from stereo_sfm.log.reader import Record, TopicInfo
from stereo_sfm.storage.remote import Place


class Recording(Protocol):
    """Messages by topic and time: an MCAP file (`stereo_sfm.log.reader.LogReader`) or a ROS bag."""

    by_time: bool  # messages come in the order of their log time, else in that of the file, if the kind of file can

    @property
    def path(self) -> Place:
        """The file or folder."""
        ...

    @property
    def topics(self) -> list[TopicInfo]:
        """Every topic that has messages, by name."""
        ...

    @property
    def time_range(self) -> tuple[int, int]:
        """First and last log time, nanoseconds."""
        ...

    def messages(
        self, topics: Collection[str] | None = None, start: int | None = None, until: int | None = None
    ) -> Iterator[Record]:
        """Messages of some topics (None: all) in the order that `by_time` says, both ends inclusive."""
        ...

    def step_back_ns(self, topic: str) -> int:
        """How far the log time goes back at most from one message of a topic to the next."""
        ...

    def close(self) -> None: ...
