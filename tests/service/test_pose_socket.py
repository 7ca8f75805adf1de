"""Poses on a socket: what a client gets, in which axes, and that nobody waits for one that does not read."""

from __future__ import annotations

import errno
import hmac
import json
import math
import re
import shutil
import socket
import ssl
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.log import schema
from stereo_sfm.service.config import RobotConfig
from stereo_sfm.service.outputs import pose_socket
from stereo_sfm.service.outputs.access import WRONG_AT_ONCE, Access, access
from stereo_sfm.service.outputs.door import Door, Visit
from stereo_sfm.service.outputs.pose_message import MISSED_FIELD, PoseMessage
from stereo_sfm.service.outputs.pose_socket import MOST_CLIENTS, Place, PoseSocket
from stereo_sfm.service.outputs.settings import OutputsConfig, PoseSocketConfig, SecurityConfig
from tests.service.service_messages import NAN6, FakeService, pose_update, started
from tests.synthetic import pinhole_rig

EXAMPLES = Path(__file__).parents[2] / "examples" / "pose_client"
TOKEN = "a-token-of-thirty-two-characters"


@contextmanager
def _listening(form: str = "json", rules: Access | None = None, place: str = "tcp://127.0.0.1:0") -> Iterator[Any]:
    output = PoseSocket(Place.read(place), form, rules)
    output.open(FakeService())
    output.put(started())
    try:
        yield output
    finally:
        output.close()


def _clients(output: PoseSocket) -> int:
    return len(output._clients)  # pyright: ignore[reportPrivateUsage]


def _connect(output: PoseSocket, count: int = 1) -> socket.socket:
    client = socket.create_connection(("127.0.0.1", output.port), 5)
    _until(lambda: _clients(output) >= count)
    return client


def _drained(client: socket.socket) -> bytes:
    """What arrives until nothing does."""
    client.settimeout(0.3)
    data = b""
    with suppress(TimeoutError):
        while more := client.recv(1 << 16):
            data += more
    return data


def _until(true: Callable[[], bool], seconds: float = 5.0) -> None:
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end, "it never came"
        time.sleep(0.005)


def test_a_pose_is_a_line_in_the_axes_of_robots() -> None:
    """A camera that moves along its optical axis (z) and turns right is a robot that drives along x and turns right."""
    turned = se3.exp(np.array([0.0, 0.0, 2.0, 0.0, 0.3, 0.0]))  # forward, then about the camera's y, which points down
    with _listening() as output, _connect(output) as client:
        output.put(pose_update(7, turned, captured_s=time.monotonic() - 0.012))
        pose = json.loads(client.makefile().readline())
    forward, left, up = pose["odom_position"]
    assert forward > 1.9 and left < -0.2 and abs(up) < 1e-12
    x, y, z, w = pose["odom_quaternion"]
    assert (x, y) == pytest.approx((0, 0), abs=1e-12) and 2 * math.atan2(z, w) == pytest.approx(-0.3)
    assert pose["map_position"] == pytest.approx(pose["odom_position"])
    assert np.reshape(pose["covariance"], (6, 6)).diagonal() == pytest.approx([3e-4, 1e-4, 2e-4, 3e-6, 1e-6, 2e-6])
    assert pose["twist"] == pytest.approx([0.5, 0, 0, 0, 0, 0.1])
    assert 12 <= pose["latency_ms"] < 200 and pose["missed"] == 0
    assert (pose["frame_id"], pose["state"], pose["tracked"], pose["session"]) == (7, "OK", True, 1)


def test_who_guesses_tokens_is_not_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    rules, looked_at = Access(TOKEN), list[str]()
    compare = hmac.compare_digest
    monkeypatch.setattr(hmac, "compare_digest", lambda *two: looked_at.append(two[0]) or compare(*two))
    with _listening(rules=rules) as output:
        for i in range(40):
            with socket.create_connection(("127.0.0.1", output.port), 5) as client:
                client.sendall(f"guess {i}\n".encode())
                assert client.recv(1) == b""
    assert WRONG_AT_ONCE <= len(looked_at) <= WRONG_AT_ONCE + 3


