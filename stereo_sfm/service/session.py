"""One pipeline of the service, from its start to its end; the service starts another one after it."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from stereo_sfm.calib.camera_store import CorrectionKeeper
from stereo_sfm.config import Config
from stereo_sfm.drivers.choice import Opener
from stereo_sfm.drivers.start_checked import corrected_since
from stereo_sfm.maps.folders import MapFolders
from stereo_sfm.messages import Compiling, Localized, LogLine, MapSaved
from stereo_sfm.pipeline.capture import SourceInfo
from stereo_sfm.pipeline.images import SlotImage
from stereo_sfm.pipeline.processes import ProcessRun
from stereo_sfm.pipeline.standby import Standby
from stereo_sfm.service.health import HealthCollector
from stereo_sfm.service.hub import Hub
from stereo_sfm.service.map_cloud import MapCloudBuilder
from stereo_sfm.service.messages import Event, PoseUpdate, PreviewImage, Started
from stereo_sfm.service.poses import HostClock, PoseConverter
from stereo_sfm.service.recorder import Recorder
from stereo_sfm.service.robot_mounting import RobotMounting
from stereo_sfm.service.states import Facts
from stereo_sfm.types import Frame, Keyframe, LiveDepth, MapUpdate, Observations, StartCheck

log = logging.getLogger("stereo_sfm")

COMPILING = "numerical kernels are being compiled, once after an installation"


class Session:
    """Runs a pipeline and publishes its messages. `run` blocks until its end; the rest may be called in any thread."""

    def __init__(
        self,
        number: int,
        opener: Opener,
        config: Config,
        folders: MapFolders,
        hub: Hub,
        facts: Facts,
        health: HealthCollector,
        silent_s: float,
        recorder: Recorder,
        map_saved: Callable[[MapSaved], None],
        mounting: RobotMounting,
        map_folder: Path | None,
        standby: Callable[[], Standby | None] = lambda: None,
    ) -> None:
        self.number, self._opener, self._config, self._folders = number, opener, config, folders
        self._hub, self._facts, self._health, self._map_saved = hub, facts, health, map_saved
        self._recorder, self._mounting, self._map_folder = recorder, mounting, map_folder
        self._clock = HostClock()
        self._observations = Observations.empty()  # of the newest frame
        self._next_preview_s = 0.0
        self.serial = ""  # of the camera
        self.localized = False
        self.start_check: StartCheck | None = None  # what its first images said about the calibration
        self.frames = 0
        self._first_frame_s = float("inf")
        self._handlers: dict[type[Any], Callable[[Any], None]] = {
            Frame: self._frame,
            Keyframe: self._keyframe,
            MapUpdate: self._update,
            LiveDepth: hub.publish,
            Localized: self._localize,
            MapSaved: self._map_saved,
            LogLine: self._line,
            Compiling: self._compiling,
            StartCheck: self._checked,
        }
        self._poses: PoseConverter | None = None
        self._corrections: CorrectionKeeper | None = None
        self._map = MapCloudBuilder(number, hub.publish)
        self._run = ProcessRun(
            opener,
            config,
            [self, health, recorder],
            folders=folders,
            images=self._image,
            silent_s=silent_s,
            pose_first=number > 1,  # a robot may be moving
            standby=standby,
        )

    @property
    def pids(self) -> dict[str, int]:
        """Process ids by stage."""
        return self._run.pids

    @property
    def map_complete(self) -> bool:
        """Whether the mapper came to its end: what it saves then is on disk."""
        return self._run.has_ended("mapper")

    @property
    def tracking_s(self) -> float:
        """Seconds since the first frame, 0 before it."""
        return max(time.monotonic() - self._first_frame_s, 0.0)

    def run(self) -> None:
        """Until the source ends or `stop`.

        Raises:
            StageDied: a process ended by an error, was killed, or does not respond.
            StereoSfmError: the source cannot be opened, or failed.
        """
        try:
            with self._run as run:
                info = run.info
                self.serial, self._clock.live = info.rig.serial, info.live
                rig = self._mounting.begin(info.rig, self._map_folder)
                self._poses = PoseConverter(rig, self.number, self._clock)
                self._corrections = CorrectionKeeper(self._opener.camera_store, info.rig, info.given_rig)
                opening = self._folders.opening(self._opener.opening(info.rig))
                self._recorder.begin(run, self._config, self._opener.spec or info.name, opening)
                self._hub.publish(Started(self.number, info.name, rig, info.live))
                for _ in run:
                    pass
        except KeyboardInterrupt:  # `stop` while the source was being opened
            return
        finally:
            self._recorder.end()
            self._map.close()

    def stop(self) -> None:
        """Finish what is in flight and end."""
        self._run.stop()

    def save_map(self, folder: Path, urgent: bool = False) -> None:
        """Request that the session's part of the map is written; `map_saved` is called when that is done.

        Args: folder, replaced. urgent: the session is about to be stopped.
        """
        self._run.save_map(folder, urgent)

    @property
    def source(self) -> SourceInfo:
        """Its source, once it has frames."""
        return self._run.info

    def relocalize(self) -> None:
        """Search the whole saved map with the next keyframe."""
        self._run.relocalize()

    # -- messages, in the thread of `run` ----------------------------------------------------------------------------

    def put(self, message: object) -> None:
        """A message of the pipeline."""
        handler = self._handlers.get(type(message))
        if handler is not None:
            handler(message)

    def _image(self, message: SlotImage) -> None:
        image = message.image
        self._clock.image(image.frame_id, image.stamp_ns, message.captured_s)
        now = time.monotonic()
        self._facts.image(now)
        if message.logged and now >= self._next_preview_s and (rate := self._hub.preview_hz) > 0:
            self._next_preview_s = max(self._next_preview_s + 1.0 / rate, now - 1.0 / rate)
            self._publish_preview(message)
        if not self._recorder.image(message) and message.logged:
            self._run.release(message)

    def _publish_preview(self, message: SlotImage) -> None:
        image, seen = self._run.pixels(message), self._observations
        self._hub.publish(
            PreviewImage(
                image.frame_id,
                image.stamp_ns,
                image.left,
                image.right,
                seen.uv_left.copy(),
                seen.age.copy(),
                seen.inlier.copy(),
            )
        )

    def _frame(self, frame: Frame) -> None:
        if self._poses is None:
            return
        pose = self._poses.frame(frame)
        self._hub.publish(pose)
        self._update_facts(pose)
        self._observations = frame.observations
        self._first_frame_s = min(self._first_frame_s, time.monotonic())
        self.frames += 1

    def _update_facts(self, pose: PoseUpdate) -> None:
        self._facts.frame(pose.stamp_ns, pose.tracked or pose.state == "INERTIAL", pose.reason)

    def _keyframe(self, keyframe: Keyframe) -> None:
        self._map.put(keyframe)
        rig = self._mounting.keyframe(keyframe)
        if rig is not None and self._poses is not None:
            self._poses.mount(rig)
            self._hub.publish(Started(self.number, self._run.info.name, rig, self._run.info.live))

    def _update(self, update: MapUpdate) -> None:
        assert self._poses is not None
        self._poses.update(update)
        self._map.put(update)
        if update.calibration is not None:
            assert self._corrections is not None
            self._corrections.keep(update.calibration)
            if self._opener.camera_store is not None and self.start_check is not None:
                self.start_check = corrected_since(self.start_check, self._run.info.rig, update.calibration)

    def _localize(self, message: Localized) -> None:
        assert self._poses is not None
        self.localized = True
        self._poses.localized(message)
        self._map.localized(message.version)
        log.info("the saved map was recognised: poses are in its frame")

    def _checked(self, check: StartCheck) -> None:
        self.start_check = check

    def _compiling(self, _: Compiling) -> None:
        """The first start after an installation takes up to minutes: the state says why."""
        if self._facts.starting and self._facts.starting != COMPILING:
            self._facts.starting = COMPILING
            log.info("%s", COMPILING)

    def _line(self, line: LogLine) -> None:
        if line.stage != "main":  # those of this process are published already
            self._hub.publish(Event(time.time_ns(), line.level, line.stage, line.text))
