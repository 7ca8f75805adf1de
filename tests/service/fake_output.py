"""Outputs for the tests of the service: they run in processes of their own."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass, field
from pathlib import Path

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.service.config import RobotConfig
from stereo_sfm.service.messages import PoseUpdate, Status
from stereo_sfm.service.publisher import ServiceClient


@dataclass
class Lines:
    """Writes a line per message into the file that the security section names as its token file."""

    path: Path
    wants: frozenset[type] = frozenset({Status, PoseUpdate})
    preview_hz: float = 0.0
    slow_s: float = 0.0
    client: ServiceClient | None = None
    lines: list[str] = field(default_factory=list)

    def open(self, service: ServiceClient) -> None:
        if self.path.with_suffix(".taken").exists():
            raise StereoSfmError("port 1 is taken")
        self.client = service

    def put(self, message: object) -> None:
        time.sleep(self.slow_s)
        text = type(message).__name__
        if isinstance(message, Status):
            text += f" {message.reason}"
            if message.reason == "die":
                os._exit(3)
            if message.reason == "ask":
                assert self.client is not None
                text += f" {self.client.call('mark', text='bump')}"
        with self.path.open("a") as file:
            file.write(text + "\n")

    def close(self) -> None:
        with self.path.open("a") as file:
            file.write("closed\n")


def make(config: RobotConfig) -> Lines:
    return Lines(Path(config.security.token_file))


def make_slow(config: RobotConfig) -> Lines:
    return Lines(Path(config.security.token_file), slow_s=0.2)
