"""How the camera sits on the robot: measured in one session, used from then on and by the sessions after it."""

from __future__ import annotations

import logging
import os
from pathlib import Path

import numpy as np

from stereo_sfm.calib.formats.common import numbers, read_text, reading, yaml_mapping, yaml_text
from stereo_sfm.calib.formats.native import rig_from_plain, rig_to_plain, rig_to_text
from stereo_sfm.calib.rig import Rig
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.maps.mounting import ENOUGH_RAD, UPRIGHT_RAD, Mounting, MountingEstimate, mounted, unknown
from stereo_sfm.types import Keyframe

log = logging.getLogger("stereo_sfm")
SIGMA = "tilt_sigma_deg"  # of pitch and roll: beside the fields of the calibration


class RobotMounting:
    """Over the sessions of a service. Without effect where the calibration has a body or an IMU."""

    def __init__(self) -> None:
        self._file: Path | None = None
        self._estimate: MountingEstimate | None = None  # None: nothing is to be measured
        self._rig: Rig | None = None
        self._used: Mounting | None = None  # by the poses of the session
        self._best: Mounting | None = None  # of this camera so far: what the file has, and the next session uses
        self._due = 0  # steps of the drive at which it is measured next

    def begin(self, rig: Rig, folder: Path | None) -> Rig:
        """The calibration of a new session, with the kept tilt. Args: folder, of the map; None: nothing is kept."""
        self._estimate = MountingEstimate() if unknown(rig) else None
        self._file = None if folder is None else folder.with_name(f"{folder.name}.rig.yaml")
        before = self._best if self._rig is not None and _camera(self._rig) == _camera(rig) else None
        self._best = (self._kept(rig) or before) if self._estimate is not None else None
        self._rig, self._due, self._used = rig, 0, self._best
        return rig if self._used is None else mounted(rig, self._used)

    def keyframe(self, keyframe: Keyframe) -> Rig | None:
        """Take a keyframe; the calibration with the tilt where that was unknown before, or is another one now."""
        if self._estimate is None or self._rig is None or not self._estimate.add(keyframe):
            return None
        found = self._estimate.result() if self._estimate.steps >= self._due else None
        if found is None or not found.measured:
            return None
        self._due = 2 * self._estimate.steps  # halved deviations need more than twice as many
        best = self._best
        if best is None or found.contradicts(best) or found.surer(best):
            self._best = found
            self._keep(self._rig, found)
        if self._used is not None and not found.contradicts(self._used):
            return None
        self._used = found
        log.info("%s: poses are level from now on", found.text)
        return mounted(self._rig, found)

    def _kept(self, rig: Rig) -> Mounting | None:
        """The tilt that an earlier session of the same camera has measured."""
        if self._file is None or not self._file.exists():
            return None
        try:
            with reading(self._file, "tilt"):
                plain = yaml_mapping(read_text(self._file))
                kept = rig_from_plain(plain, self._file.parent)
                sigma = numbers(plain.get(SIGMA, np.degrees([ENOUGH_RAD, UPRIGHT_RAD])), 2)
                if min(sigma) <= 0:
                    raise ValueError(f"{SIGMA} is not positive")
        except StereoSfmError as error:
            log.warning("%s; the camera's tilt is measured anew", error)
            return None
        if _camera(kept) != _camera(rig):
            log.warning("%s is of another camera: its tilt is measured anew", self._file)
            return None
        return Mounting(kept.body_T_left[2, :3], *sigma)

    def _keep(self, rig: Rig, found: Mounting) -> None:
        """Whole or not at all."""
        if self._file is None:
            return
        part = self._file.with_suffix(".part")
        plain = rig_to_plain(mounted(rig, found)) | {SIGMA: [found.pitch_sigma_deg, found.roll_sigma_deg]}
        try:
            self._file.parent.mkdir(parents=True, exist_ok=True)
            part.write_text(f"{yaml_text(plain)}\n# body_T_left was measured while driving: {found.text}\n", "utf-8")
            os.replace(part, self._file)
        except OSError as error:
            log.warning("the camera's tilt is not kept in %s: %s", self._file, error.strerror)


def _camera(rig: Rig) -> str:
    """What tells one left camera from another."""
    return rig_to_text(Rig(left=rig.left, serial=rig.serial))
