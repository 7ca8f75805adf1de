"""Tables of a run that are read when it has ended: their rows wait in a temporary file, not in memory."""

from __future__ import annotations

import os
import tempfile
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from stereo_sfm.mapping.columns import Spec

BLOCK = 2048  # rows that are written together; a run with fewer makes no file


class SpooledColumns:
    """Rows that are appended one by one and read together. A subclass names its columns in SPEC, as `Columns` does.

    Reading `table.name` gives a column (rows, ...) that is not to be written to. It is read from the file, and stays in
    memory until rows are appended. Where no temporary file can be written, rows stay in memory.
    """

    SPEC: ClassVar[Spec] = {}

    def __init__(self) -> None:
        self._dtype = np.dtype([(name, *spec[:2]) for name, spec in self.SPEC.items()])
        self._block: NDArray[Any] = np.empty(BLOCK, self._dtype)
        self._count = 0  # rows of the block in use
        self._file: Any = None
        self._written = 0  # rows in the file
        self._kept: list[NDArray[Any]] = []  # blocks that the file did not take
        self._columns: dict[str, NDArray[Any]] = {}  # what was read

    def __len__(self) -> int:
        return self._written + BLOCK * len(self._kept) + self._count

    def __getattr__(self, name: str) -> Any:
        if name not in self.SPEC:
            raise AttributeError(name)
        if name not in self._columns:
            rows = self._rows()
            self._columns = {column: np.ascontiguousarray(rows[column]) for column in self.SPEC}
        return self._columns[name]

    def append_row(self, **values: Any) -> None:
        """A new row at the end, with a value for every column."""
        if self._count == BLOCK:
            self._put_away()
        row = self._block[self._count]
        for name in self.SPEC:
            row[name] = values[name]
        self._count += 1
        self._columns = {}

    def last(self, name: str) -> Any:
        """The value of a column in the last row, without reading the file."""
        if not self._count:
            raise IndexError("the table has no rows")
        return self._block[self._count - 1][name]

    def _put_away(self) -> None:
        """Write the block, which is full, or keep it."""
        self._count = 0
        if self._kept or not self._write(memoryview(self._block.tobytes())):
            self._kept.append(self._block.copy())

    def _write(self, data: memoryview) -> bool:
        """Whether the file took the block; not if the disk is full, or no folder can be written to."""
        at = self._written * self._dtype.itemsize
        try:
            self._file = self._file or tempfile.TemporaryFile(buffering=0)  # noqa: SIM115  # closed with this table
            while data:
                done = os.pwrite(self._file.fileno(), data, at)
                data, at = data[done:], at + done
        except OSError:
            return False
        self._written += BLOCK
        return True

    def _rows(self) -> NDArray[Any]:
        """All rows."""
        parts = [*self._kept, self._block[: self._count]]
        if self._written:
            self._file.seek(0)
            parts.insert(0, np.fromfile(self._file, self._dtype, self._written))
        return np.concatenate(parts)
