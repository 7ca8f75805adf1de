"""Every program of `examples/` runs, on a short part of the bundled recording."""

from __future__ import annotations

import json
import runpy
import socket
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = sorted((Path(__file__).parents[1] / "examples").glob("*.py"))
SAID = {
    "export.py": "{folder}/colmap, {folder}/points.ply, {folder}/trajectory.tum",
    "odometry_only.py": "OK: [",
    "own_loop.py": "keyframes\npath of 0.",
    "where_is_this.py": "mm from its pose",
}


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.name)
def test_an_example_runs_and_prints_its_output(
    path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    runpy.run_path(str(path))["main"](12)
    said = capsys.readouterr().out
    (folder,) = list(tmp_path.iterdir()) or [None]
    assert SAID[path.name].format(folder=folder) in said
    assert folder is None or str(folder) in said


def test_a_client_without_a_service_ends_with_one_line(tmp_path: Path) -> None:
    command = [sys.executable, str(EXAMPLES[0].parent / "pose_client" / "client.py")]
    place = tmp_path / "poses"
    ended = subprocess.run([*command, str(place)], capture_output=True, text=True, check=False)
    assert ended.returncode == 1 and ended.stderr == f"no service at {place}: No such file or directory\n"
    with socket.socket(socket.AF_UNIX) as server:  # one that refuses the token
        server.bind(str(place))
        server.listen()
        client = subprocess.Popen([*command, str(place)], stderr=subprocess.PIPE, text=True)
        server.accept()[0].close()
        assert len(client.communicate()[1].splitlines()) == 1 and client.returncode == 1


def test_a_client_whose_reader_has_enough_says_nothing(tmp_path: Path) -> None:
    """As `client.py | head -1`."""
    place, pose = tmp_path / "poses", {"unix_ns": 1, "state": "OK", "map_position": [0, 0, 0], "latency_ms": 1.0}
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(place))
        server.listen()
        command = [sys.executable, str(EXAMPLES[0].parent / "pose_client" / "client.py"), str(place)]
        client = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        assert client.stdout is not None and client.stderr is not None
        connection = server.accept()[0]
        line = json.dumps(pose).encode() + b"\n"
        connection.sendall(line)
        assert client.stdout.readline().startswith("1 OK")
        client.stdout.close()
        connection.sendall(line)
        assert (client.wait(), client.stderr.read()) == (0, "")
        client.stderr.close()
        connection.close()
