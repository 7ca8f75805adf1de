"""One run as the command line makes it: the output folder, the wiring, the log and the viewer around the stages."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from stereo_sfm.config import Config
from stereo_sfm.drivers.choice import Opener, with_known_start, with_start_check
from stereo_sfm.drivers.start_checked import RigChanged, StartCheckedSource
from stereo_sfm.errors import StereoSfmError, require
from stereo_sfm.export.run_folder import KEPT_MAP, default_folder, discard_files, prepare_folder, refuse_taken
from stereo_sfm.folder_lock import FolderLock
from stereo_sfm.maps.folders import MapFolders
from stereo_sfm.messages import Compiling, LogEnded, LogLine, Sink
from stereo_sfm.pipeline.capture import SourceInfo
from stereo_sfm.pipeline.inline import run_inline
from stereo_sfm.pipeline.logger import LogOptions
from stereo_sfm.pipeline.processes import ProcessRun
from stereo_sfm.pipeline.schedule import Recorded
from stereo_sfm.pipeline.text import Listener
from stereo_sfm.pipeline.threads import limited_threads
from stereo_sfm.pipeline.viewer import ViewerOptions
from stereo_sfm.types import Dropped, Frame, StartCheck
from stereo_sfm.viz.server import LOOPBACK

if TYPE_CHECKING:
    from stereo_sfm.kernel_cache import Compilation
    from stereo_sfm.log.recorded import RecordedRun

log = logging.getLogger("stereo_sfm")
LOG = "run.mcap"  # in the run's folder


@dataclass(frozen=True)
class Wiring:
    """How the stages run, and what is logged and shown."""

    inline: bool = False
    mode: str | None = None  # lockstep | realtime; None: by the source
    log: str | None = None  # full | lean | none; None: full for devices, lean for recordings
    image_format: str | None = None  # of a full log; None: raw for devices, else png
    viz: str = "none"  # none | spawn | serve | save
    viz_address: str = LOOPBACK  # that "serve" listens on


class Session:
    """Enter it and iterate over the frames; `info` describes the source and `folder` is the output folder.

    The folder stays locked after the last frame, while the results are written; `close` unlocks it.
    """

    def __init__(
        self,
        opener: Opener,
        config: Config,
        sinks: Sequence[Sink],
        wiring: Wiring,
        folders: MapFolders,
        folder: Path | None = None,
        overwrite: bool = False,
        replayed: RecordedRun | None = None,
    ) -> None:
        if wiring.inline and wiring.mode == "realtime":
            raise StereoSfmError("--mode realtime needs processes: omit --inline")
        if wiring.viz != "none":
            require(("rerun",), "viewer", "the viewer")
        self._opener = with_start_check(opener, config.self_calibration.mode == "auto")
        self._config, self._sinks, self._wiring = config, list(sinks), wiring
        self._folders, self._overwrite, self._replayed = folders, overwrite, replayed
        self._stack = ExitStack()
        self._stopped = False
        self._frames: Iterator[Frame]
        self._run: ProcessRun | None = None
        self._folder = folder
        self._made: list[Path] = []  # folders, from the inside out
        self._lock: FolderLock | None = None  # on the folder, until its last file is written
        self._began = False  # a frame has come
        self._compilation: Compilation | None = None  # in this process
        self._compiled_s = 0.0  # of it while the source was opened
        self.info: SourceInfo

    @property
    def folder(self) -> Path:
        """Where the files go; known once entered."""
        assert self._folder is not None
        return self._folder

    def __enter__(self) -> Self:
        if self._folder is not None:
            refuse_taken(self._folder, self._overwrite)  # before the source tells of its images
        try:
            with ExitStack() as stack:
                self._frames = self._enter_inline(stack) if self._wiring.inline else self._enter_processes(stack)
                self._stack = stack.pop_all()
            self._compiled_s = 0.0 if self._compilation is None else self._compilation.seconds
        except StereoSfmError as error:
            self._clean_up(error)
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.__exit__(kind, error, trace)
        self._clean_up(error)

    def close(self) -> None:
        """Unlock the folder for another run, after its last file was written."""
        if self._lock is not None:
            self._lock.release()

    def _clean_up(self, error: BaseException | None) -> None:
        """Remove the new folder if an error ended the run before its first frame."""
        if self._folder is None or self._lock is None or error is None:
            return
        if not self._began and isinstance(error, StereoSfmError) and error.exit_code == StereoSfmError.exit_code:
            discard_files(self._folder)
            with suppress(OSError):  # it is not empty
                for folder in self._made:
                    folder.rmdir()
        self.close()

    def __iter__(self) -> Iterator[Frame]:
        try:
            for frame in self._frames:
                self._began = True
                yield frame
                if self._stopped and self._run is None:
                    return
        except RigChanged as found:
            if not self._stopped:
                self._open_again(found.check)
                yield from self

    def _open_again(self, check: StartCheck) -> None:
        """Start the processes anew, with the calibration that a live camera's first images fit."""
        self._opener = with_known_start(self._opener, check)
        self._stack.close()
        (self.folder / LOG).unlink(missing_ok=True)  # it holds no image
        with ExitStack() as stack:
            self._frames = self._enter_processes(stack)
            self._stack = stack.pop_all()

    def stop(self) -> None:
        """Finish what is in flight and end."""
        self._stopped = True
        if self._run is not None:
            self._run.stop()

    def _compiling(self, kernel: str) -> None:
        for sink in self._sinks:
            sink.put(Compiling("run", kernel))

    def waited_s(self, begin_s: float) -> float:
        """Seconds after `begin_s` (performance counter) in which stages loaded or compiled their code."""
        if self._run is None:
            return 0.0 if self._compilation is None else self._compilation.seconds - self._compiled_s
        return max((self._run.began_s or begin_s) - begin_s, 0.0)

    def _name_folder(self, otherwise: str) -> Path:
        """A folder named after the source, else after the given name."""
        if self._folder is None:
            name = self._opener.spec.rstrip("/").split("/")[-1] or otherwise
            self._folder = default_folder(name, datetime.now())
        self._folders = replace(self._folders, kept=self._folder / KEPT_MAP)
        return self._folder

    def _prepare(self) -> None:
        """Make the folder once the source is open, so that errors of the source come first and leave no folder."""
        self._made = [place for place in (self.folder, *self.folder.parents) if not place.exists()]
        self._lock = prepare_folder(self.folder, self._overwrite)

    def _log_options(self, live: bool, folder: Path) -> LogOptions | None:
        kind = self._wiring.log or ("full" if live else "lean")
        if kind != "full" and self._wiring.image_format is not None:
            log.warning("--image-format has no effect: only --log full keeps images, this run has --log %s", kind)
        if kind == "none":
            return None
        pixels = self._wiring.image_format or ("raw" if live else "png")
        return LogOptions(folder / LOG, pixels if kind == "full" else "none")

    def _ring_drops(self) -> list[Dropped]:
        """Images that the run to be repeated dropped because it was too slow, and those lost before them."""
        drops = [] if self._replayed is None else self._replayed.dropped
        ids = {drop.frame_id for drop in drops if drop.where == "ring"}
        return [d for d in drops if d.where == "ring" or (d.where == "sensor" and d.frame_id + d.count in ids)]

    @property
    def _depth_frames(self) -> frozenset[int] | None:
        """The images of the run to be repeated that have a live depth."""
        return None if self._replayed is None else self._replayed.depth_frames

    # -- wirings -----------------------------------------------------------------------------------------------------

    def _enter_inline(self, stack: ExitStack) -> Iterator[Frame]:
        from stereo_sfm.kernel_cache import listening
        from stereo_sfm.log.run_log import RunLog
        from stereo_sfm.log.writer import LogWriter
        from stereo_sfm.pipeline.logger import LogSink

        self._compilation = stack.enter_context(listening(self._compiling))
        lines: list[LogLine] = []
        # The start check gives the bits of the processes' one.
        with limited_threads(self._config.pipeline.threads), Listener("main", lines.append):
            source = stack.enter_context(self._opener())
            if isinstance(source, StartCheckedSource):
                source.look()  # a camera's images as well: nothing in this process makes them wait
        self.info = SourceInfo.of(source)
        folder = self._name_folder(source.name)
        self._prepare()
        options = self._log_options(self._opener.device, folder)
        sinks: list[Any] = list(self._sinks)
        jpeg = options is not None and options.image_format == "jpeg"
        if options is not None:
            run_log = RunLog(
                LogWriter(options.path, compress=options.image_format != "raw"), source.rig, self._config,
                source=self._opener.spec or source.name, mode="inline",
                image_format=options.image_format, ground_truth=source.ground_truth,
                opening=self._folders.opening(self._opener.opening(source.rig)),
            )  # fmt: skip
            sink = LogSink(run_log, lambda ended: self._log_ended(ended, sinks))
            stack.callback(sink.close)
            sinks.append(sink)
        if self._wiring.viz != "none":
            from stereo_sfm.viz.sink import RerunSink

            viewer = RerunSink(
                source.rig, source.name, self._wiring.viz, folder / "run.rrd", source.ground_truth,
                self._wiring.viz_address,
            )  # fmt: skip
            stack.callback(viewer.close)
            sinks.append(viewer)
        schedule = None if self._replayed is None else Recorded(self._replayed.applied)
        for line in lines:  # they belong to no time of the log
            for sink in self._sinks:
                sink.put(line)
        for drop in self._ring_drops():
            for sink in sinks:
                sink.put(drop)
        frames = run_inline(source, self._config, sinks, schedule, self._folders, jpeg, self._depth_frames)
        stack.callback(frames.close)
        return frames

    @staticmethod
    def _log_ended(ended: LogEnded, sinks: Sequence[Sink]) -> None:
        log.warning("%s; the run continues without it", ended.why)
        for sink in sinks:
            sink.put(ended)

    def _enter_processes(self, stack: ExitStack) -> Iterator[Frame]:
        self._name_folder("run")
        viewer = None
        if self._wiring.viz != "none":
            viewer = ViewerOptions(self._wiring.viz, self.folder / "run.rrd", self._wiring.viz_address)
        self._run = ProcessRun(
            self._opener,
            self._config,
            self._sinks,
            realtime=None if self._wiring.mode is None else self._wiring.mode == "realtime",
            applied=None if self._replayed is None else self._replayed.applied,
            depth_frames=self._depth_frames,
            log=self._log_options(self._opener.device, self.folder),
            folders=self._folders,
            viewer=viewer,
            opened=self._prepare if self._lock is None else None,
        )
        stack.enter_context(self._run)
        self.info = self._run.info
        for drop in self._ring_drops():
            self._run.publish(drop)
        return iter(self._run)
