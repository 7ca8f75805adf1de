"""The choice of a source, its part, rectification and speed, made here and opened in the process that reads it."""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ParamSpec, Protocol

from stereo_sfm.drivers.selection import EVERYTHING, Selection
from stereo_sfm.drivers.source import absolute, is_device, look_up, open_source, path_of
from stereo_sfm.errors import StereoSfmError, one_of

if TYPE_CHECKING:
    from stereo_sfm.calib.rig import Rig
    from stereo_sfm.drivers.rig_option import RigOption
    from stereo_sfm.drivers.source import Source
    from stereo_sfm.log.provenance import Opening
    from stereo_sfm.types import StartCheck

log = logging.getLogger("stereo_sfm")
P = ParamSpec("P")

# user's name -> projection of `stereo_sfm.calib.rectification`
RECTIFY = {"none": "none", "pinhole": "pinhole", "wide": "epipolar"}


class Opener(Protocol):
    """Opens the source of a run in the process that reads it; picklable.

    `SourceChoice` opens a source given by its text, `MadeSource` one created by a program.
    """

    @property
    def spec(self) -> str:
        """The text of the source, "" if it has none."""
        ...

    @property
    def device(self) -> bool:
        """Whether it is a live camera, whose images are lost unless they are logged."""
        ...

    @property
    def camera_store(self) -> Path | None:
        """The folder of calibrations that self-calibration corrected, by camera; None: none is used and none kept."""
        ...

    def opening(self, rig: Rig) -> Opening:
        """What a log records about it besides its name; `rig` is that of the opened source."""
        ...

    def __call__(self) -> Source:
        """The source, not yet entered."""
        ...


@dataclass(frozen=True)
class MadeSource:
    """Opens a source created by a program.

    Attributes:
        make: returns the source; a module-level function or a `functools.partial` of one, so that it can be pickled.
    """

    make: Callable[[], Source]
    spec: str = ""
    device: bool = False
    camera_store: Path | None = None

    @staticmethod
    def of(make: Callable[P, Source], *args: P.args, **options: P.kwargs) -> MadeSource:
        """Opens the source that `make` returns for these arguments."""
        return MadeSource(functools.partial(make, *args, **options))

    def opening(self, rig: Rig) -> Opening:
        from stereo_sfm.log.provenance import Opening

        return Opening()

    def __call__(self) -> Source:
        return self.make()


