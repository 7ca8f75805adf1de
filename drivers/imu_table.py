"""Inertial samples in a text table, one row per sample."""

from __future__ import annotations

import csv
import logging
from pathlib import Path

import numpy as np

from stereo_sfm.drivers.checked_samples import wrong_imu_units
from stereo_sfm.drivers.text_file import read_text
from stereo_sfm.types import ImuSamples

log = logging.getLogger("stereo_sfm")

COLUMNS = 7


def read_imu_samples(path: Path) -> ImuSamples | None:
    """Samples of a table `stamp_ns, wx, wy, wz (rad/s), ax, ay, az (m/s^2)`, in stamp order.

    Invalid rows are skipped with one warning; if the units are wrong (degrees, g), all samples are discarded with a
    warning, and the run continues without them.
    """
    rows: list[list[float]] = []
    stamps: list[int] = []
    bad = 0
    for row in csv.reader(read_text(path).splitlines()):
        if not row or row[0].lstrip().startswith("#"):
            continue
        try:
            stamp, values = int(row[0]), [float(v) for v in row[1:COLUMNS]]
        except ValueError:
            bad += 1
            continue
        if len(values) < COLUMNS - 1 or not np.isfinite(values).all() or not 0 <= stamp < 1 << 63:
            bad += 1
            continue
        stamps.append(stamp)
        rows.append(values)
    stamp_ns, first = np.unique(np.array(stamps, np.int64), return_index=True)
    bad += len(stamps) - len(stamp_ns)
    if bad:
        log.warning("%s: %d duplicate or invalid samples are skipped", path, bad)
    if not len(stamp_ns):
        return None
    values = np.array(rows)[first]
    why = wrong_imu_units(values[:, :3], values[:, 3:])
    if why:
        log.warning("%s: %s: the inertial samples are not used", path, why)
        return None
    return ImuSamples(stamp_ns, values[:, :3].copy(), values[:, 3:].copy())
