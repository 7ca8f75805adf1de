"""An object as a stream that can seek: it is read by ranges, larger ones the longer it is read in order."""

from __future__ import annotations

import io
from collections import OrderedDict

from stereo_sfm.storage import objects
from stereo_sfm.storage.remote import Remote

PAGE = 1 << 16  # bytes: the least that is asked for, besides `ranges`
MOST_AHEAD = 32  # pages of a request that reads ahead in order: 2 MiB hide 50 ms of latency at 40 MB/s
KEPT = 512  # pages, 32 MiB: the index and the first images, which `info` reads several times
NEAR = 4  # pages left out that still count as in order: the message index between two chunks of a recording


class RangeStream(io.BufferedIOBase):  # raw ones are wrapped by readers, and closed with the wrapper
    """A file object for reading.

    Attributes:
        received: bytes that were asked for.
    """

    def __init__(self, remote: Remote) -> None:
        """Raises StereoSfmError if there is no such object, or it cannot be read."""
        self.remote = remote
        self._size, self.tag = objects.size_and_tag(remote)
        self._at = 0
        self._pages: OrderedDict[int, bytes] = OrderedDict()
        self._next, self._ahead = 0, 0  # the page after the last request, and how many one asks for in order
        self.received = 0

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._at

    def seek(self, offset: int, whence: int = io.SEEK_SET, /) -> int:
        self._at = max({io.SEEK_SET: 0, io.SEEK_CUR: self._at, io.SEEK_END: self._size}[whence] + offset, 0)
        return self._at

    def read(self, size: int | None = -1, /) -> bytes:
        """As of any file: fewer bytes only at the end."""
        stop = self._size if size is None or size < 0 else min(self._at + size, self._size)
        if stop <= self._at:
            return b""
        first, end = self._at // PAGE, (stop - 1) // PAGE + 1
        pages = self._of(first, end)
        data = b"".join(pages)[self._at - first * PAGE : stop - first * PAGE]
        self._at = stop
        return data

    def _of(self, first: int, end: int) -> list[bytes]:
        """Pages first to end - 1; those between the first and the last that are missing are asked for at once."""
        missing = [k for k in range(first, end) if k not in self._pages]
        fresh: dict[int, bytes] = {}
        if missing:
            in_order = self._next <= missing[0] <= self._next + NEAR
            self._ahead = min(2 * self._ahead + 1, MOST_AHEAD) if in_order else 0
            begin, until = missing[0], missing[-1] + 1
            if until == end:
                until = max(until, begin + self._ahead)  # a large request needs nothing beyond itself
            length = min(until * PAGE, self._size) - begin * PAGE
            raw = objects.read_range(self.remote, begin * PAGE, length)
            self.received += length
            self._next = until
            fresh = {begin + k: raw[k * PAGE : (k + 1) * PAGE] for k in range((length - 1) // PAGE + 1)}
        out = [fresh[k] if k in fresh else self._pages[k] for k in range(first, end)]
        for k in range(first, end):
            if k in self._pages:
                self._pages.move_to_end(k)
        self._pages |= fresh
        while len(self._pages) > KEPT:
            self._pages.popitem(last=False)
        return out

    def ranges(self, wanted: list[tuple[int, int]]) -> list[bytes]:
        """Many small parts, each (start, length), exactly."""
        self.received += sum(length for _, length in wanted)
        return objects.read_ranges(self.remote, wanted)
