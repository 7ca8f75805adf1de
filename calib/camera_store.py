"""Corrected calibrations of cameras, by serial number, from one run to the next."""

from __future__ import annotations

import logging
import os
from dataclasses import replace
from pathlib import Path

from stereo_sfm.calib.choice import with_terms
from stereo_sfm.calib.formats.native import read_native, rig_to_text, write_native
from stereo_sfm.calib.rig import Rig
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.types import F64

log = logging.getLogger("stereo_sfm")
OF_FILE_NAMES = frozenset("ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789-_")


class CameraStore:
    """A folder with two files per camera: SERIAL.yaml, and SERIAL.original.yaml, the calibration that it corrects."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def corrected(self, rig: Rig) -> Rig:
        """The rig with the stored correction of its right camera; the rig itself if there is none for it.

        Raises:
            StereoSfmError: the rig has no serial number, or its files are damaged.
        """
        path = self._path(rig)
        if not path.exists():
            return rig
        if rig_to_text(read_native(self._original(path))) != rig_to_text(rig):
            log.warning("%s corrects another calibration of camera %s: not used", path, rig.serial)
            return rig
        stored = read_native(path)
        log.info("the calibration of camera %s is the corrected one of %s", rig.serial, path)
        return replace(rig, right=stored.right, left_T_right=stored.left_T_right)

    def keep(self, start: Rig, terms: F64) -> None:
        """Store the rig of a run's start, corrected by terms (6,) as in `CalibrationUpdate`.

        Raises:
            StereoSfmError: the rig has no serial number, or the files cannot be written.
        """
        path = self._path(start)
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            if not path.exists() or rig_to_text(read_native(path)) != rig_to_text(start):
                _write(start, self._original(path))
            _write(with_terms(start, terms), path)
        except OSError as error:
            raise StereoSfmError(f"the corrected calibration is not kept: {path}: {error.strerror}") from error
        log.info("the corrected calibration of camera %s is kept in %s", start.serial, path)

    def _path(self, rig: Rig) -> Path:
        if not rig.serial or not OF_FILE_NAMES.issuperset(rig.serial):
            raise StereoSfmError(
                f"{self.folder} keeps calibrations by serial number, and this camera's is '{rig.serial}': "
                "add `serial: NAME` (letters, digits, - and _) to its rig.yaml"
            )
        return self.folder / f"{rig.serial}.yaml"

    def _original(self, path: Path) -> Path:
        return path.with_suffix(".original.yaml")


def _write(rig: Rig, path: Path) -> None:
    """Whole or not at all."""
    part = path.with_suffix(".part")
    write_native(rig, part)
    os.replace(part, path)
