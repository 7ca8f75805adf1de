"""How the camera sits on the robot: measured in one session, used from then on and by the sessions after it."""

from __future__ import annotations

import logging
import os
from dataclasses import replace
from pathlib import Path

import numpy as np

from stereo_sfm.calib.formats.native import read_native, rig_to_text, write_native
from stereo_sfm.calib.rig import Rig
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.maps.mounting import Mounting, MountingEstimate, mounted, unknown
from stereo_sfm.types import Keyframe

log = logging.getLogger("stereo_sfm")


class RobotMounting:
    """Over the sessions of a service. Without effect where the calibration has a body or an IMU."""

    def __init__(self) -> None:
        self._file: Path | None = None
        self._estimate: MountingEstimate | None = None  # None: nothing is to be measured
        self._rig: Rig | None = None
        self._told = False  # the measured tilt is in use
        self._best = np.inf  # its standard deviation when it was written last
        self._due = 0  # steps of the drive at which it is measured next

    def begin(self, rig: Rig, folder: Path | None) -> Rig:
        """The calibration of a new session, with the kept tilt. Args: folder, of the map; None: nothing is kept."""
        self._estimate = MountingEstimate() if unknown(rig) else None
        self._file = None if folder is None else folder.with_name(f"{folder.name}.rig.yaml")
        kept = self._kept(rig) if self._estimate is not None else None
        self._rig, self._told, self._best, self._due = rig, kept is not None, np.inf, 0
        return rig if kept is None else kept

    def keyframe(self, keyframe: Keyframe) -> Rig | None:
        """Take a keyframe; the calibration with the tilt once that is measured for the first time."""
        if self._estimate is None or self._rig is None or not self._estimate.add(keyframe):
            return None
        found = self._estimate.result() if self._estimate.steps >= self._due else None
        if found is None or not found.measured:
            return None
        self._due = 2 * self._estimate.steps  # halved deviations need more than twice as many
        rig = mounted(self._rig, found)
        if found.pitch_sigma_deg + found.roll_sigma_deg < 0.5 * self._best:
            self._best = found.pitch_sigma_deg + found.roll_sigma_deg
            self._keep(rig, found)
        if self._told:
            return None
        self._told = True
        log.info("%s: poses are level from now on", found.text)
        return rig

    def _kept(self, rig: Rig) -> Rig | None:
        """The calibration with the tilt of an earlier session of the same camera."""
        if self._file is None or not self._file.exists():
            return None
        try:
            kept = read_native(self._file)
        except StereoSfmError as error:
            log.warning("%s; the camera's tilt is measured anew", error)
            return None
        if _camera(kept) != _camera(rig):
            log.warning("%s is of another camera: its tilt is measured anew", self._file)
            return None
        return replace(rig, body_T_left=kept.body_T_left)

    def _keep(self, rig: Rig, found: Mounting) -> None:
        """Whole or not at all."""
        if self._file is None:
            return
        part = self._file.with_suffix(".part")
        try:
            self._file.parent.mkdir(parents=True, exist_ok=True)
            write_native(rig, part)
            with part.open("a", encoding="utf-8") as out:
                out.write(f"\n# body_T_left was measured while driving: {found.text}\n")
            os.replace(part, self._file)
        except OSError as error:
            log.warning("the camera's tilt is not kept in %s: %s", self._file, error.strerror)


def _camera(rig: Rig) -> str:
    """What tells one left camera from another."""
    return rig_to_text(Rig(left=rig.left, serial=rig.serial))
