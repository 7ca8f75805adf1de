"""The clients of Foxglove's WebSocket: what each has subscribed to, and what it asks the service to do."""

from __future__ import annotations

import asyncio
import contextlib
import json
import threading
import time
from collections import deque
from typing import Any

from starlette.concurrency import run_in_threadpool
from starlette.types import Receive, Scope, Send

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.service.outputs import foxglove_protocol as protocol
from stereo_sfm.service.outputs.access import Bucket
from stereo_sfm.service.outputs.foxglove_protocol import Call, Channel
from stereo_sfm.service.outputs.guard import Guard, refusal
from stereo_sfm.service.publisher import COMMANDS, ServiceClient

SERVICES = ("status", "save_map", "load_map", "reset", "relocalize", "start_recording", "stop_recording", "mark")
BACKLOG = 256  # messages that wait for one client; the oldest is dropped
ANSWERS = 64  # answers that wait for one client, beyond which no more of its requests are read
CALLS = 4  # of one client at once
REPLY_S = 30.0
REQUEST_BYTES = 1 << 14
COMMAND_RATE, COMMANDS_AT_ONCE = 5.0, 20  # a second, of all clients


class Client:
    """One connection; used in the server's loop, but for `offer`."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self.subscriptions: dict[int, list[int]] = {}  # channel -> numbers of its subscriptions
        self._data: deque[bytes] = deque(maxlen=BACKLOG)
        self._answers: deque[str | bytes] = deque()
        self._wake, self._room = asyncio.Event(), asyncio.Event()

    def offer(self, channel: int, stamp_ns: int, data: bytes) -> None:
        """A message of a channel, from any thread."""
        for number in self.subscriptions.get(channel, ()):
            self._data.append(protocol.message(number, stamp_ns, data))
        if self._data:
            with contextlib.suppress(RuntimeError):  # the server has ended
                self._loop.call_soon_threadsafe(self._wake.set)

    async def answer(self, message: str | bytes) -> None:
        """Send an answer; waits while too many do already."""
        while len(self._answers) >= ANSWERS:
            self._room.clear()
            await self._room.wait()
        self._answers.append(message)
        self._wake.set()

    async def send_all(self, send: Send) -> None:
        """Send what comes, without end."""
        while True:
            await self._wake.wait()
            self._wake.clear()
            while self._answers or self._data:
                message = self._answers.popleft() if self._answers else self._data.popleft()
                self._room.set()
                await send({"type": "websocket.send", "text" if isinstance(message, str) else "bytes": message})


class FoxgloveClients:
    """The application behind the guard."""

    def __init__(self, channels: list[Channel], service: ServiceClient, guard: Guard) -> None:
        """Args: channels, all topics. service: carries out commands. guard: before it."""
        self._channels, self._service, self._guard = channels, service, guard
        self._ids = {channel.id for channel in channels}
        self._session = str(time.time_ns())
        self._commands = Bucket(COMMAND_RATE, COMMANDS_AT_ONCE)
        self._clients: list[Client] = []
        self._lock = threading.Lock()

    def wanted(self, channel: int) -> bool:
        """Whether somebody has subscribed to a channel."""
        with self._lock:
            return any(channel in client.subscriptions for client in self._clients)

    def publish(self, channel: int, stamp_ns: int, data: bytes) -> None:
        """A message for those who have subscribed, from any thread."""
        with self._lock:
            for client in self._clients:
                client.offer(channel, stamp_ns, data)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """A connection from its handshake to its end."""
        spoken = next((name for name in protocol.PROTOCOLS if name in scope.get("subprotocols", ())), None)
        if scope["type"] != "websocket":
            refused = refusal(426, "this is a WebSocket for Foxglove")
        elif (refused := self._guard.admit(scope)) is None and spoken is None:
            refused = refusal(400, f"this WebSocket speaks {' and '.join(protocol.PROTOCOLS)}")
        if refused is not None:
            await refused(scope, receive, send)
            return
        await receive()  # websocket.connect
        await send({"type": "websocket.accept", "subprotocol": spoken})
        client = Client(asyncio.get_running_loop())
        for text in self._welcome():
            await client.answer(text)
        with self._lock:
            self._clients.append(client)
        try:
            await self._serve(client, receive, send)
        finally:
            with self._lock:
                self._clients.remove(client)

    def _welcome(self) -> tuple[str, ...]:
        services = [protocol.service(i, name, COMMANDS[name].arguments) for i, name in enumerate(SERVICES, 1)]
        return (
            protocol.server_info(self._session),
            protocol.advertise(self._channels),
            protocol.advertise_services(services),
        )

    async def _serve(self, client: Client, receive: Receive, send: Send) -> None:
        sending = asyncio.create_task(client.send_all(send))
        reading = asyncio.create_task(self._read(client, receive))
        try:
            done, _ = await asyncio.wait((sending, reading), return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                task.result()
        finally:
            for task in (sending, reading):
                task.cancel()
            await asyncio.gather(sending, reading, return_exceptions=True)

    # -- requests ----------------------------------------------------------------------------------------------------

    async def _read(self, client: Client, receive: Receive) -> None:
        calls, places = set[asyncio.Task[None]](), asyncio.Semaphore(CALLS)
        try:
            while (message := await receive())["type"] == "websocket.receive":
                try:
                    if message.get("bytes") is not None:
                        await places.acquire()
                        call = asyncio.create_task(self._call(client, message["bytes"], places))
                        calls.add(call)
                        call.add_done_callback(calls.discard)
                    else:
                        await self._request(client, message.get("text") or "")
                except StereoSfmError as error:
                    await client.answer(protocol.problem(str(error)))
        finally:
            for call in calls:
                call.cancel()

    async def _request(self, client: Client, text: str) -> None:
        """A message in JSON.

        Raises:
            StereoSfmError: it is none of the protocol.
        """
        values = _object(text)
        op = values.get("op")
        if op == "subscribe":
            self._subscribe(client, _list(values, "subscriptions", dict))
        elif op == "unsubscribe":
            gone = set(_list(values, "subscriptionIds", int))
            with self._lock:
                kept = {c: [n for n in numbers if n not in gone] for c, numbers in client.subscriptions.items()}
                client.subscriptions = {channel: numbers for channel, numbers in kept.items() if numbers}
        elif op == "getParameters":
            await self._answer_parameters(client, values, _list(values, "parameterNames", str))
        elif op == "setParameters":
            names = await self._set_parameters(client, _list(values, "parameters", dict))
            await self._answer_parameters(client, values, names)
        else:
            raise StereoSfmError(f"there is no {str(op)[:50]!r} here")

    def _subscribe(self, client: Client, rows: list[dict[str, Any]]) -> None:
        for row in rows:
            number, channel = row.get("id"), row.get("channelId")
            if (
                type(number) is not int
                or type(channel) is not int
                or channel not in self._ids
                or not 0 <= number < 1 << 32
            ):
                raise StereoSfmError(f"there is no channel {str(channel)[:50]!r}")
            with self._lock:
                numbers = client.subscriptions.get(channel, [])
                if number not in numbers and len(numbers) < 4:  # nobody draws one topic more often than that
                    client.subscriptions[channel] = [*numbers, number]

    async def _answer_parameters(self, client: Client, values: dict[str, Any], names: list[str]) -> None:
        reply = await run_in_threadpool(self._service.call, "status")
        settings = {n: v for n, v in reply.data.get("settings", {}).items() if not names or n in names}
        id = values.get("id")
        await client.answer(protocol.parameter_values(settings, id if isinstance(id, str) else None))

    async def _set_parameters(self, client: Client, rows: list[dict[str, Any]]) -> list[str]:
        names = [str(row.get("name")) for row in rows]
        for name, row in zip(names, rows, strict=True):
            value = row.get("value")
            as_text = value if isinstance(value, str) else json.dumps(value)  # true, as TOML writes it, not True
            text = await run_in_threadpool(self._command, "set_setting", {"name": name, "value": as_text})
            reply = json.loads(text)
            if not reply["ok"]:
                await client.answer(protocol.problem(f"{name} is not set: {reply['text']}"))
        return names

    async def _call(self, client: Client, data: bytes, places: asyncio.Semaphore) -> None:
        try:
            call = Call.read(data)
            if not 1 <= call.service <= len(SERVICES):
                await client.answer(call.failure("there is no such service"))
                return
            name = SERVICES[call.service - 1]
            await client.answer(call.reply(await run_in_threadpool(self._reply, name, call.payload)))
        except StereoSfmError as error:
            await client.answer(protocol.problem(str(error)))
        finally:
            places.release()

    def _reply(self, name: str, payload: bytes) -> bytes:
        """The reply to a request, which may be anything."""
        try:
            if len(payload) > REQUEST_BYTES:
                raise StereoSfmError(f"the request is larger than {REQUEST_BYTES} bytes")
            arguments = _object(payload) if payload.strip() else {}
        except StereoSfmError as error:
            return json.dumps({"ok": False, "text": f"{name}: {error}", "data": {}}).encode()
        return self._command(name, arguments)

    def _command(self, name: str, arguments: dict[str, Any]) -> bytes:
        if not self._commands.take():
            return json.dumps({"ok": False, "text": "too many commands: wait a moment", "data": {}}).encode()
        try:
            reply = self._service.call(name, REPLY_S, **arguments)
        except StereoSfmError as error:
            return json.dumps({"ok": False, "text": str(error), "data": {}}).encode()
        return json.dumps({"ok": reply.ok, "text": reply.text, "data": reply.data}, default=str).encode()


def _object(text: str | bytes) -> dict[str, Any]:
    """A JSON object.

    Raises:
        StereoSfmError: it is something else.
    """
    try:
        values = json.loads(text)
    except (ValueError, RecursionError):
        values = None
    if not isinstance(values, dict):
        raise StereoSfmError("this is not a JSON object")
    return values  # pyright: ignore[reportUnknownVariableType]


def _list(values: dict[str, Any], name: str, kind: type) -> list[Any]:
    found: Any = values.get(name, [])
    if not isinstance(found, list) or not all(isinstance(item, kind) for item in found):  # pyright: ignore
        raise StereoSfmError(f"{name} must be a list of {kind.__name__}")
    return found  # pyright: ignore[reportUnknownVariableType]
