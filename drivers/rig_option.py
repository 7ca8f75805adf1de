"""The `rig` option of dataset drivers: a calibration that replaces the dataset's own."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from stereo_sfm.calib.lens_doubts import length_doubts
from stereo_sfm.calib.rig import Rig
from stereo_sfm.errors import StereoSfmError

log = logging.getLogger("stereo_sfm")

RigOption = str | Path | Rig | None


def chosen_rig(option: RigOption, own: Callable[[], Rig]) -> Rig:
    """The rig given by the user, as a `Rig` or a file of any supported format, else the dataset's own.

    A given rig without a body pose takes the dataset's, so that ground truth of the body stays usable; likewise the
    readout, if the file format cannot store it. A warning says what is unusual about the rig's lengths.
    """
    rig = _chosen(option, own)
    for doubt in length_doubts(rig):
        log.warning("%s: %s", rig.name or "calibration", doubt)
    return rig


def _chosen(option: RigOption, own: Callable[[], Rig]) -> Rig:
    if option is None or option == "":
        try:
            return own()
        except StereoSfmError as error:
            if "--rig" in str(error):
                raise
            raise StereoSfmError(f"{error}: correct it, or give a calibration with --rig FILE") from None
    given, stated = (option, True) if isinstance(option, Rig) else _load(Path(option))
    bodiless = np.array_equal(given.body_T_left, np.eye(4))
    if not bodiless and stated:
        return given
    try:
        known = own()
    except StereoSfmError:
        return given
    return replace(
        given,
        body_T_left=known.body_T_left if bodiless else given.body_T_left,
        imu=given.imu or (known.imu if bodiless else None),
        wheel=given.wheel or (known.wheel if bodiless else None),
        readout_s=given.readout_s if stated else known.readout_s,
    )


def _load(path: Path) -> tuple[Rig, bool]:
    """The rig of a file, and whether its format stores a readout."""
    from stereo_sfm.calib import load_rig
    from stereo_sfm.calib.formats import recognise

    path = path.expanduser()
    kind = recognise(path) if path.exists() else None
    return load_rig(path, kind), kind == "rig"
