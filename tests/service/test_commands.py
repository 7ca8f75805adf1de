"""Commands on a running service: settings, other maps, relocalization."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from stereo_sfm.drivers.choice import MadeSource
from stereo_sfm.maps.saved_map import load_map
from stereo_sfm.service.config import MapConfig, RecordingConfig, RobotConfig
from stereo_sfm.service.messages import PoseUpdate, Started
from stereo_sfm.service.service import Service
from tests.service.endless import endless_wall
from tests.service.test_service import wait_for

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("beside")]


class Watched:
    """A running service with its poses and sessions."""

    def __init__(self, service: Service) -> None:
        self.service, self.poses, self.sessions = service, list[PoseUpdate](), list[int]()
        service.on(PoseUpdate, self.poses.append)
        service.on(Started, lambda started: self.sessions.append(started.session))

    def status(self) -> dict[str, Any]:
        return self.service.status().data["status"]

    def more_poses(self, count: int = 60) -> None:
        before = len(self.poses)
        wait_for(lambda: len(self.poses) >= before + count)

    def localized_in(self, session: int) -> None:
        wait_for(lambda: self.poses and self.poses[-1].session == session and self.poses[-1].localized)


@contextmanager
def running(folder: Path, mode: str = "extend") -> Generator[Watched]:
    config = RobotConfig(
        map=MapConfig(str(folder / "store"), mode), recording=RecordingConfig(folder=str(folder / "recordings"))
    )
    with Service(config, MadeSource.of(endless_wall)) as service:
        watched = Watched(service)
        watched.more_poses()
        yield watched


def test_settings_maps_and_relocalization(tmp_path: Path) -> None:
    with running(tmp_path) as watched:
        service = watched.service
        assert watched.status()["map_saved_ns"] == 0 and watched.status()["map_is_new"]
        assert service.set_setting("map.save_every_min", "0.05").ok  # the next session saves every three seconds
        assert "from 0.05 to 1440" in service.call("set_setting", {"name": "map.save_every_min", "value": "-1"}).text
        refused = service.call("set_setting", {"name": "map.folder", "value": "/"})
        assert not refused.ok and "setting that may change" in refused.text
        assert service.status().data["settings"]["map.save_every_min"] == 0.05
        assert service.save_map("copy").ok

        assert service.relocalize().ok
        watched.localized_in(2)
        assert not watched.status()["map_is_new"]
        saved_ns = watched.status()["map_saved_ns"]
        wait_for(lambda: watched.status()["map_saved_ns"] > saved_ns)

        assert not service.load_map("nothing").ok
        assert service.load_map("copy").ok
        watched.localized_in(3)
        assert watched.status()["map_folder"] == str(tmp_path / "copy")
        assert service.save_map().ok
        health = service.status().data["health"]
        assert watched.sessions == [1, 2, 3] and health["restarts"] == 0
    assert load_map(tmp_path / "store").session_ids == [0, 1]  # the second session was not lost with its map
    assert load_map(tmp_path / "copy").session_ids == [0, 1]  # the first and the third

    with running(tmp_path, "localize") as watched:
        watched.localized_in(1)
        assert watched.status()["map_saved_ns"] > 0
        assert watched.service.relocalize().text == "the whole map is searched with the next keyframe"
        watched.more_poses()
        assert watched.sessions == [1] and watched.poses[-1].localized
