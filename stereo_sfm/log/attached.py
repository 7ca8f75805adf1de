"""Files attached to a log as our own types again. One that is damaged counts as absent, with a warning."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import TypeVar

import numpy as np

from stereo_sfm.arrays import read_arrays
from stereo_sfm.calib.formats.native import rig_from_text
from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import Config, from_dict, parse_toml
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.log.image_log import RIG_FILE, TRUTH_FILE
from stereo_sfm.log.provenance import CONFIG_FILE
from stereo_sfm.log.reader import LogReader
from stereo_sfm.types import Trajectory

log = logging.getLogger("stereo_sfm")
T = TypeVar("T")


def attached_rig(reader: LogReader, name: str = RIG_FILE) -> Rig | None:
    """A calibration.

    Raises:
        StereoSfmError: it is malformed.
    """
    return _read(reader, name, lambda raw: rig_from_text(raw.decode(), f"{name} in {reader.path}"))


def attached_truth(reader: LogReader) -> Trajectory | None:
    """The ground truth."""
    return _read(reader, TRUTH_FILE, _trajectory)


def attached_config(reader: LogReader) -> Config | None:
    """The configuration of a run.

    Raises:
        StereoSfmError: it was written by a version with other settings.
    """
    return _read(reader, CONFIG_FILE, lambda raw: _config(raw, reader))


def _read(reader: LogReader, name: str, parse: Callable[[bytes], T]) -> T | None:
    raw = reader.attachment(name)
    if raw is None:
        return None
    try:
        return parse(raw)
    except (ValueError, LookupError, RecursionError) as error:
        log.warning("%s: the attached %s is damaged (%s) and ignored", reader.path, name, error)
        return None


def _trajectory(raw: bytes) -> Trajectory:
    """The inverse of `truth_to_bytes`."""
    arrays = read_arrays(raw)
    stamp_ns, poses = arrays["stamp_ns"], arrays["poses"]
    if stamp_ns.dtype != np.int64 or poses.dtype != np.float64 or poses.shape != (*stamp_ns.shape, 4, 4):
        raise ValueError("its arrays are not a trajectory")
    return Trajectory(stamp_ns, poses, "positions_only" not in arrays)


def _config(raw: bytes, reader: LogReader) -> Config:
    settings = parse_toml(raw.decode())
    try:
        return from_dict(settings)
    except StereoSfmError as error:
        raise StereoSfmError(
            f"{reader.path} was written by another version of stereo-sfm, use that one: {error}"
        ) from None
