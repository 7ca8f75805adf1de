"""Tables of results as files that other programs read: CSV, and Parquet where pyarrow is installed."""

from __future__ import annotations

import csv
import importlib.util
import logging
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from stereo_sfm.errors import printable
from stereo_sfm.input_file import refuse_pipe

log = logging.getLogger("stereo_sfm")


def write_table(path: Path, columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> list[Path]:
    """Write PATH.csv and PATH.parquet.

    Args:
        path: without a suffix.
        columns: their names.
        rows: numbers, texts, or None for a missing value, which is empty in the CSV and null in the Parquet file.

    Returns:
        The written files.

    Raises:
        StereoSfmError: one of them is a pipe.
    """
    made = [[_value(value) for value in row] for row in rows]
    file, other = path.with_name(f"{path.name}.csv"), path.with_name(f"{path.name}.parquet")
    refuse_pipe(file)
    refuse_pipe(other)
    with file.open("w", newline="", encoding="utf-8") as stream:
        csv.writer(stream).writerows([columns, *(["" if value is None else value for value in row] for row in made)])
    if importlib.util.find_spec("pyarrow") is None:
        log.info("no Parquet table is written: pip install 'stereo-sfm[table]'")
        return [file]
    import pyarrow
    from pyarrow import parquet

    data = {name: _column([row[k] for row in made]) for k, name in enumerate(columns)}
    parquet.write_table(pyarrow.table(data), other)
    return [file, other]


def _value(value: Any) -> Any:
    """None for what is missing: an empty text, or no number."""
    value = printable(value) if isinstance(value, str) else value
    return None if value == "" or (isinstance(value, float) and not math.isfinite(value)) else value


def _column(values: list[Any]) -> list[Any]:
    """Of one type: numbers that stand beside texts become texts."""
    mixed = any(isinstance(value, str) for value in values)
    return [str(value) if mixed and value is not None else value for value in values]
