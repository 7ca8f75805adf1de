"""The `rig` option that every dataset driver takes: a calibration that replaces the data set's own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from calib.rig import Rig
from stereo_sfm.errors import StereoSfmError

RigOption = str | Path | Rig | None


def chosen_rig(option: RigOption, own: Callable[[], Rig]) -> Rig:
    """The rig given by the user, as a `Rig` or a file of any dialect that `calib` reads, else the data set's own.

    A given rig that does not know its body keeps the data set's, so that ground truth of the body stays usable.
    """
    if option is None or option == "":
        return own()
    given = option if isinstance(option, Rig) else _load(Path(option))
    if not np.array_equal(given.body_T_left, np.eye(4)):
        return given
    try:
        return replace(given, body_T_left=own().body_T_left)
    except StereoSfmError:
        return given


def _load(path: Path) -> Rig:
    from calib import load_rig

    return load_rig(path)
