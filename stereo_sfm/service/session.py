"""One pipeline of the service, from its start to its end; the service starts another one after it."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from stereo_sfm.config import Config
from stereo_sfm.drivers.choice import Opener
from stereo_sfm.maps.folders import MapFolders
from stereo_sfm.messages import Localized, LogLine, MapSaved
from stereo_sfm.pipeline.images import SlotImage
from stereo_sfm.pipeline.processes import ProcessRun
from stereo_sfm.service.health import HealthBook
from stereo_sfm.service.hub import Hub
from stereo_sfm.service.map_follower import MapFollower
from stereo_sfm.service.messages import Event, Picture, PoseUpdate, Started
from stereo_sfm.service.poses import HostClock, PoseMaker
from stereo_sfm.service.recorder import Recorder
from stereo_sfm.service.states import Facts
from stereo_sfm.types import Frame, Keyframe, MapUpdate, Observations

log = logging.getLogger("stereo_sfm")


class Session:
    """Runs a pipeline and passes on what it says. `run` blocks until its end; the rest may be called in any thread."""

    def __init__(
        self,
        number: int,
        opener: Opener,
        config: Config,
        folders: MapFolders,
        hub: Hub,
        facts: Facts,
        health: HealthBook,
        silent_s: float,
        recorder: Recorder,
        map_saved: Callable[[MapSaved], None],
    ) -> None:
        self.number, self._opener, self._config, self._folders = number, opener, config, folders
        self._hub, self._facts, self._health, self._map_saved = hub, facts, health, map_saved
        self._recorder = recorder
        self._clock = HostClock()
        self._observations = Observations.empty()  # of the newest frame
        self._next_picture_s = 0.0
        self.serial = ""  # of the camera
        self.localized = False
        self.frames = 0
        self._sinks: dict[type[Any], Callable[[Any], None]] = {
            Frame: self._frame,
            Keyframe: self._keyframe,
            MapUpdate: self._update,
            Localized: self._localize,
            MapSaved: self._map_saved,
            LogLine: self._line,
        }
        self._poses: PoseMaker | None = None
        self._map = MapFollower(number, hub.publish)
        self._run = ProcessRun(
            opener,
            config,
            [self, health, recorder],
            folders=folders,
            images=self._image,
            silent_s=silent_s,
        )

    @property
    def pids(self) -> dict[str, int]:
        """Process ids by stage."""
        return self._run.pids

    def run(self) -> None:
        """Until the source ends or `stop`.

        Raises:
            StageDied: a process ended by an error, was killed, or does not respond.
            StereoSfmError: the source cannot be opened, or failed.
        """
        try:
            with self._run as run:
                info = run.info
                self.serial = info.rig.serial
                self._poses = PoseMaker(info.rig, self.number, self._clock)
                opening = self._folders.opening(self._opener.opening)
                self._recorder.begin(run, self._config, self._opener.spec or info.name, opening)
                self._hub.publish(Started(self.number, info.name, info.rig, info.live))
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

    def save_map(self, folder: Path) -> None:
        """Request that the session's part of the map is written; the service is told when that is done."""
        self._run.save_map(folder)

    def relocalize(self) -> None:
        """Search the whole saved map with the next keyframe."""
        self._run.relocalize()

    # -- messages, in the thread of `run` ----------------------------------------------------------------------------

    def put(self, message: object) -> None:
        """A message of the pipeline."""
        take = self._sinks.get(type(message))
        if take is not None:
            take(message)

    def _image(self, message: SlotImage) -> None:
        image = message.image
        self._clock.image(image.frame_id, image.stamp_ns, message.captured_s)
        facts, now = self._facts, time.monotonic()
        facts.image_s, facts.source_error = now, ""
        if facts.starting:
            facts.starting, facts.pose_s = "", now
        if now >= self._next_picture_s and (rate := self._hub.picture_hz) > 0:
            self._next_picture_s = max(self._next_picture_s + 1.0 / rate, now - 1.0 / rate)
            self._publish_picture(message)
        if not self._recorder.image(message):
            self._run.release(message)

    def _publish_picture(self, message: SlotImage) -> None:
        image, seen = self._run.pixels(message), self._observations
        self._hub.publish(
            Picture(
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
        self._judge(pose)
        self._observations = frame.observations
        self.frames += 1

    def _judge(self, pose: PoseUpdate) -> None:
        if pose.tracked or pose.state == "INERTIAL":
            self._facts.pose_s, self._facts.lost_reason = time.monotonic(), ""
        else:
            self._facts.lost_reason = pose.reason

    def _keyframe(self, keyframe: Keyframe) -> None:
        self._map.put(keyframe)

    def _update(self, update: MapUpdate) -> None:
        assert self._poses is not None
        self._poses.update(update)
        self._map.put(update)

    def _localize(self, message: Localized) -> None:
        assert self._poses is not None
        self.localized = True
        self._poses.localized(message)
        self._map.localized(message.version)
        log.info("the saved map was recognised: poses are in its frame")

    def _line(self, line: LogLine) -> None:
        if line.stage != "main":  # those of this process are told already
            self._hub.publish(Event(time.time_ns(), line.level, line.stage, line.text))
