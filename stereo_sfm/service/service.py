"""`Service`: tracks a source without end, keeps its map, and publishes its pose; from Python and for `serve`."""

from __future__ import annotations

import logging
import threading
import time
import traceback
from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Self, TypeVar

from stereo_sfm.drivers.choice import Opener
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.messages import LogLine
from stereo_sfm.pipeline.allocator import Release, return_large_blocks, share_one_heap
from stereo_sfm.pipeline.child import raise_priority
from stereo_sfm.pipeline.text import LOGGER, Listener
from stereo_sfm.service.camera import patient
from stereo_sfm.service.commands import Commands
from stereo_sfm.service.config import RobotConfig, load
from stereo_sfm.service.health import HealthCollector
from stereo_sfm.service.hub import Hub
from stereo_sfm.service.link import OutputProcess, make_publisher
from stereo_sfm.service.map_keeper import MapKeeper
from stereo_sfm.service.messages import Event, ServiceMessage
from stereo_sfm.service.notify import SystemdNotifier
from stereo_sfm.service.outputs import OUTPUTS
from stereo_sfm.service.pipelines import Pipelines
from stereo_sfm.service.recorder import Recorder
from stereo_sfm.service.states import Facts
from stereo_sfm.service.status_reporter import StatusReporter

M = TypeVar("M", bound=ServiceMessage)

log = logging.getLogger(LOGGER)

CHECK_S = 0.1  # between two checks of state, map and recorder
RELEASE_CHECKS = 3000  # checks after which memory that lies free is returned
END_S = 4.5  # for everything to be written after a stop
OTHERS_S = 2.0  # after a stop: recorder and outputs end from then on, while the map still takes on a busy computer


class InternalError(StereoSfmError):
    """An error that is not the user's."""

    exit_code = 1


class Service(Commands):
    """Use it in a `with` statement: entering starts it, leaving stops it with everything written.

    Its commands are the methods of `Commands`.
    """

    def __init__(
        self,
        config: RobotConfig | str | Path,
        opener: Opener | None = None,
        outputs: Mapping[str, str] | None = None,
        notifier: SystemdNotifier | None = None,
    ) -> None:
        """Args:
        config: or its file.
        opener: of the source, instead of the configuration's.
        outputs: those that may be on, as `outputs.OUTPUTS`.
        notifier: to systemd.

        Raises:
            StereoSfmError: an invalid configuration, no source, or an output whose libraries are not installed.
        """
        config = config if isinstance(config, RobotConfig) else load(config)
        pipeline = config.pipeline()
        opener = patient(config.opener()) if opener is None else opener
        table = OUTPUTS if outputs is None else outputs
        enabled = [name for name in table if config.section(name).enabled]
        for name in enabled:
            make_publisher(table[name], config)  # what is missing or wrong is said before anything starts
        self._hub = Hub(OutputProcess(name, config, self.call, table[name]) for name in enabled)
        notifier = notifier or SystemdNotifier()
        facts, health = Facts(), HealthCollector()
        maps, recorder = MapKeeper(config.map, pipeline), Recorder(config.recording)
        pipelines = Pipelines(opener, pipeline, config.watchdog.silent_s, maps, recorder, self._hub, facts, health)
        reporter = StatusReporter(
            config.recording, facts, health, maps, recorder, pipelines, self._hub, notifier, lambda: self.pids
        )
        super().__init__(config, pipelines, maps, recorder, reporter, notifier)
        self._listener = Listener("service", self._publish_line)
        self._over = threading.Event()  # no more poses come
        self._recorded = threading.Event()  # the recording is closed
        self._saved = threading.Event()  # the map is written
        self._ended = threading.Event()  # everything is written
        self.error: StereoSfmError | None = None  # why it ended by itself
        self._failure = ""  # of the last check that failed
        self._threads = [
            threading.Thread(target=self._run_pipelines, name="pipelines", daemon=True),
            threading.Thread(target=self._close_recorder, name="end of the recorder", daemon=True),
            threading.Thread(target=self._keep_checking, name="state", daemon=True),
        ]

    def __enter__(self) -> Self:
        return_large_blocks()
        share_one_heap()
        self._listener.__enter__()
        self._recorder.start()
        for output in self._hub.outputs:
            output.start()
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop("the service is being stopped")
        for thread in self._threads:
            thread.join()
        self._listener.__exit__(None, None, None)

    def stop(self, why: str = "asked to stop") -> None:
        """Begin to end, with everything written; `wait` until that is done. May be called in any thread."""
        self._pipelines.stop(why)

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait for the end; False when the time is over before."""
        return self._ended.wait(timeout_s)

    def on(self, kind: type[M], callback: Callable[[M], object]) -> Callable[[], None]:
        """Call back with every message of a kind, in a thread of its own; returns what ends that."""
        return self._hub.on(kind, callback)

    @property
    def open_outputs(self) -> frozenset[str]:
        """Names of the outputs that clients can reach."""
        return frozenset(output.name for output in self._hub.outputs if output.wants)

    @property
    def pids(self) -> dict[str, int]:
        """Process ids of stages and outputs by name."""
        session = self._pipelines.session
        stages = {} if session is None else session.pids
        others = {"map saver": self._maps.pid, "recorder": self._recorder.pid}
        others |= {output.name: output.pid for output in self._hub.outputs}
        return {**stages, **{name: pid for name, pid in others.items() if pid is not None}}

    def _run_pipelines(self) -> None:
        raise_priority()  # the recorder and the outputs, which clients keep busy, were started before
        try:
            self._pipelines.run()
        except StereoSfmError as error:
            self.error = error
            self.stop(str(error))
        except Exception:
            self.error = InternalError(f"the service failed:\n{traceback.format_exc()}")
            self.stop("an error of the service")
        finally:
            self._over.set()
            self._maps.finish(self._pipelines.stopped_s + END_S, self._pipelines.map_complete)
            self._saved.set()
            self._recorded.wait()
            self._ended.set()

    def _close_recorder(self) -> None:
        self._pipelines.stopping.wait()
        self._over.wait(OTHERS_S)
        try:
            self._recorder.close()
        finally:
            self._recorded.set()

    def _keep_checking(self) -> None:
        tidy = Release(RELEASE_CHECKS)
        while not self._saved.wait(CHECK_S) and self._pipelines.stopping_s < OTHERS_S:
            self._check()
            tidy.step()
        self._check()  # once more: the outputs get the final state
        self._hub.close()

    def _check(self) -> None:
        """Each on its own: the state and the saved map depend on the thread that does this."""
        for check in (self._check_maps, self._pipelines.check, self._reporter.report):
            try:
                check()
            except Exception:
                failure = traceback.format_exc()
                if failure != self._failure:
                    log.error("a check of the service failed; it is repeated:\n%s", failure)
                self._failure = failure

    def _check_maps(self) -> None:
        self._maps.check(self._pipelines.tracking_session)

    def _publish_line(self, line: LogLine) -> None:
        self._hub.publish(Event(time.time_ns(), line.level, line.stage, line.text))
