"""Tables of growing columns."""

from __future__ import annotations

import numpy as np

from stereo_sfm.mapping.columns import Columns, column
from stereo_sfm.types import F64, I64


class Table(Columns):
    """With the tuple that Python 3.13 gives every class."""

    __static_attributes__ = ()
    number: I64 = column(np.int64, -1)
    place: F64 = column(np.float64, 0.0, (3,))


def test_only_columns_are_columns() -> None:
    assert set(Table.spec) == {"number", "place"}
    table = Table(2)
    table.append(3, place=np.ones((3, 3)))
    assert table.number.tolist() == [-1, -1, -1] and table.place.shape == (3, 3)
