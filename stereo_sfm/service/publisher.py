"""The interface of an output, and the commands that it may call."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Protocol

from stereo_sfm.errors import StereoSfmError, one_of
from stereo_sfm.service.messages import ServiceMessage

MAX_TEXT = 1000  # characters of an argument


@dataclass(frozen=True)
class Reply:
    """The result of a command; `data` holds plain values only."""

    ok: bool
    text: str = ""
    data: dict[str, Any] = field(default_factory=dict[str, Any])


@dataclass(frozen=True)
class Command:
    """One row of the table.

    Attributes:
        text: what it does, in a sentence.
        arguments: name -> default of each; the type of the default is that of the argument.
    """

    text: str
    arguments: dict[str, str | int | float | bool] = field(default_factory=dict[str, "str | int | float | bool"])


COMMANDS: dict[str, Command] = {
    "status": Command("State, health and settings that may change"),
    "save_map": Command("Write the map now; a NAME saves a copy beside the configured folder", {"name": ""}),
    "load_map": Command("Continue with another saved map beside the configured folder", {"name": ""}),
    "reset": Command("Start tracking and mapping again with the newest saved map"),
    "relocalize": Command("Search the whole saved map for the camera's pose"),
    "start_recording": Command("Record: full, lean or black_box", {"mode": "full"}),
    "stop_recording": Command("Stop recording"),
    "mark": Command("Keep the recording around this moment", {"text": ""}),
    "recordings": Command("List the recordings"),
    "delete_recording": Command("Delete a recording", {"id": ""}),
    "recording_files": Command("The files of a recording", {"id": ""}),
    "set_setting": Command("Change a setting that is safe to change while running", {"name": "", "value": ""}),
}


def checked(name: str, arguments: dict[str, Any]) -> dict[str, Any]:
    """The arguments of a command with its defaults.

    Raises:
        StereoSfmError: no such command or argument, a value of another type, or a text that is too long.
    """
    defaults = COMMANDS[one_of(name, COMMANDS, "command")].arguments
    for key, value in arguments.items():
        default = defaults[one_of(key, defaults, f"argument of {name}")] if defaults else None
        if default is None:
            raise StereoSfmError(f"{name} takes no arguments")
        if not isinstance(value, type(default)):
            raise StereoSfmError(f"{name}: {key} must be {type(default).__name__}, not {type(value).__name__}")
        if isinstance(value, str) and (len(value) > MAX_TEXT or not value.isprintable()):
            raise StereoSfmError(f"{name}: {key} must be one line of at most {MAX_TEXT} characters")
    return {**defaults, **arguments}


class ServiceClient(Protocol):
    """The service as an output sees it. Thread-safe."""

    def call(self, name: str, timeout_s: float = 5.0, /, **arguments: Any) -> Reply:
        """Call a command and wait for its reply; a refused command is a `Reply` that is not ok."""
        ...


class Publisher(Protocol):
    """One output. It is made, used and closed in a process of its own.

    Attributes:
        wants: the kinds of messages that it gets.
        preview_hz: most preview images a second, where it wants them.
    """

    @property
    def wants(self) -> frozenset[type[ServiceMessage]]: ...

    @property
    def preview_hz(self) -> float: ...

    def open(self, service: ServiceClient) -> None:
        """Bind ports.

        Raises:
            StereoSfmError: it cannot; the service logs that, continues without it and tries again.
        """
        ...

    def put(self, message: ServiceMessage) -> None:
        """Publish a message. It may block: the queue before it drops its oldest messages."""
        ...

    def close(self) -> None:
        """Release all resources within a second."""
        ...
