"""The columns of a saved map, validated on loading."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, get_type_hints

import numpy as np

from stereo_sfm.mapping.snapshot import Column, MapSnapshot

MAX_ID = 1 << 40  # ids count up from 0, a thousand a second for 30 years

_HINTS = get_type_hints(MapSnapshot, include_extras=True)
COLUMNS: dict[str, Column] = {name: hint.__metadata__[0] for name, hint in _HINTS.items()}
COLUMNS["sessions"] = Column("keyframes", "int64")  # of `SavedMap`
KEYS = {"keyframes": "kf_ids", "points": "pt_ids", "observations": "obs_kf", "corners": "corner_kf"}  # of each table


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
            if len(array) and not 0 <= array.min() <= array.max() < rows.get(column.index, MAX_ID):
                raise ValueError(f"{name} has numbers from {array.min()} to {array.max()}")
            if column.ascending and (np.diff(array) <= 0).any():
                raise ValueError(f"{name} is not in order")
    rotations = arrays["map_T_kf"][:, :3, :3]  # a float32 that somebody wrote deviates less from orthonormal
    if not np.allclose(rotations @ rotations.transpose(0, 2, 1), np.eye(3), atol=1e-6):
        raise ValueError("map_T_kf is not rigid")
