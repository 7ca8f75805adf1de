"""Tables of growing columns: one array per column, appended in amortised constant time; rows of a table by id."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from numpy.typing import DTypeLike

from stereo_sfm.types import I32, I64, Bool

Spec = dict[str, tuple[DTypeLike, tuple[int, ...], Any]]
SPARE = 4  # one spare row for so many in use: rows are copied four times on the way, and little memory is unused
FEW = 512  # rows that are not worth to be freed: tens of kilobytes


def column(dtype: DTypeLike, default: Any, shape: tuple[int, ...] = ()) -> Any:
    """A column of a table: numbers of a type, the value of a new row, the shape of one value."""
    return dtype, shape, default


class Columns:
    """Rows in arrays. A subclass names its columns, each as an attribute that is a `column`.

    `table.name` is a view (rows, ...) of the column that may be written to; it is valid until rows are appended.
    """

    spec: ClassVar[Spec] = {}

    def __init_subclass__(cls) -> None:
        cls.spec = {name: value for name, value in vars(cls).items() if isinstance(value, tuple) and name[:2] != "__"}

    def __init__(self, capacity: int = 64) -> None:
        self._count = 0
        self._data = {name: np.empty((capacity, *shape), dtype) for name, (dtype, shape, _) in self.spec.items()}
        self._show()

    def __len__(self) -> int:
        return self._count

    def _show(self) -> None:
        """Make the columns attributes."""
        self.__dict__.update({name: data[: self._count] for name, data in self._data.items()})

    def append(self, count: int, **values: Any) -> slice:
        """New rows at the end; columns that are not given take their default. Returns the rows."""
        first, last = self._count, self._count + count
        for name, data in self._data.items():
            if last > len(data):
                grown = np.empty((max(last, first + first // SPARE, 64), *data.shape[1:]), data.dtype)
                grown[:first] = data[:first]
                self._data[name] = data = grown
            data[first:last] = values.pop(name) if name in values else self.spec[name][2]
        if values:
            raise TypeError(f"no such columns: {', '.join(values)}")
        self._count = last
        self._show()
        return slice(first, last)

    def keep(self, rows: I64) -> None:
        """Only these rows stay, in this order."""
        for name, data in self._data.items():
            kept = np.empty((max(len(rows) + len(rows) // SPARE, 64), *data.shape[1:]), data.dtype)
            kept[: len(rows)] = data[rows]
            self._data[name] = kept
        self._count = len(rows)
        self._show()

    def much_unused(self, used: int) -> bool:
        """Whether more rows than are spared for growth anyway, and not only a few, are not among those `used`."""
        return len(self) > used + used // SPARE + FEW


class IdRows:
    """Which row each id has that is known for a while. Its size follows the number of known ids, not the highest."""

    def __init__(self) -> None:
        self.ids: I64 = np.zeros(0, np.int64)  # ascending
        self.rows: I32 = np.zeros(0, np.int32)  # of each of them; may be written to

    def find(self, ids: I64) -> I64:
        """(N,) row of each id, -1 for an unknown one."""
        if not len(self.ids):
            return np.full(len(ids), -1, np.int64)
        at = np.minimum(np.searchsorted(self.ids, ids), len(self.ids) - 1)
        return np.where(self.ids[at] == ids, self.rows[at], -1).astype(np.int64)

    def add(self, ids: I64, rows: I64) -> None:
        """Add unknown ids (N,), each of them once, with their rows (N,)."""
        order = np.argsort(ids)
        at = np.searchsorted(self.ids, ids[order])
        self.ids, self.rows = np.insert(self.ids, at, ids[order]), np.insert(self.rows, at, rows[order])

    def keep(self, known: Bool) -> None:
        """Forget all ids but those marked (N,)."""
        self.ids, self.rows = self.ids[known], self.rows[known]
