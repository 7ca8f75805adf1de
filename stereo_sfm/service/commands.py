"""The commands of a running service, for its outputs and from Python."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Mapping
from datetime import datetime
from operator import attrgetter
from pathlib import Path
from typing import Any

from stereo_sfm.config import parse_override
from stereo_sfm.errors import StereoSfmError, one_of
from stereo_sfm.maps.header import read_header
from stereo_sfm.recording.segments import delete_recording, find_recording, listed, recordings
from stereo_sfm.service.config import RECORDING_MODES, SEE, RobotConfig
from stereo_sfm.service.map_keeper import MapKeeper
from stereo_sfm.service.notify import SystemdNotifier
from stereo_sfm.service.pipelines import Pipelines
from stereo_sfm.service.publisher import Reply, checked
from stereo_sfm.service.recorder import Recorder
from stereo_sfm.service.status_reporter import StatusReporter
from stereo_sfm.settings import read

log = logging.getLogger("stereo_sfm")

CHANGEABLE = (  # while running
    "map.save_every_min",
    "recording.quota_gb",
    "recording.quota_percent",
    "recording.min_free_gb",
    "recording.segment_min",
    "recording.black_box_min",
    "recording.mark_before_s",
    "recording.mark_after_s",
    "recording.mark_losses",
)


class Commands:
    """Every command of `publisher.COMMANDS` is a method that returns a `Reply`. Thread-safe."""

    def __init__(
        self,
        config: RobotConfig,
        pipelines: Pipelines,
        maps: MapKeeper,
        recorder: Recorder,
        reporter: StatusReporter,
        notifier: SystemdNotifier,
    ) -> None:
        """Args: config, changed by `set_setting`; the rest: what the commands act on."""
        self.config = config
        self._pipelines, self._maps, self._recorder = pipelines, maps, recorder
        self._reporter, self._notifier = reporter, notifier

    def call(self, name: str, arguments: Mapping[str, Any] | None = None) -> Reply:
        """A command by its name; a refused command is a reply that is not ok."""
        try:
            given = checked(name, dict(arguments or {}))
            return getattr(self, name)(**given)
        except (StereoSfmError, OSError) as error:
            return Reply(False, str(error))
        except Exception:  # who asked is answered, and the service goes on
            log.exception("the command %s failed", name)
            return Reply(False, f"{name} failed: the service's log says why")

    def status(self) -> Reply:
        """State, health and settings that may change."""
        status = self._reporter.status
        settings = {name: attrgetter(name)(self.config) for name in CHANGEABLE}
        health = dataclasses.asdict(self._reporter.health())
        data = {"status": dataclasses.asdict(status), "health": health, "settings": settings}
        return Reply(True, str(status.state), data)

    # -- map and tracking --------------------------------------------------------------------------------------------

    def save_map(self, name: str = "") -> Reply:
        """Write the map now; with a name also a copy beside the configured folder."""
        if name and self._maps.beside(name).resolve() == self._recordings_folder.resolve():
            return Reply(False, f"{name} is the folder of the recordings: choose another name")
        return self._maps.save_now(self._pipelines.session, name)

    def load_map(self, name: str) -> Reply:
        """Continue with another saved map beside the configured folder.

        Raises:
            StereoSfmError: it is damaged, or of another version.
        """
        if self._maps.mode == "none":
            return Reply(False, "no map is loaded: map.mode is none")
        folder = self._maps.beside(name)
        if not (folder / "map.json").exists():
            return Reply(False, f"there is no map {name}")
        read_header(folder, ())
        self._maps.switch(folder)
        self._restart(f"map {name}")
        return Reply(True, f"starting with {folder}")

    def reset(self) -> Reply:
        """Start tracking and mapping again with the newest saved map."""
        self._restart("reset")
        return Reply(True, "the pipeline is started again")

    def relocalize(self) -> Reply:
        """Search the whole saved map for the camera's pose."""
        session = self._pipelines.session
        if session is None or not self._maps.exists:
            return Reply(False, "there is no saved map, or no pipeline runs")
        if self._maps.mode == "localize":
            session.relocalize()
            return Reply(True, "the whole map is searched with the next keyframe")
        self._restart("relocalize")
        return Reply(True, "the pipeline is started again and searches the saved map")

    def _restart(self, why: str) -> None:
        self._notifier.reloading()
        self._pipelines.restart(why)

    # -- recordings --------------------------------------------------------------------------------------------------

    def start_recording(self, mode: str = "full") -> Reply:
        """Record: full, lean or black_box."""
        self._recorder.set_mode(one_of(mode, RECORDING_MODES[1:], "kind of recording"))
        return Reply(True, f"recording {mode}")

    def stop_recording(self) -> Reply:
        """Stop recording."""
        self._recorder.set_mode("off")
        return Reply(True, "recording stopped")

    def mark(self, text: str = "") -> Reply:
        """Keep the recording around this moment."""
        if self._recorder.mode == "off":
            return Reply(False, "nothing is being recorded")
        self._recorder.mark(f"{datetime.now().isoformat(timespec='seconds')} {text}".strip())
        log.info("marked: %s", text or "(no text)")
        return Reply(True, "marked")

    def recordings(self) -> Reply:
        """List the recordings."""
        rows = [listed(folder) for folder in recordings(self._recordings_folder)]
        state = self._recorder.state
        for row in rows:
            row["recording"] = self._recorder.mode != "off" and row["id"] == state.recording
            if row["recording"]:
                row["seconds"] = state.seconds
        return Reply(True, "", {"recordings": rows})

    def delete_recording(self, id: str) -> Reply:
        """Delete a recording."""
        if id == self._recorder.state.recording:
            return Reply(False, f"{id} is being recorded: stop the recording first")
        delete_recording(self._recordings_folder, id)
        log.info("the recording %s was deleted", id)
        return Reply(True, f"{id} is deleted")

    def recording_files(self, id: str) -> Reply:
        """The files of a recording."""
        folder = find_recording(self._recordings_folder, id)
        return Reply(True, "", {"files": [str(path) for path in sorted(folder.iterdir()) if path.is_file()]})

    @property
    def _recordings_folder(self) -> Path:
        return Path(self.config.recording.folder)

    # -- settings ----------------------------------------------------------------------------------------------------

    def set_setting(self, name: str, value: str) -> Reply:
        """Change a setting that may change while running; it is not written to robot.toml."""
        override = parse_override(f"{one_of(name, CHANGEABLE, 'setting that may change')}={value}", self.config)
        self.config = changed = read(self.config, override, SEE)
        self._recorder.change(changed.recording)
        self._reporter.config = changed.recording
        self._maps.save_every_min = changed.map.save_every_min
        return Reply(True, f"{name} = {value}")
