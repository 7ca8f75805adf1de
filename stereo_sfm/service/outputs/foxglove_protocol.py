"""The messages of Foxglove's WebSocket protocol, as bytes and JSON.

Source: github.com/foxglove/ws-protocol, docs/spec.md. `foxglove.sdk.v1` has the same messages under another name.
"""

from __future__ import annotations

import base64
import json
import struct
from dataclasses import asdict, dataclass
from typing import Any

from stereo_sfm.errors import StereoSfmError

PROTOCOLS = ("foxglove.sdk.v1", "foxglove.websocket.v1")
MESSAGE, CALL, RESPONSE = 1, 2, 3  # first byte of a binary message
ERROR_LEVEL = 2
_DATA, _REPLY = struct.Struct("<BIQ"), struct.Struct("<BIII")


@dataclass(frozen=True)
class Channel:
    """A topic, with the names of the protocol."""

    id: int
    topic: str
    encoding: str
    schemaName: str
    schema: str
    schemaEncoding: str

    @staticmethod
    def protobuf(id: int, topic: str, name: str, descriptors: bytes) -> Channel:
        """A topic of protobuf messages."""
        return Channel(id, topic, "protobuf", name, base64.b64encode(descriptors).decode(), "protobuf")

    @staticmethod
    def json(id: int, topic: str) -> Channel:
        """A topic of JSON objects."""
        kind = {"type": "object", "title": topic}
        return Channel(id, topic, "json", topic, json.dumps(kind), "jsonschema")


@dataclass(frozen=True)
class Call:
    """A request to a service."""

    service: int
    number: int
    encoding: bytes
    payload: bytes

    @staticmethod
    def read(data: bytes) -> Call:
        """From a binary message.

        Raises:
            StereoSfmError: it is none.
        """
        if len(data) < _REPLY.size or data[0] != CALL:
            raise StereoSfmError("this binary message is no request to a service")
        _, service, number, size = _REPLY.unpack_from(data)
        rest = data[_REPLY.size :]
        if size > len(rest):
            raise StereoSfmError("this request to a service is cut off")
        return Call(service, number, rest[:size], rest[size:])

    def reply(self, payload: bytes) -> bytes:
        """The answer to it."""
        return _REPLY.pack(RESPONSE, self.service, self.number, len(self.encoding)) + self.encoding + payload

    def failure(self, why: str) -> str:
        """The answer where there is none."""
        return _text("serviceCallFailure", serviceId=self.service, callId=self.number, message=why)


def message(subscription: int, stamp_ns: int, data: bytes) -> bytes:
    """A message of a topic, for one subscription."""
    return _DATA.pack(MESSAGE, subscription, max(stamp_ns, 0)) + data


def server_info(session: str) -> str:
    """The first message."""
    return _text(
        "serverInfo", name="stereo-sfm", capabilities=["services", "parameters"], supportedEncodings=["json"],
        metadata={}, sessionId=session,
    )  # fmt: skip


def advertise(channels: list[Channel]) -> str:
    """The topics."""
    return _text("advertise", channels=[asdict(channel) for channel in channels])


def service(id: int, name: str, arguments: dict[str, str | int | float | bool]) -> dict[str, Any]:
    """A service whose request and response are JSON objects. Args: arguments, name -> default."""

    def kind(what: str, properties: dict[str, Any]) -> dict[str, str]:
        schema = json.dumps({"type": "object", "title": f"{name} {what}", "properties": properties})
        return {"encoding": "json", "schemaName": f"{name}_{what}", "schemaEncoding": "jsonschema", "schema": schema}

    request = {
        key: {"type": "string" if isinstance(value, str) else "number", "default": value}
        for key, value in arguments.items()
    }
    response = {"ok": {"type": "boolean"}, "text": {"type": "string"}, "data": {"type": "object"}}
    kinds = {"request": kind("request", request), "response": kind("response", response)}
    return {"id": id, "name": f"/{name}", "type": name, **kinds}


def advertise_services(services: list[dict[str, Any]]) -> str:
    """The services."""
    return _text("advertiseServices", services=services)


def parameter_values(settings: dict[str, Any], request: str | None) -> str:
    """The parameters."""
    rows = [
        {"name": name, "value": value, **({"type": "float64"} if isinstance(value, float) else {})}
        for name, value in settings.items()
    ]
    return _text("parameterValues", parameters=rows, **({} if request is None else {"id": request}))


def problem(text: str) -> str:
    """What was wrong with a client's message."""
    return _text("status", level=ERROR_LEVEL, message=text)


def _text(op: str, **values: Any) -> str:
    return json.dumps({"op": op, **values}, separators=(",", ":"))