@dataclass(frozen=True)
class SourceChoice:
    """A source by its text, with its calibration, part, rectification and speed.

    Calling it returns the source, not yet entered. Picklable: it holds no open file and no camera.

    Attributes:
        spec: what `open_source` takes. Paths in it are absolute, since a log records where its images are.
        rig: calibration instead of the source's own.
        options: of the driver, as keyword arguments of `open_source`; those in `spec` come as text.
        selection: the part of the source.
        rectify: a key of RECTIFY: none, pinhole (crops a fisheye), wide (keeps its view).
        speed: playback speed relative to the stamps; None: as fast as they are read.
        repeat: play it again and again.
        camera_store: folder of calibrations that earlier runs corrected, by serial number (`calib.camera_store`).
        start: the first images are not compared with the calibration (unchecked), or they are (checked), and correct it
            where they contradict it (corrected).
        start_check: what an earlier run's first images said, which is not found out again.
        paired: the images are paired as it says already.
    """

    spec: str
    rig: Rig | None = None
    options: Mapping[str, Any] = field(default_factory=dict[str, Any])
    selection: Selection = EVERYTHING
    rectify: str = "none"
    speed: float | None = None
    repeat: bool = False
    camera_store: Path | None = None
    start: str = "unchecked"
    start_check: StartCheck | None = None
    paired: bool = False

    @staticmethod
    def of(
        source: str | Path,
        rig: RigOption = None,
        selection: Selection | None = None,
        rectify: str = "none",
        speed: float | None = None,
        camera_store: str | Path | None = None,
        **options: Any,
    ) -> SourceChoice:
        """From user input: paths may be relative, and the calibration may be a file.

        Raises:
            StereoSfmError: an unknown source or option, a calibration that cannot be read, an unknown way to rectify;
                all of it before anything is opened.
        """
        one_of(rectify, RECTIFY, "rectification")
        if camera_store is not None and rectify != "none":
            raise StereoSfmError(
                "a camera store holds calibrations of images that are not rectified: leave out rectify"
            )
        spec = absolute(str(source), look_up(source, **options).driver)
        store = None if camera_store is None else Path(camera_store).expanduser().resolve()
        return SourceChoice(spec, _loaded(rig), options, selection or EVERYTHING, rectify, speed, camera_store=store)

    @property
    def device(self) -> bool:
        return is_device(self.spec)

    @property
    def numbering(self) -> int:
        """Frames of the source between consecutive frames passed on."""
        return self.selection.frame_skip

    def opening(self, rig: Rig) -> Opening:
        from stereo_sfm.log.provenance import Opening

        return Opening(self.rectify, self.rig if self.camera_store is None else rig, frame_skip=self.numbering)

    def refuse_to_overwrite(self, output: Path | None) -> None:
        """Raises StereoSfmError when the source is the output file, or lies in the output folder."""
        source = path_of(self.spec)
        if output is None or not source.exists() or not output.exists():
            return
        if output.resolve() in (source.resolve(), *source.resolve().parents):
            raise StereoSfmError(f"{output} is the source, or contains it: choose another -o")

    def __call__(self) -> Source:
        from stereo_sfm.calib.lens_doubts import scale_doubts
        from stereo_sfm.drivers.ascending import AscendingSource
        from stereo_sfm.drivers.corrected import CorrectedSource
        from stereo_sfm.drivers.paced import PacedSource
        from stereo_sfm.drivers.rectified import rectified
        from stereo_sfm.drivers.repeated import RepeatedSource
        from stereo_sfm.drivers.select import SelectedFrames
        from stereo_sfm.drivers.start_checked import StartCheckedSource

        source: Source = AscendingSource(open_source(self.spec, self.rig, **self.options))
        source = source if self.camera_store is None else CorrectedSource(source, self.camera_store)
        if self.selection != EVERYTHING:
            source = SelectedFrames(source, **vars(self.selection))
        if self.rectify == "none":
            for doubt in scale_doubts(source.rig) if not source.live else ():  # a live camera's is known once entered
                log.warning("%s: %s", source.name, doubt)
        source = rectified(source, RECTIFY[self.rectify])
        if self.start != "unchecked" or self.start_check is not None:
            source = StartCheckedSource(source, self.start == "corrected", self.start_check, self.paired)
        source = RepeatedSource(source) if self.repeat else source
        return source if self.speed is None else PacedSource(source, self.speed)


def with_start_check(opener: Opener, correct: bool) -> Opener:
    """The opener of a run's source: its first images are compared with the calibration, and may correct it.

    A replay has what its run found; a program's own source is taken as it is.
    """
    if not isinstance(opener, SourceChoice) or isinstance(opener, ReplayChoice):
        return opener
    return replace(opener, start="corrected" if correct else "checked")


def with_known_start(opener: Opener, check: StartCheck | None) -> Opener:
    """The opener of a source whose first images were looked at before. Args: check, what they said; None: they fit."""
    if not isinstance(opener, SourceChoice) or isinstance(opener, ReplayChoice):
        return opener
    return replace(opener, start="unchecked", start_check=check)


def _loaded(rig: RigOption) -> Rig | None:
    """A calibration, or the one of a file of any format."""
    if not isinstance(rig, str | Path):
        return rig
    from stereo_sfm.calib import load_rig

    return load_rig(rig)


@dataclass(frozen=True)
class ReplayChoice(SourceChoice):
    """The frames that an earlier run tracked.

    Attributes:
        frame_ids: of those frames.
        recorded_skip: of the run: frames of its source from one to the next.
    """

    frame_ids: tuple[int, ...] = ()
    recorded_skip: int = 1

    @property
    def numbering(self) -> int:
        return self.recorded_skip

    def __call__(self) -> Source:
        from stereo_sfm.drivers.replayed import ReplayedSource

        return ReplayedSource(super().__call__(), self.frame_ids)
