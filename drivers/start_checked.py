"""A source whose first images are compared with its calibration before anything else sees them."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Self

from stereo_sfm.calib.formats.native import rig_from_text, rig_to_text
from stereo_sfm.calib.rig import Rig
from stereo_sfm.drivers.source import Source, Stamps, chosen_frames
from stereo_sfm.drivers.wrapped import WrappedSource
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.types import CalibrationUpdate, StartCheck, StereoImage

if TYPE_CHECKING:
    from stereo_sfm.calib.start import StartFinding

log = logging.getLogger("stereo_sfm")


class RigChanged(StereoSfmError):
    """The first images fit another calibration than the one that was handed out: open the source again with `check`."""

    def __init__(self, check: StartCheck) -> None:
        super().__init__(check.line)
        self.check = check


class StartCheckedSource(WrappedSource):
    """Wraps a source and is entered with it: its images, and the calibration that the first of them fit.

    The images that were looked at are passed on with the others. A live camera's do not wait for a run to be ready:
    they are looked at when the run wants them, and if they contradict the calibration, the source must be opened again
    (`RigChanged`).
    """

    def __init__(self, source: Source, correct: bool, known: StartCheck | None = None, paired: bool = False) -> None:
        """Args:
        source: the source.
        correct: use a corrected calibration; else it is only reported.
        known: what an earlier run of the same images found: nothing is looked at again.
        paired: the images are paired as it says already, as those of its log are.
        """
        super().__init__(source)
        self._paired = paired
        self._correct, self._check = correct, known
        self._looked_at = known is not None
        self.contradicted = False  # the calibration, by the first images; not by what sticks to them alone
        self._images: Iterator[StereoImage] | None = None  # a begun iteration, from the first image on
        self._original: Rig | None = None
        self._rig: Rig | None = None

    @property
    def start_check(self) -> StartCheck | None:
        return self._check

    @property
    def given_rig(self) -> Rig:
        """The calibration before the check."""
        return self.source.rig

    @property
    def rig(self) -> Rig:
        given = self.source.rig  # a camera's is known once it is open
        if self._check is None or not self._check.rig:
            return given
        if self._rig is None or given is not self._original:
            pair = rig_from_text(self._check.rig, "the start check")
            self._original = given
            self._rig = replace(
                given, left=pair.left, right=pair.right, left_T_right=pair.left_T_right, left_mask=pair.left_mask,
                right_mask=pair.right_mask,
            )  # fmt: skip
        return self._rig

    def __enter__(self) -> Self:
        super().__enter__()
        if not self.source.live:
            self.look()
        return self

    def look(self) -> None:
        """Look at the first images now. An error of the source is raised when they are passed on, in its place."""
        if self._looked_at:
            return
        from stereo_sfm.calib.start import check_start

        self._looked_at = True
        first = _FirstImages(iter(self.source))
        finding = check_start(self.source.rig, first.looked_at(), self.source.other_reading)
        self.contradicted = bool(finding.text)
        finding = self._with_sticking(finding)
        if finding.text and first.seen:
            self._check = self._report(finding, first.seen[0])
        self._images = first.passed_on()

    def _with_sticking(self, finding: StartFinding) -> StartFinding:
        """What sticks to the images is found in recordings alone: a camera that starts has not moved yet."""
        if self.source.live:
            return finding
        from stereo_sfm.calib.sticking import positions, with_sticking

        with suppress(StereoSfmError):  # of the source: raised when its images are passed on
            return with_sticking(finding, self.source.rig, self.source.at(positions(self.source.frame_count)))
        return finding

    def _report(self, finding: StartFinding, first: StereoImage) -> StartCheck:
        better, remedy, rig, shift = finding.rig, "", "", 0
        if better is not None and self._correct:
            remedy, rig, shift = f"corrected for this run; {finding.advice}", _as_text(better), finding.shift
        elif better is not None:
            remedy = f"not corrected, as self-calibration does not correct here; {finding.advice}"
        elif finding.masked is not None:
            remedy, rig = f"masked for this run; {finding.advice}", _as_text(finding.masked)  # which corrects nothing
        check = StartCheck(first.frame_id, first.stamp_ns, finding.text, remedy, finding.shown, rig, shift)
        if check.shown:
            log.warning("%s", check.line)
        return check

    def stamps(self) -> Stamps | None:
        return self.source.stamps()

    def at(self, positions: Sequence[int]) -> Iterator[StereoImage]:
        return chosen_frames(iter(self), positions) if self._shift else self.source.at(positions)

    @property
    def _shift(self) -> int:
        return 0 if self._check is None or self._paired else self._check.right_shift

    def __iter__(self) -> Iterator[StereoImage]:
        handed_out = self.rig
        self.look()
        if self._check is not None and self.rig is not handed_out:
            raise RigChanged(self._check)
        images, self._images = self._images, None
        return _paired(iter(self.source) if images is None else images, self._shift)


class _FirstImages:
    """The beginning of an iteration: what was looked at is passed on before the rest."""

    def __init__(self, images: Iterator[StereoImage]) -> None:
        self._images = images
        self._failure: Exception | None = None
        self.seen: list[StereoImage] = []

    def looked_at(self) -> Iterator[StereoImage]:
        """The images; they end where the source fails."""
        try:
            for image in self._images:
                self.seen.append(image)
                yield image
        except Exception as error:
            self._failure = error

    def passed_on(self) -> Iterator[StereoImage]:
        """All images."""
        while self.seen:
            yield self.seen.pop(0)
        if self._failure is not None:
            raise self._failure
        yield from self._images


def corrected_since(check: StartCheck, start: Rig, correction: CalibrationUpdate) -> StartCheck:
    """What the start of the next run of the same images is known to need, where the run's correction is kept.

    Args:
        check: of the run's first images. start: the rig that it began with. correction: of that rig.
    """
    from stereo_sfm.calib.choice import with_terms

    if not (check.rig and correction.applied):
        return check
    return replace(check, rig=_as_text(with_terms(start, correction.terms)))


def _as_text(rig: Rig) -> str:
    """The cameras alone, with their masks."""
    left_mask, right_mask = rig.left_mask, rig.right_mask
    return rig_to_text(Rig(rig.left, rig.right, rig.left_T_right, left_mask=left_mask, right_mask=right_mask))


def _paired(images: Iterator[StereoImage], shift: int) -> Iterator[StereoImage]:
    """Left image k with right image k + shift; those without the other one are left out."""
    if shift == 0:
        return images
    return _later_right(images, shift) if shift > 0 else _earlier_right(images, -shift)


def _later_right(images: Iterator[StereoImage], frames: int) -> Iterator[StereoImage]:
    waiting: deque[StereoImage] = deque()
    for image in images:
        waiting.append(image)
        if len(waiting) > frames:
            yield replace(waiting.popleft(), right=image.right, right_stamp_ns=0)


def _earlier_right(images: Iterator[StereoImage], frames: int) -> Iterator[StereoImage]:
    waiting: deque[StereoImage] = deque()
    for image in images:
        waiting.append(image)
        if len(waiting) > frames:
            yield replace(image, right=waiting.popleft().right, right_stamp_ns=0)