def test_a_page_of_another_site_locks_nobody_out() -> None:
    """A browser sends requests where a page wants: they are no attempts of its visitor."""
    with _listening(rules=Access(TOKEN)) as output:
        for path in ("/", f"/{TOKEN}") * WRONG_AT_ONCE:
            with socket.create_connection(("127.0.0.1", output.port), 5) as client:
                client.sendall(f"GET {path} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())
                assert _read_all(client) == b""
        with socket.create_connection(("127.0.0.1", output.port), 5) as client:
            client.sendall(TOKEN.encode() + b"\n")
            _until(lambda: _clients(output) == 1)


def _read_all(client: socket.socket) -> bytes:
    with suppress(ConnectionError):  # it was closed with the rest of the request unread
        return client.recv(100)
    return b""


def test_a_calibrated_body_is_the_robot() -> None:
    """A camera 1 m in front of the robot's centre: turning on the spot does not move the robot."""
    forward = np.array([[0.0, 0, 1, 1.0], [-1, 0, 0, 0], [0, -1, 0, 0.5], [0, 0, 0, 1]])
    rig = replace(pinhole_rig(), body_T_left=forward)
    turn = np.eye(4)
    turn[:3, :3] = se3.exp(np.array([0, 0, 0, 0, 0, 0.4]))[:3, :3]
    odom_T_body = se3.inverse(forward) @ turn  # odom is the first camera: the body began at inverse(body_T_left)
    with _listening() as output, _connect(output) as client:
        output.put(started(rig))
        output.put(pose_update(0, odom_T_body, twist=np.arange(6.0)))
        pose = json.loads(client.makefile().readline())
    assert pose["odom_position"] == pytest.approx([0, 0, 0], abs=1e-12)
    assert 2 * math.atan2(*pose["odom_quaternion"][2:]) == pytest.approx(0.4)
    assert pose["twist"] == pytest.approx(range(6))


def test_what_is_unknown_is_null() -> None:
    with _listening() as output, _connect(output) as client:
        output.put(pose_update(0, state="LOST", reason="dark", tracked=False, twist=NAN6))
        pose = json.loads(client.makefile().readline())
    assert pose["twist"] == [None] * 6 and pose["reason"] == "dark" and pose["tracked"] is False


def test_a_client_that_does_not_read_delays_no_other_and_gets_the_count_of_missed_poses() -> None:
    count = 3000
    with _listening() as output, _connect(output) as slow, _connect(output, 2) as fast:
        got: list[int] = []
        reader = threading.Thread(target=lambda: got.extend(json.loads(x)["frame_id"] for x in fast.makefile()))
        reader.start()
        longest = 0.0
        for i in range(count):
            begin = time.monotonic()
            output.put(pose_update(i))
            longest = max(longest, time.monotonic() - begin)
            if i % 20 == 0:
                time.sleep(0.002)  # the reader's turn
        _until(lambda: bool(got) and got[-1] == count - 1)
        assert got == list(range(count))  # the other one got all
        fast.shutdown(socket.SHUT_RDWR)
        reader.join()
        early = _drained(slow)
        output.put(pose_update(count))
        poses = [json.loads(line) for line in (early + _drained(slow)).splitlines()]
    ids = [p["frame_id"] for p in poses]  # the oldest, in the buffers of the system, which may grow while they are full
    assert ids[0] == 0 and ids[-1] == count and len(ids) < count / 2
    assert [p["missed"] for p in poses] == [0, *(np.diff(ids) - 1)]
    assert longest < 1.0


@pytest.mark.parametrize("kind", ["json", "protobuf"])
def test_both_formats_have_the_same_content(kind: str) -> None:
    update = pose_update(5, se3.exp(np.array([0.1, 0.2, 0.3, 0.1, -0.2, 0.3])))
    with _listening(kind) as output, _connect(output) as client:
        output.put(update)
        stream = client.makefile("rb")
        if kind == "json":
            values = json.loads(stream.readline())
            found = {f: values[f] for f in ("frame_id", "state", "odom_position", "covariance", "missed")}
        else:
            data = stream.read(int.from_bytes(stream.read(4), "little"))
            m = schema.decoder(PoseMessage, schema.schema_data(PoseMessage))(data)
            found = {f: getattr(m, f) for f in ("frame_id", "state", "odom_position", "covariance")}
            assert data[-2:] == b"\x01\x00" and data[-3] == MISSED_FIELD << 3 & 0x7F | 0x80
            found["missed"] = data[-1]
    assert found["frame_id"] == 5 and found["state"] == "OK" and found["missed"] == 0
    expected = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]]) @ update.odom_T_body[:3, 3]
    np.testing.assert_allclose(np.ravel(found["odom_position"]), expected)
    assert np.size(found["covariance"]) == 36


