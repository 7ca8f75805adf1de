"""The columns of a saved map, validated on loading."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

MAX_ID = 1 << 40  # ids count up from 0
ROTATION_TOLERANCE = 1e-6  # deviation of a rotation from orthonormal


@dataclass(frozen=True)
class Column:
    """One array of a table; an index column refers to rows of another table."""

    table: str
    dtype: str
    shape: tuple[int, ...] = ()  # of one row
    index: str = ""  # the table it refers to
    ascending: bool = False
    unknown: bool = False  # NaN means not observed


KEYS = {"keyframes": "kf_ids", "points": "pt_ids", "observations": "obs_kf", "corners": "corner_kf"}  # of each table
COLUMNS: dict[str, Column] = {
    "kf_ids": Column("keyframes", "int64", ascending=True),
    "frame_ids": Column("keyframes", "int64"),
    "stamp_ns": Column("keyframes", "int64"),
    "submap_ids": Column("keyframes", "int64"),
    "map_T_kf": Column("keyframes", "float64", (4, 4)),
    "down": Column("keyframes", "float64", (3,)),
    "down_sigma": Column("keyframes", "float64"),
    "sessions": Column("keyframes", "int64"),
    "pt_ids": Column("points", "int64", ascending=True),
    "points": Column("points", "float64", (3,)),
    "anchors": Column("points", "int64", index="keyframes"),
    "seen": Column("points", "int64"),
    "expected": Column("points", "int64"),
    "obs_kf": Column("observations", "int64", index="keyframes"),
    "obs_pt": Column("observations", "int64", index="points"),
    "uv_left": Column("observations", "float32", (2,)),
    "uv_right": Column("observations", "float32", (2,), unknown=True),
    "descriptors": Column("observations", "uint8", (32,)),
    "corner_kf": Column("corners", "int64", index="keyframes"),
    "corner_uv_left": Column("corners", "float32", (2,)),
    "corner_uv_right": Column("corners", "float32", (2,), unknown=True),
    "corner_points": Column("corners", "float32", (3,), unknown=True),
    "corner_descriptors": Column("corners", "uint8", (32,)),
    "corner_side": Column("corners", "bool"),
}


def check_columns(arrays: Mapping[str, Any]) -> None:
    """Check that the arrays form a map.

    Raises:
        ValueError: an invalid array, named in the message.
    """
    rows = {name: len(np.atleast_1d(arrays[first])) for name, first in KEYS.items()}
    for name, column in COLUMNS.items():
        array = arrays[name]
        if array.dtype != column.dtype or array.shape != (rows[column.table], *column.shape):
            raise ValueError(f"{name} has {array.dtype} numbers of shape {array.shape}")
        if array.dtype.kind == "f" and not (np.isfinite(array) | (column.unknown & np.isnan(array))).all():
            raise ValueError(f"{name} is not finite")
        if array.dtype.kind == "i" and name != "stamp_ns":
            _check_numbers(name, array, column, rows.get(column.index, MAX_ID))
    rotations = arrays["map_T_kf"][:, :3, :3]
    if not np.allclose(rotations @ rotations.transpose(0, 2, 1), np.eye(3), atol=ROTATION_TOLERANCE):
        raise ValueError("map_T_kf is not rigid")


def _check_numbers(name: str, array: Any, column: Column, above: int) -> None:
    if len(array) and not 0 <= array.min() <= array.max() < above:
        raise ValueError(f"{name} has numbers from {array.min()} to {array.max()}")
    if column.ascending and (np.diff(array) <= 0).any():
        raise ValueError(f"{name} is not in order")
