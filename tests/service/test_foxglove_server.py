"""The Foxglove output, seen by a plain WebSocket client."""

from __future__ import annotations

import json
import socket
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.Odometry_pb2 import Odometry
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage

from stereo_sfm.calib.imu import Imu
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.log import topics
from stereo_sfm.messages import Health
from stereo_sfm.service.messages import Event
from stereo_sfm.service.outputs.access import Access
from stereo_sfm.service.outputs.foxglove_clients import SERVICES
from stereo_sfm.service.outputs.foxglove_server import KINDS, REPORT, STATUS, FoxgloveOutput
from stereo_sfm.service.outputs.settings import FoxgloveConfig
from stereo_sfm.service.publisher import Reply
from tests.service.service_messages import FakeService, cloud, health, live_depth, picture, pose_update, started, status
from tests.synthetic import pinhole_rig

connect = pytest.importorskip("websockets.sync.client").connect
pytest.importorskip("uvicorn")

TOKEN = "a-token-of-thirty-two-characters"


@contextmanager
def _serving(service: FakeService | None = None) -> Iterator[tuple[FoxgloveOutput, Any]]:
    output = FoxgloveOutput(FoxgloveConfig(port=0))
    output.open(service or FakeService())
    try:
        with connect(f"ws://127.0.0.1:{output.port}", subprotocols=["foxglove.sdk.v1"]) as client:
            yield output, client
    finally:
        output.close()


def _wait(client: Any, wanted: Callable[[Any], Any]) -> Any:
    """The first thing found in what the server says, which is a dict or bytes."""
    for _ in range(500):
        said = client.recv(timeout=5)
        found = wanted(said if isinstance(said, bytes) else json.loads(said))
        if found is not None:
            return found
    raise AssertionError("it never came")


def _channels(client: Any, count: int) -> dict[str, dict[str, Any]]:
    known: dict[str, dict[str, Any]] = {}

    def take(said: Any) -> bool | None:
        if isinstance(said, dict) and said["op"] == "advertise":
            known.update({c["topic"]: c for c in said["channels"]})
        return True if len(known) >= count else None

    _wait(client, take)
    return known


def _subscribe(client: Any, channels: dict[int, int]) -> None:
    """Args: channels, number of the subscription -> of the channel. What is sent after it returns, comes."""
    rows = [{"id": number, "channelId": channel} for number, channel in channels.items()]
    client.send(json.dumps({"op": "subscribe", "subscriptions": rows}))
    client.send(json.dumps({"op": "getParameters", "parameterNames": [], "id": "x"}))
    _wait(client, lambda said: True if isinstance(said, dict) and said["op"] == "parameterValues" else None)


def _everything(output: FoxgloveOutput) -> None:
    for message in (started(), pose_update(1), status(), cloud(), picture(), health(), live_depth(1)):
        output.put(message)
    output.put(Event(0, "warning", "tracker", "lost in aisle 3"))


def test_every_topic_is_there_before_the_first_message() -> None:
    with _serving() as (_, client):
        assert _channels(client, len(KINDS) + 3).keys() == {*KINDS, topics.HEALTH, STATUS, REPORT}


