"""Corrected calibrations of cameras, by serial number, from one run to the next."""

from __future__ import annotations

import logging
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from stereo_sfm.calib.choice import with_terms
from stereo_sfm.calib.formats.native import read_native, rig_to_text, write_native
from stereo_sfm.calib.rig import Rig
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.types import CalibrationUpdate

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
        return _with_right(rig, stored)

    def original(self, start: Rig) -> Rig:
        """The calibration that the rig of a run's start corrects; the rig itself if it is not the stored one.

        Raises:
            StereoSfmError: the rig has no serial number, or its files are damaged.
        """
        path = self._path(start)
        if path.exists() and rig_to_text(read_native(path)) == rig_to_text(start):
            return read_native(self._original(path))
        return start

    def keep(self, original: Rig, corrected: Rig) -> None:
        """Store a corrected rig and the one that it corrects.

        Raises:
            StereoSfmError: the rig has no serial number, or the files cannot be written.
        """
        path = self._path(original)
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            path.unlink(missing_ok=True)  # never beside an original that it does not correct
            _write(original, self._original(path))
            _write(corrected, path)
        except OSError as error:
            raise StereoSfmError(f"the corrected calibration is not kept: {path}: {error.strerror}") from error
        log.info("the corrected calibration of camera %s is kept in %s", original.serial, path)

    def _path(self, rig: Rig) -> Path:
        if not rig.serial or not OF_FILE_NAMES.issuperset(rig.serial):
            raise StereoSfmError(
                f"{self.folder} keeps calibrations by serial number, and this camera's is '{rig.serial}': "
                "add `serial: NAME` (letters, digits, - and _) to its rig.yaml"
            )
        return self.folder / f"{rig.serial}.yaml"

    def _original(self, path: Path) -> Path:
        return path.with_suffix(".original.yaml")


class CorrectionKeeper:
    """Keeps the corrections of one run for the next run of the same camera."""

    def __init__(self, store: Path | None, start: Rig, given: Rig | None = None) -> None:
        """Before the first correction.

        Args:
            store: the folder of a `CameraStore`; None: nothing is kept.
            start: the rig at the run's start.
            given: the rig that the start check corrected to this one; the same where it did not.

        Raises:
            StereoSfmError: the rig has no serial number, or its files are damaged.
        """
        self._store = None if store is None else CameraStore(store)
        self._start = start
        self._given = start if given is None else given
        self._original = self._given if self._store is None else self._store.original(self._given)
        self._checked = rig_to_text(_with_right(self._given, start)) != rig_to_text(self._given)  # and corrected

    def keep(self, correction: CalibrationUpdate) -> None:
        """Keep a correction that was applied, in place of the run's earlier one; a warning if that is not possible."""
        if correction.applied:
            self._keep(with_terms(self._start, correction.terms))

    def keep_last(self, corrections: Sequence[CalibrationUpdate]) -> None:
        """At the end of a run: keep the last of its corrections, or that of its start."""
        if corrections:
            self.keep(corrections[-1])
        elif self._checked:
            self._keep(self._start)

    def _keep(self, rig: Rig) -> None:
        if self._store is not None:
            try:
                self._store.keep(self._original, _with_right(self._given, rig))
            except StereoSfmError as error:
                log.warning("%s", error)


def _with_right(rig: Rig, corrected: Rig) -> Rig:
    """The rig with another one's right camera: what is kept."""
    return replace(rig, right=corrected.right, left_T_right=corrected.left_T_right)


def _write(rig: Rig, path: Path) -> None:
    """Whole or not at all."""
    part = path.with_suffix(".part")
    write_native(rig, part)
    os.replace(part, path)