def test_the_proto_file_is_the_message() -> None:
    from google.protobuf import descriptor_pb2

    file = descriptor_pb2.FileDescriptorSet.FromString(schema.schema_data(PoseMessage)).file[0]
    types = {1: "double", 9: "string", 8: "bool", 18: "sint64"}
    ours = [("repeated " * (f.label == 3) + types[f.type], f.name, f.number) for f in file.message_type[0].field]
    text = (EXAMPLES / "pose.proto").read_text()
    written = [
        (kind, name, int(n)) for kind, name, n in re.findall(r"^  ((?:repeated )?\w+) (\w+) = (\d+);", text, re.M)
    ]
    assert written == [*ours, ("sint64", "missed", MISSED_FIELD)]


def test_only_a_client_with_the_token_gets_poses() -> None:
    rules = Access(TOKEN)
    with _listening(rules=rules) as output:
        good, bad = (socket.create_connection(("127.0.0.1", output.port), 5) for _ in range(2))
        bad.sendall(b"x" * 32 + b"\n")
        good.sendall(TOKEN.encode() + b"\n")
        _until(lambda: _clients(output) == 1)
        output.put(pose_update(1))
        assert json.loads(good.makefile().readline())["frame_id"] == 1
        assert bad.recv(10) == b""
        good.close(), bad.close()


def test_more_clients_than_allowed_are_turned_away() -> None:
    with _listening() as output:
        clients = [socket.create_connection(("127.0.0.1", output.port), 5) for _ in range(MOST_CLIENTS)]
        _until(lambda: _clients(output) == MOST_CLIENTS)
        with socket.create_connection(("127.0.0.1", output.port), 5) as one_more:
            assert one_more.recv(10) == b""
        clients.pop().close()
        for i in range(200):
            output.put(pose_update(i))
        assert _clients(output) == MOST_CLIENTS - 1  # who has gone is forgotten
        for client in clients:
            client.close()


@pytest.mark.parametrize("rules", [Access(), Access(TOKEN)])
def test_too_many_open_files_end_no_socket(monkeypatch: pytest.MonkeyPatch, rules: Access) -> None:
    accepted, refused = Door.visitor, [OSError(errno.EMFILE, "Too many open files")] * 2

    def visitor(door: Door) -> Visit:
        visit = accepted(door)
        if refused:
            visit.socket.close()
            raise refused.pop()
        return visit

    monkeypatch.setattr(Door, "visitor", visitor)
    with _listening(rules=rules) as output:
        for _ in range(2):
            with socket.create_connection(("127.0.0.1", output.port), 5) as client:
                client.sendall(TOKEN.encode() + b"\n")
                assert not _read_all(client)
        with socket.create_connection(("127.0.0.1", output.port), 5) as client:
            client.sendall(TOKEN.encode() + b"\n")
            _until(lambda: _clients(output) == 1)


def test_a_local_socket_is_taken_over_from_a_dead_service(tmp_path: Path) -> None:
    place = tmp_path / "pose.sock"
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(place))
    with _listening(place=str(place)) as output, socket.socket(socket.AF_UNIX) as client:
        assert place.stat().st_mode & 0o777 == 0o660
        client.connect(str(place))
        _until(lambda: _clients(output) == 1)
        output.put(pose_update(3))
        assert json.loads(client.makefile().readline())["frame_id"] == 3
        with pytest.raises(StereoSfmError, match="cannot listen"):
            PoseSocket(Place.read(str(place)), "json").open(FakeService())
    assert not place.exists()