def test_the_topics_are_those_of_the_log() -> None:
    with _serving() as (output, client):
        _everything(output)
        known = _channels(client, 19)
        names = set(known) - {STATUS, REPORT}
        assert names <= set(topics.BY_NAME) and {topics.TF, topics.POINTS, topics.LEFT_IMAGE, topics.LOG} <= names
        assert all(known[name]["schemaName"] in topics.BY_NAME[name].schema.split("|") for name in names)
        wanted = {
            1: topics.ODOMETRY, 2: topics.LEFT_IMAGE, 3: topics.POINTS, 4: STATUS, 5: topics.LIVE_DEPTH,
            6: topics.OBSTACLES,
        }  # fmt: skip
        _subscribe(client, {i: known[topic]["id"] for i, topic in wanted.items()})
        _everything(output)
        got: dict[int, bytes] = {}

        def take(said: Any) -> bool | None:
            if isinstance(said, bytes) and said[0] == 1:
                got.setdefault(struct.unpack_from("<I", said, 1)[0], said[13:])
            return True if len(got) == len(wanted) else None

        _wait(client, take)
    odometry, sent = Odometry.FromString(got[1]), pose_update(1)
    assert (odometry.frame_id, odometry.body_frame_id) == ("odom", "body")
    np.testing.assert_allclose(odometry.pose_covariance, sent.covariance.ravel())
    image = cv2.imdecode(np.frombuffer(CompressedImage.FromString(got[2]).data, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert np.abs(image.astype(int) - picture().left).mean() < 6
    points = PointCloud.FromString(got[3])
    assert len(points.data) // points.point_stride == len(cloud().points)
    assert json.loads(got[4])["state"] == "running"
    depth, obstacles = RawImage.FromString(got[5]), PointCloud.FromString(got[6])
    assert (depth.encoding, depth.width, depth.height, depth.step, depth.frame_id) == ("16UC1", 6, 4, 12, "cam0")
    np.testing.assert_array_equal(np.frombuffer(depth.data, "<u2").reshape(4, 6), live_depth().depth_mm)
    rows = np.frombuffer(obstacles.data, np.uint8).reshape(-1, obstacles.point_stride)
    np.testing.assert_array_equal(rows[:, :12].copy().view("<f4"), live_depth().obstacles)


def test_the_level_is_the_measured_one_where_there_is_an_imu() -> None:
    imu = Imu(np.eye(4), gyro_noise=1e-3, accel_noise=1e-2)
    down = np.array([0.0, np.cos(0.2), np.sin(0.2)])  # the first camera looks 0.2 rad down
    with _serving() as (output, client):
        known = _channels(client, len(KINDS) + 3)
        for rig, topic in ((pinhole_rig(), topics.TF_STATIC), (replace(pinhole_rig(), imu=imu), topics.TF)):
            _subscribe(client, {known[topic]["id"]: known[topic]["id"]})
            output.put(started(rig))
            output.put(pose_update(1, down=down))

            def take(said: Any) -> Any:
                if not isinstance(said, bytes) or said[0] != 1:
                    return None
                rows = FrameTransforms.FromString(said[13:]).transforms
                return next((row.rotation for row in rows if row.parent_frame_id == "level"), None)

            turn = _wait(client, take)
            level_R_map = se3.rotation_from_quaternion(np.array([turn.x, turn.y, turn.z, turn.w]))
            expected = down if topic == topics.TF else np.array([0.0, 1.0, 0.0])
            np.testing.assert_allclose(level_R_map @ expected, [0, 0, -1], atol=1e-9)


def _call(client: Any, number: int, payload: bytes) -> dict[str, Any]:
    client.send(struct.pack("<BIII", 2, number, 7, 4) + b"json" + payload)

    def take(said: Any) -> Any:
        if isinstance(said, bytes) and said[0] == 3:
            size = struct.unpack_from("<I", said, 9)[0]
            return json.loads(said[13 + size :])
        return None

    return _wait(client, take)


def test_the_services_are_commands() -> None:
    service = FakeService({"save_map": Reply(False, "the disk is full")})
    with _serving(service) as (_, client):
        rows = _wait(client, lambda said: said["services"] if said.get("op") == "advertiseServices" else None)
        numbers = {row["name"].strip("/"): row["id"] for row in rows}
        assert set(numbers) == set(SERVICES) and "delete_recording" not in numbers
        assert _call(client, numbers["mark"], b'{"text": "bump"}') == {"ok": True, "text": "mark done", "data": {}}
        assert service.calls[-1] == ("mark", {"text": "bump"})
        assert _call(client, numbers["save_map"], b"")["text"] == "the disk is full"
        count = len(service.calls)
        for bad in (b"[1]", b"{", b'{"texd": 1}', b'{"text": 5}', b'{"text": "%s"}' % (b"x" * 20_000)):
            answer = _call(client, numbers["mark"], bad)
            assert not answer["ok"] and answer["text"] and "\n" not in answer["text"]
        assert len(service.calls) == count


def test_settings_are_parameters() -> None:
    service = FakeService({"status": Reply(True, "", {"settings": {"recording.mode": "off", "page.picture_hz": 4.0}})})
    with _serving(service) as (_, client):
        client.send(json.dumps({"op": "getParameters", "parameterNames": [], "id": "a"}))
        values = _wait(client, lambda said: said["parameters"] if said.get("op") == "parameterValues" else None)
        assert {v["name"]: v["value"] for v in values} == {"recording.mode": "off", "page.picture_hz": 4.0}
        given = {"recording.mode": "full", "recording.mark_losses": True, "map.save_every_min": 2.5}
        rows = [{"name": name, "value": value} for name, value in given.items()]
        client.send(json.dumps({"op": "setParameters", "parameters": rows, "id": "b"}))
        _wait(client, lambda said: said["parameters"] if said.get("op") == "parameterValues" else None)
    assert ("set_setting", {"name": "recording.mode", "value": "full"}) in service.calls
    assert ("set_setting", {"name": "recording.mark_losses", "value": "true"}) in service.calls
    assert ("set_setting", {"name": "map.save_every_min", "value": "2.5"}) in service.calls


def test_channels_that_are_no_numbers_end_no_connection() -> None:
    service = FakeService({"status": Reply(True, "", {"settings": {"recording.mode": "off"}})})
    with _serving(service) as (_, client):
        for channel in ([], {}, "1", None, 1.5, True, 10**400):
            client.send(json.dumps({"op": "subscribe", "subscriptions": [{"id": 1, "channelId": channel}]}))
            said = _wait(client, lambda said: said["message"] if said.get("op") == "status" else None)
            assert "there is no channel" in said
        client.send(json.dumps({"op": "getParameters", "parameterNames": [], "id": "a"}))
        assert _wait(client, lambda said: said["parameters"] if said.get("op") == "parameterValues" else None)


def _refused(output: FoxgloveOutput, path: str = "", **headers: str) -> int:
    """The status of a handshake, 101 where it succeeds."""
    more = {name.replace("_", "-"): value for name, value in headers.items()}
    protocol = more.pop("protocol", "foxglove.sdk.v1")
    lines = [
        f"GET /{path} HTTP/1.1",
        f"Host: {more.pop('Host', f'127.0.0.1:{output.port}')}",
        "Upgrade: websocket",
        "Connection: Upgrade",
        "Sec-WebSocket-Version: 13",
        "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==",
        f"Sec-WebSocket-Protocol: {protocol}",
        *(f"{name}: {value}" for name, value in more.items()),
    ]
    with socket.create_connection(("127.0.0.1", output.port), 5) as client:
        client.sendall("\r\n".join([*lines, "", ""]).encode())
        return int(client.recv(1000).split()[1])


@pytest.mark.parametrize("rules", [Access(), Access(TOKEN)])
def test_pages_of_other_sites_are_refused(rules: Access) -> None:
    """A page in a browser on the robot reaches this port: its Origin and Host say whose page it is."""
    output = FoxgloveOutput(FoxgloveConfig(port=0), rules)
    output.open(FakeService())
    good = {"Authorization": f"Bearer {TOKEN}"}
    try:
        assert _refused(output, **good) == _refused(output, Origin="https://app.foxglove.dev", **good) == 101
        assert _refused(output, Origin=f"http://127.0.0.1:{output.port}", **good) == 101
        assert _refused(output, protocol="foxglove.websocket.v1", **good) == 101
        for origin in ("https://evil.example", "null", "https://app.foxglove.dev.evil.example", "http://127.0.0.1"):
            assert _refused(output, Origin=origin, **good) == 403, origin
        for host in ("evil.example", f"evil.example:{output.port}", "127.0.0.1.evil.example", ""):
            assert _refused(output, Host=host, Origin=f"http://{host}", **good) == 421, host
        assert _refused(output, protocol="chat", **good) == 400
    finally:
        output.close()


def test_nobody_without_the_token_is_served() -> None:
    output = FoxgloveOutput(FoxgloveConfig(port=0), Access(TOKEN))
    output.open(FakeService())
    try:
        assert _refused(output) == _refused(output, "?token=wrong") == _refused(output, Authorization="Bearer x") == 401
        assert _refused(output, f"?token={TOKEN}", Origin="https://app.foxglove.dev") == 101  # as Foxglove can
    finally:
        output.close()


def test_who_guesses_tokens_waits() -> None:
    output = FoxgloveOutput(FoxgloveConfig(port=0), Access(TOKEN))
    output.open(FakeService())
    try:
        answers = [_refused(output, Authorization=f"Bearer guess {i}") for i in range(40)]
        assert set(answers) == {401, 429} and answers.count(429) >= 32
        assert _refused(output, Authorization=f"Bearer {TOKEN}") == 429  # the right one would be found by guessing
    finally:
        output.close()


def test_a_client_that_does_not_read_delays_no_other() -> None:
    with _serving() as (output, client):
        known = _channels(client, len(KINDS) + 3)
        with connect(f"ws://127.0.0.1:{output.port}", subprotocols=["foxglove.sdk.v1"], max_queue=1) as slow:
            for one in (slow, client):
                _subscribe(one, {1: known[topics.POINTS]["id"]})
            output.put(started())
            for _ in range(300):
                output.put(cloud(20_000))
            assert len(_wait(client, lambda said: said if isinstance(said, bytes) and said[0] == 1 else None)) > 10_000
            for one in (slow, client):  # with a handshake for the end they would wait for what was not read
                one.socket.shutdown(socket.SHUT_RDWR)


def test_a_port_that_is_taken_is_one_line() -> None:
    with _serving() as (output, _), pytest.raises(StereoSfmError, match="cannot listen"):
        FoxgloveOutput(FoxgloveConfig(port=output.port)).open(FakeService())


def test_health_is_one_message_a_stage() -> None:
    with _serving() as (output, client):
        known = _channels(client, len(KINDS) + 3)
        _subscribe(client, {1: known[topics.HEALTH]["id"], 2: known[REPORT]["id"]})
        output.put(health(stages={n: Health(n, 1, 30.0, 0, 1.0, 2.0, 3.0, 0) for n in ("tracker", "mapper")}))
        got: list[int] = []

        def take(said: Any) -> bool | None:
            if isinstance(said, bytes) and said[0] == 1:
                got.append(struct.unpack_from("<I", said, 1)[0])
            return True if 2 in got else None

        _wait(client, take)
    assert got == [1, 1, 2]