@pytest.mark.parametrize(
    "text", ["", "udp://1.2.3.4:5", "tcp://127.0.0.1", "tcp://127.0.0.1:x", "tcp://127.0.0.1:70000"]
)
def test_bad_places_are_one_line(text: str) -> None:
    with pytest.raises(StereoSfmError, match="pose socket"):
        Place.read(text)


def test_the_output_is_made_of_its_section() -> None:
    section = PoseSocketConfig(True, "tcp://0.0.0.0:0")
    config = RobotConfig(outputs=OutputsConfig(pose_socket=section), security=SecurityConfig(auth="none"))
    with pytest.raises(StereoSfmError, match="others could connect"):
        pose_socket.make(config)


def test_encrypted_where_there_is_a_certificate(tmp_path: Path) -> None:
    if shutil.which("openssl") is None:
        pytest.skip("no openssl to make a certificate with")
    key, cert, token = tmp_path / "key.pem", tmp_path / "cert.pem", tmp_path / "token"
    subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes", "-keyout",
         str(key), "-out", str(cert), "-days", "1", "-subj", "/CN=robot"], check=True, capture_output=True,
    )  # fmt: skip
    token.write_text(TOKEN)
    token.chmod(0o600)
    rules = access(SecurityConfig(str(token), str(cert), str(key)), "10.0.0.1")
    trust = ssl.create_default_context(cafile=str(cert))
    trust.check_hostname = False
    with _listening(rules=rules) as output, socket.create_connection(("127.0.0.1", output.port), 5) as plain:
        client = trust.wrap_socket(plain)
        client.sendall(TOKEN.encode() + b"\n")
        _until(lambda: _clients(output) == 1)
        for i in range(5):
            output.put(pose_update(i))
        lines = client.makefile()
        assert [json.loads(lines.readline())["frame_id"] for _ in range(5)] == list(range(5))


def _example(command: list[str], output: PoseSocket, *token: str) -> str:
    """The first line that a client prints. Args: token, the file."""
    with subprocess.Popen([*command, str(output.port), *token], stdout=subprocess.PIPE, text=True) as client:
        _until(lambda: _clients(output) == 1, 20)
        end = time.monotonic() + 20
        line: list[str] = []
        assert client.stdout is not None
        reader = threading.Thread(target=lambda: line.append(client.stdout.readline()))  # pyright: ignore
        reader.start()
        while not line and time.monotonic() < end:
            output.put(pose_update(1, se3.exp(np.array([0, 0, 1.5, 0, 0, 0]))))
            time.sleep(0.02)
        client.kill()
        reader.join()
    return line[0]


def test_the_clients_of_the_examples_print_poses(tmp_path: Path) -> None:
    token = tmp_path / "token"
    token.write_text(TOKEN + "\n")
    compiler, nc = shutil.which("g++"), shutil.which("nc")
    commands = {" OK 1.500 ": [sys.executable, "-u", str(EXAMPLES / "client.py")]}
    if compiler is not None:
        subprocess.run([compiler, "-std=c++17", str(EXAMPLES / "client.cpp"), "-o", str(tmp_path / "c")], check=True)
        commands["1.500 "] = [str(tmp_path / "c")]
    if nc is not None:
        commands[" OK 1.5,"] = ["sh", str(EXAMPLES / "client.sh")]
    for expected, command in commands.items():
        with _listening(rules=Access(TOKEN)) as output:
            assert expected in _example(command, output, str(token))


def test_the_client_says_that_there_is_no_service(tmp_path: Path) -> None:
    done = subprocess.run([sys.executable, EXAMPLES / "client.py", tmp_path / "none"], capture_output=True, text=True)
    assert done.returncode and done.stderr.startswith("no service at ") and done.stderr.count("\n") == 1
