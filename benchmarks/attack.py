"""Attacks on a running service and hostile files for its commands, from this computer alone: what became of each.

    python -m benchmarks attack -- [--only WORD] [--requests N] [--busy N]

A service continues a saved map and plays the bundled recording with the page, Foxglove and the pose socket on. Each
attack is carried out for real and its row says what happened; between two attacks a client with the token must still
get poses. Files are given to commands in processes of their own. What no client of a running service can show is shown
by other benchmarks and by tests, after it. The exit code is the number of rows that are not closed: what was open, and
what was not run because its tests are skipped here.
"""

from __future__ import annotations

import argparse
import http.client
import json
import os
import random
import re
import resource
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))

from stereo_sfm.service.outputs.door import UNREAD_S
from tests.service.hostile import frames, request, status

START_S = 600.0  # for the service to have a pose: kernels may be compiled, and the computer may be busy
STOP_S = 5.0
MOST_MB = 600  # of a command that reads a hostile file
HANG_S = 300.0  # by the clock: the computer may be busy, and a command has fifty seconds of processor time
BEARER = "Bearer "
TRACEBACK, MOST_SHOWN = "Traceback", 4000  # characters of one
PROCESSES = 8  # that a run starts: six stages, the fork server, and what frees shared memory
NOT_RUN, ALL_SKIPPED = "not run", 5  # pytest's exit code when a file is skipped whole, or holds no test
FULL_S = 10.0  # in which poses fill the buffer of a client that reads nothing; a busy computer has fewer poses a second
OUT_S = UNREAD_S + FULL_S  # that who has the token may be kept out by others who have it and read nothing
WATCHED_S = 30.0  # while somebody is kept out
DEMO = ROOT / "recordings" / "demo.mcap"

WRITER = """
import sys
from pathlib import Path
from stereo_sfm.log.writer import LogWriter
with LogWriter(Path(sys.argv[1])):
    sys.stdin.read()
"""  # another recording, until its input ends

Outcome = tuple[str, bool]  # what happened, whether the door is closed


@dataclass
class Target:
    """A running service."""

    folder: Path
    page: int
    foxglove: int
    poses: int
    requests: int
    process: subprocess.Popen[str] = field(repr=False)
    said: str = ""  # its log, when it has ended

    @property
    def token(self) -> str:
        return (self.folder / "state" / "stereo-sfm" / "token").read_text().strip()

    def ask(self, path: str, method: str = "GET", body: bytes | None = None, **headers: str) -> int:
        """The status of an answer of the page, 0 for none."""
        return self.tell(path, method, body, **headers)[0]

    def tell(self, path: str, method: str = "GET", body: bytes | None = None, **headers: str) -> tuple[int, str]:
        """Status and text of an answer of the page."""
        connection = http.client.HTTPConnection("127.0.0.1", self.page, timeout=10)
        try:
            connection.request(method, path, body, {name.replace("_", "-"): value for name, value in headers.items()})
            answer = connection.getresponse()
            return answer.status, answer.read(1 << 16).decode("utf-8", "replace")
        except OSError:
            return 0, ""
        finally:
            connection.close()

    def open_pose_socket(self, token: str = "") -> socket.socket:
        client = socket.create_connection(("127.0.0.1", self.poses), 10)
        if token:
            client.sendall(token.encode() + b"\n")
        return client

    def pose_within(self, seconds: float) -> float:
        """Seconds until a new client with the token has a pose; infinite when it gets none."""
        begin = time.monotonic()
        while time.monotonic() - begin < seconds:
            with suppress(OSError), self.open_pose_socket(self.token) as client:
                client.settimeout(max(seconds - (time.monotonic() - begin), 0.1))
                if client.makefile().readline():
                    return time.monotonic() - begin
            time.sleep(0.2)
        return float("inf")

    def upgrade(self, path: str = "/", **headers: str) -> int:
        """The status of a handshake with Foxglove's WebSocket, 101 where it succeeds."""
        given = {"Host": f"127.0.0.1:{self.foxglove}", **{k.replace("_", "-"): v for k, v in headers.items()}}
        fixed = {
            "Upgrade": "websocket", "Connection": "Upgrade", "Sec-WebSocket-Version": "13",
            "Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA==", "Sec-WebSocket-Protocol": "foxglove.websocket.v1",
        }  # fmt: skip
        lines = [f"GET {path} HTTP/1.1", *(f"{k}: {v}" for k, v in {**given, **fixed}.items()), "", ""]
        return status(self.foxglove, "\r\n".join(lines).encode(), False)


# -- attacks: each docstring is the attack's name in the table ---------------------------------------------------------


def foreign_page(t: Target) -> Outcome:
    """a page of another site commands through Foxglove's WebSocket"""
    own = {"Authorization": BEARER + t.token}
    found = [t.upgrade(Origin="https://evil.example", **own), t.upgrade(Host="evil.example", **own)]
    good = [t.upgrade(**own), t.upgrade(Origin="https://app.foxglove.dev", **own)]
    return f"foreign Origin, Host: {found}; own client, Foxglove: {good}", found == [403, 421] and good == [101, 101]


def without_a_token(t: Target) -> Outcome:
    """a local user without the token sees, stops, deletes"""
    json_ = {"Content_Type": "application/json", "X_Stereo_Sfm": "1"}
    codes = [t.ask(p) for p in ("/api/image.jpg", "/api/live", "/api/recordings")]
    codes += [t.ask("/api/command/stop_recording", "POST", b"{}", **json_), t.upgrade()]
    with t.open_pose_socket() as client:
        client.settimeout(7.0)
        poses = client.recv(1)
    return f"page and Foxglove: {sorted(set(codes))}; poses: {len(poses)} bytes", set(codes) == {401} and not poses


def files_of_others(t: Target) -> Outcome:
    """another user reads token, recordings, map"""
    readable = [p for p in t.folder.rglob("*") if p.is_file() and p.stat().st_mode & 0o007]
    count = sum(p.is_file() for p in t.folder.rglob("*"))
    return f"{len(readable)} of {count} files are readable by others", not readable and count > 3


def a_link_twice(t: Target) -> Outcome:
    """the printed link is used twice"""
    command = [sys.executable, "-m", "stereo_sfm.cli", "serve", *_settings(t), "--print-link"]
    link = subprocess.run(command, capture_output=True, text=True, env=_environment(t.folder), check=True).stdout
    body = json.dumps({"token": link.strip().partition("#")[2]}).encode()
    codes = [t.ask("/login", "POST", body, Content_Type="application/json") for _ in range(2)]
    return f"log-ins: {codes}", codes == [200, 401]


def idle_connections(t: Target) -> Outcome:
    """70 idle connections to the page"""
    with ExitStack() as idle:
        for _ in range(70):
            idle.enter_context(socket.create_connection(("127.0.0.1", t.page), 5))
        codes = Counter(t.ask("/api/map", Authorization=BEARER + t.token) for _ in range(10))
    return f"with the token: {dict(codes)}", codes[200] == 10


def silent_connections(t: Target) -> Outcome:
    """40 silent connections to the pose socket"""
    with ExitStack() as silent:
        for _ in range(40):
            silent.enter_context(socket.create_connection(("127.0.0.1", t.poses), 5))
        seconds = t.pose_within(10)
    return f"a client with the token has a pose after {seconds:.1f} s", seconds < 5


def slow_handshakes(t: Target) -> Outcome:
    """one byte a second keeps a handshake open"""
    took: list[float] = []
    for port in (t.page, t.foxglove, t.poses):
        begin = time.monotonic()
        with suppress(OSError), socket.create_connection(("127.0.0.1", port), 5) as client:
            while time.monotonic() - begin < 20:
                client.sendall(b"G")
                time.sleep(0.5)
        took.append(time.monotonic() - begin)
    return "closed after " + ", ".join(f"{s:.1f}" for s in took) + " s", max(took) < 8


def clients_that_never_read(t: Target) -> Outcome:
    """32 clients with the token never read"""
    with ExitStack() as held:
        for _ in range(32):
            client = socket.socket()
            client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
            client.connect(("127.0.0.1", t.poses))
            client.sendall(t.token.encode() + b"\n")
            held.enter_context(client)
        seconds = longest_wait(t, WATCHED_S)
    why = f"a buffer is full within {FULL_S:.0f} s, who then reads nothing is dropped after {UNREAD_S:.0f} s"
    return f"another one is kept out for {seconds:.1f} s at most, allowed are {OUT_S:.0f}: {why}", seconds <= OUT_S


def longest_wait(t: Target, watched_s: float) -> float:
    """The longest that a new client with the token waited for a pose, of one after the other."""
    until, waits = time.monotonic() + watched_s, [0.0]
    while time.monotonic() < until:
        waits.append(t.pose_within(2 * OUT_S))
        time.sleep(0.2)
    return max(waits)


def guesses(t: Target) -> Outcome:
    """tokens are guessed; the operator is logged in"""
    code, _ = t.tell("/login", "POST", json.dumps({"token": t.token}).encode(), Content_Type="application/json")
    answered = 0
    begin = time.monotonic()
    for k in range(200):
        answered += t.ask("/api/map", Authorization=f"{BEARER}guess number {k}") == 401
        body = json.dumps({"token": f"another guess {k}"}).encode()  # the same one again would not count as a guess
        answered += t.ask("/login", "POST", body, Content_Type="application/json") == 401
    seconds = time.monotonic() - begin
    time.sleep(3.0)  # all of this is one user
    again = t.ask("/api/map", Authorization=BEARER + t.token)
    text = f"{answered} of 400 looked at in {seconds:.0f} s; the token afterwards: {again}"
    return text, code == 200 and answered <= 6 + seconds and again == 200


def hostile_requests(t: Target) -> Outcome:
    """hostile requests and WebSocket messages"""
    rng = random.Random(1)
    ports = (t.page, t.foxglove)
    found = Counter(status(ports[k % 2], request(rng, ports[k % 2], t.token)) // 100 for k in range(t.requests))
    said = 0
    with suppress(ImportError, OSError):
        from websockets.exceptions import ConnectionClosed
        from websockets.sync.client import connect

        address = f"ws://127.0.0.1:{t.foxglove}/?token={t.token}"
        with connect(address, subprotocols=["foxglove.sdk.v1"], max_queue=None) as client, suppress(ConnectionClosed):  # type: ignore[list-item]
            for frame in frames(rng, t.requests // 4):
                client.send(frame)
                said += 1
    time.sleep(3.0)  # they guessed tokens, too, and all of this is one user
    alive = t.ask("/api/map", Authorization=BEARER + t.token)
    rows = ", ".join(f"{count} {kind}xx" if kind else f"{count} closed" for kind, count in sorted(found.items()))
    return f"{rows}; {said} messages; the page afterwards: {alive}", not found[5] and alive == 200


def a_map_over_recordings(t: Target) -> Outcome:
    """save_map writes into the recordings"""
    headers = {"Content_Type": "application/json", "X_Stereo_Sfm": "1", "Authorization": BEARER + t.token}
    _, text = t.tell("/api/command/save_map", "POST", b'{"name": "recordings"}', **headers)
    return json.loads(text)["text"][:80], not (t.folder / "recordings" / "map.json").exists()


def two_writers(t: Target) -> Outcome:
    """record --overwrite into a file that is being recorded"""
    file, demo = t.folder / "drive.mcap", ROOT / "recordings" / "demo.mcap"
    first = subprocess.Popen(
        [sys.executable, "-c", WRITER, str(file)], env=_environment(t.folder), stdin=subprocess.PIPE
    )
    while not file.exists() and first.poll() is None:
        time.sleep(0.01)
    command = [sys.executable, "-m", "stereo_sfm.cli", "record", str(demo), "-q", "--overwrite", "-o", str(file)]
    second = subprocess.run(command, env=_environment(t.folder), capture_output=True, text=True)
    first.communicate()
    said = second.stderr.strip().splitlines()[-1:] or [""]
    return f"exit code {second.returncode}: {said[0][-70:]}", second.returncode == 2 and "is writing" in said[0]


def hostile_files(t: Target) -> Outcome:
    """pipes, devices and bombs given to commands"""
    folder = t.folder / "files"
    folder.mkdir(exist_ok=True)
    pipe, zero, nested = folder / "pipe.mcap", folder / "zero.mcap", folder / "nested.toml"
    with suppress(FileExistsError):
        os.mkfifo(pipe)
        zero.symlink_to("/dev/zero")
    nested.write_text("a = " + "[" * 100_000)
    wrong, most = list[str](), 0.0
    commands = [
        ["recover", str(pipe), "-o", str(folder / "o.mcap")], ["info", str(pipe)], ["info", str(zero)],
        ["recover", str(zero), "-o", str(folder / "o.mcap")], ["run", str(zero)], ["run", "sim:loop", "-c", str(zero)],
        ["serve", "-c", str(nested), "--print-ports"], ["serve", "-c", str(pipe), "--print-ports"],
        ["convert-calib", str(zero), str(folder / "rig.yaml")], ["map", "info", str(pipe)],
    ]  # fmt: skip
    for command in commands:
        begin = time.monotonic()
        found = subprocess.Popen(
            [sys.executable, str(ROOT / "benchmarks" / "_peak.py"), *command], env=_environment(t.folder), text=True,
            stdout=subprocess.PIPE, stderr=subprocess.PIPE,
            preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_CPU, (50, 60)),
        )  # fmt: skip
        try:
            told, said = found.communicate(timeout=HANG_S)
        except subprocess.TimeoutExpired:
            found.kill()
            found.communicate()
            wrong.append(f"{command[0]} hangs")
            continue
        if found.returncode != 2 or "Traceback" in said:
            wrong.append(f"{command[0]}: exit code {found.returncode} after {time.monotonic() - begin:.0f} s")
        else:
            most = max(most, float(told.split()[-1]))
    wrong += [f"{most:.0f} MB"] if most > MOST_MB else []
    return "; ".join(wrong) or f"{len(commands)} commands, one line each, {most:.0f} MB at most", not wrong


def many_saves(t: Target) -> Outcome:
    """the joined map is saved by four clients again and again"""
    given = {"Content_Type": "application/json", "X_Stereo_Sfm": "1", "Authorization": BEARER + t.token}

    def save(_: int) -> tuple[float, bool, str]:
        begin = time.monotonic()
        code, said = t.tell("/api/command/save_map", "POST", b"{}", **given)
        reply = json.loads(said) if code == 200 else {"ok": False, "text": said or "no reply"}
        return time.monotonic() - begin, bool(reply["ok"]), str(reply["text"])

    with ThreadPoolExecutor(4) as pool:
        replies = list(pool.map(save, range(16)))
    saved, others = sum(ok for _, ok, _ in replies), sorted({text for _, ok, text in replies if not ok})
    slowest, joined = max(seconds for seconds, _, _ in replies), sessions(t.folder / "store")
    text = f"{saved} of {len(replies)} saved, the slowest in {slowest:.1f} s, {joined} sessions in the map"
    return " ".join([text, *others]), not others and joined > 1


def sessions(store: Path) -> int:
    """Sessions of a saved map, which a service may be replacing; 0 without one."""
    for _ in range(20):
        with suppress(OSError, ValueError):
            return json.loads((store / "map.json").read_text())["sessions"]
        time.sleep(0.1)
    return 0


def group_signal(t: Target) -> Outcome:
    """signals to the whole process group while another service starts"""
    slowest, wrong = 0.0, list[str]()
    moments = [(count, number) for count in (1, 3, 6, 9) for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)]
    for count, number in moments:
        with tempfile.TemporaryDirectory(prefix="attack") as name:
            other = Target(Path(name), _free_port(), _free_port(), _free_port(), 0, t.process)
            command = [sys.executable, "-m", "stereo_sfm.cli", "serve", str(DEMO), *_settings(other)]
            process = subprocess.Popen(
                command, env=_environment(other.folder), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
                process_group=0,
            )  # fmt: skip
            until = time.monotonic() + START_S
            while len(_group(process.pid)) <= count and process.poll() is None and time.monotonic() < until:
                time.sleep(0.01)
            begin = time.monotonic()
            os.killpg(process.pid, number)
            try:
                said = process.communicate(timeout=60)[0]
            except subprocess.TimeoutExpired:
                wrong.append(f"{number.name} after {count} processes: hangs")
                os.killpg(process.pid, signal.SIGKILL)
                said = process.communicate()[0]
            slowest = max(slowest, time.monotonic() - begin)
            time.sleep(1.0)  # a process that reads the end of a pipe ends
            left = len(_group(process.pid))
            if "ended (exit code" in said or "Traceback" in said or left:
                wrong.append(f"{number.name} after {count} processes: {left} left, {said.strip()[-80:]}")
    return (
        f"{len(moments)} signals, the slowest end {slowest:.1f} s {'; '.join(wrong)}",
        slowest <= STOP_S and not wrong,
    )


def stopped_processes(t: Target) -> Outcome:
    """a process of a run is stopped or killed while it starts"""
    slowest, wrong = 0.0, list[str]()
    for number in (signal.SIGSTOP, signal.SIGTERM):
        for k in range(PROCESSES):
            with tempfile.TemporaryDirectory(prefix="attack") as name:
                process = subprocess.Popen(
                    [sys.executable, "-m", "stereo_sfm.cli", "run", str(DEMO), "--speed", "0.5", "-o", f"{name}/run"],
                    env=_environment(Path(name)), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
                    process_group=0,
                )  # fmt: skip
                until, count = time.monotonic() + START_S, min(k + 4, 1 + PROCESSES)
                while len(_group(process.pid)) < count and process.poll() is None and time.monotonic() < until:
                    time.sleep(0.01)
                found = sorted(set(_group(process.pid)) - {process.pid})
                if k < len(found):
                    os.kill(found[k], number)
                time.sleep(2.0)
                begin = time.monotonic()
                process.send_signal(signal.SIGTERM)
                try:
                    said = process.communicate(timeout=60)[0]
                except subprocess.TimeoutExpired:
                    os.killpg(process.pid, signal.SIGKILL)
                    said = process.communicate()[0] + "hangs: Traceback"
                slowest = max(slowest, time.monotonic() - begin)
                if "Traceback" in said:
                    wrong.append(f"{number.name} of process {k}: {said.strip()[-80:]}")
    text = f"{2 * PROCESSES} processes, the slowest end {slowest:.1f} s {'; '.join(wrong)}"
    return text, not wrong and slowest <= 2 * STOP_S


def _group(leader: int) -> list[int]:
    """The processes of a group that are not only waited for."""
    found: list[int] = []
    for place in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            state, _, group = place.read_text().rpartition(")")[2].split()[:3]
            if int(group) == leader and state != "Z":
                found.append(int(place.parent.name))
    return found


ATTACKS: tuple[tuple[int, Callable[[Target], Outcome]], ...] = (
    (1, foreign_page), (2, without_a_token), (2, a_link_twice), (3, idle_connections), (3, silent_connections),
    (3, slow_handshakes), (3, clients_that_never_read), (3, guesses), (4, hostile_requests),
    (14, a_map_over_recordings), (2, files_of_others), (6, two_writers), (14, hostile_files), (7, many_saves),
    (9, group_signal), (9, stopped_processes),
)  # fmt: skip
# Numbers are those of the list of what was open once. The tables below have what no client of a running service shows.

PROGRAMS = (
    (7, "processor time of a save that joins a session", "benchmarks/_saves.py"),
    (7, "SIGTERM beside busy loops", "benchmarks/ends.py --count 3 --busy 8"),
    (8, "stages are killed beside busy loops", "benchmarks/kills.py --count 5 --busy 8"),
    (15, "python -m benchmarks --help", "-m benchmarks --help"),
    (18, "the documentation cannot be built", "-m mkdocs build --strict -q -d {folder}/site"),
)

TESTED = (
    (4, "pages and sockets are given anything", "service/test_hostile_requests.py"),
    (5, "DDS listens on every network and nothing says so", "service/test_page.py::test_what_is_open_is_listed"),
    (6, "a file that is being written is replaced", "log/test_whole_file.py"),
    (8, "poses wait for the map after a restart, a standby is dead", "pipeline/test_standby.py"),
    (10, "the folder of recordings is deleted, the disk is full", """
        recording/test_segments.py::test_a_folder_that_is_deleted_is_made_again
        recording/test_segments.py::test_the_reason_of_a_disk_that_refuses_is_a_sentence
        recording/test_segments.py::test_a_full_disk_costs_images_and_no_pose
        recording/test_segments.py::test_marks_of_the_service_age_and_leave_room"""),
    (11, "an output leaves shared memory",
     "service/test_stop.py::test_shared_memory_of_dds_that_nobody_uses_is_removed"),
    (12, "a tilted camera's pose climbs on a flat floor", "service/test_robot_mounting.py"),
    (13, "poses age where a source cannot keep its rate", """
        service/test_parts.py::test_a_recording_that_is_slower_than_its_stamps_does_not_age
        service/test_parts.py::test_the_sensors_clock_is_that_of_the_fastest_image
        service/test_parts.py::test_a_camera_that_does_not_keep_its_rate_does_not_age"""),
    (14, "hostile files are read", "commands/test_hostile_files.py test_input_files.py"),
    (14, "mutated files of every format are read", "fuzz"),
    (15, "a source or a folder is not what everybody types", """
        service/test_page.py::test_a_source_is_an_argument_of_serve
        commands/test_bad_input.py::test_a_folder_named_like_a_kind_is_the_folder"""),
    (16, "a slow source or a busy computer is a loss", """
        service/test_parts.py::test_a_slow_source_and_a_busy_computer_are_no_loss
        service/test_parts.py::test_the_most_severe_problem_is_the_state
        recording/test_segments.py::test_marks_keep_what_lies_around"""),
    (17, "missing pairs change a right calibration", "pipeline/test_missing_pairs.py"),
    (19, "two runs are not compared", "eval/test_reports.py::test_two_runs_differ_as_a_table"),
    (20, "info finds no problem where there is one", """
        commands/test_first_day.py::test_info_finds_an_inverted_extrinsic
        commands/test_first_day.py::test_info_finds_damaged_images
        commands/test_first_day.py::test_info_lists_what_readers_warn_about
        commands/test_first_day.py::test_info_says_that_the_baseline_is_not_checked"""),
    (21, "a mistyped folder is taken for a camera", """
        commands/test_first_day.py::test_a_mistyped_folder_is_named_once
        commands/test_bad_input.py::test_a_mistyped_folder_is_no_camera"""),
    (22, "a report begins with compiling and no verdict", """
        eval/test_reports.py::test_a_report_begins_with_one_sentence_and_the_picture
        eval/test_reports.py::test_pass_is_more_than_poses
        eval/test_reports.py::test_compiling_is_no_time_of_a_stage"""),
    (23, "words on the screen are in no document", """
        commands/test_first_day.py::test_terms_on_the_screen_are_in_the_glossary
        commands/test_first_day.py::test_equations_of_a_thesis_are_no_row_of_eval
        drivers/test_registry.py::test_options_of_the_simulated_t265_are_not_the_cameras"""),
    (24, "programs cannot read the tables of batch", """
        eval/test_batch.py::test_names_are_unique
        eval/test_batch.py::test_every_column_is_documented
        eval/test_reports.py::test_tables_have_empty_cells_for_what_is_missing"""),
    (25, "messages of the service do not help", """
        service/test_commands.py service/test_link.py::test_a_taken_port_is_tried_again
        commands/test_first_day.py::test_a_full_disk_names_the_settings_that_help
        maps/test_update.py::test_labels_and_plans_while_a_service_extends_the_map
        test_examples.py"""),
    (26, "a point that is seen once spoils a COLMAP export",
     "export/test_exports.py::test_a_point_that_is_seen_once_is_left_out"),
    (27, "faults while something else runs", "service/test_service_faults.py service/test_soak.py"),
)  # fmt: skip


def pytest_said(code: int, said: str) -> Outcome:
    """What tests show, by exit code and output of `pytest -rs`: a skipped one shows nothing, with exit code 0."""
    skipped = sorted(set(re.findall(r"^SKIPPED \[\d+\] [^ ]+ (.*)", said, re.M)))
    if code not in (0, ALL_SKIPPED):
        return said[-MOST_SHOWN:], False
    summary = said.strip().splitlines()[-1]
    return (f"{NOT_RUN}: skipped ({'; '.join(skipped)}); {summary}", False) if skipped else (summary, not code)


def run_tests(tests: str) -> Outcome:
    """Places in tests/, with spaces between them; slow ones, too."""
    places = [f"tests/{place}" for place in tests.split()]
    command = [sys.executable, "-m", "pytest", "-rs", "-n", "0", "-m", "", *places]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    return pytest_said(run.returncode, run.stderr + run.stdout)


def run_program(arguments: str) -> Outcome:
    """Another program of ours, which is closed by its exit code; of its output, the lines that are not indented."""
    with tempfile.TemporaryDirectory(prefix="attack") as folder:
        command = [sys.executable, *(word.format(folder=folder) for word in arguments.split())]
        run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    said = [line for line in run.stdout.splitlines() if line and not line.startswith(" ")]
    return "; ".join(said[-3:]) if not run.returncode else (run.stdout + run.stderr)[-MOST_SHOWN:], not run.returncode


# -- the service -------------------------------------------------------------------------------------------------------


def _environment(folder: Path) -> dict[str, str]:
    path = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
    return {**os.environ, "XDG_STATE_HOME": str(folder / "state"), "PYTHONPATH": path}


def _settings(t: Target) -> list[str]:
    return [
        word
        for text in (
            f"page.enabled=true,page.port={t.page},outputs.foxglove.enabled=true,outputs.foxglove.port={t.foxglove},"
            f"outputs.pose_socket.enabled=true,outputs.pose_socket.address=tcp://127.0.0.1:{t.poses},"
            f"map.folder={t.folder / 'store'},recording.folder={t.folder / 'recordings'},recording.mode=full,"
            "source.repeat=true,map.save_every_min=0.2"
        ).split(",")
        for word in ("--set", text)
    ]


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@contextmanager
def running(requests: int, folder: Path | None = None) -> Generator[Target]:
    """A service that plays the bundled recording again and again. Args: folder, of its map, which it continues."""
    with ExitStack() as beside:
        folder = folder or Path(beside.enter_context(tempfile.TemporaryDirectory(prefix="attack")))
        folder.mkdir(exist_ok=True)
        target = Target(folder, _free_port(), _free_port(), _free_port(), requests, None)  # type: ignore[arg-type]
        source = str(DEMO)
        with (folder.with_name(f"{folder.name}.log")).open("w+") as log:
            target.process = subprocess.Popen(
                [sys.executable, "-m", "stereo_sfm.cli", "serve", source, *_settings(target)],
                env=_environment(folder), stdout=log, stderr=subprocess.STDOUT, text=True,
            )  # fmt: skip
            try:
                while not (folder / "state" / "stereo-sfm" / "token").exists() and target.process.poll() is None:
                    time.sleep(0.1)
                if target.pose_within(START_S) > START_S:
                    raise SystemExit("the service has no poses")
                yield target
            finally:
                target.process.kill()
                target.process.wait()
                log.seek(0)
                target.said = log.read()
                Path(log.name).unlink()


def first_map(store: Path) -> None:
    """Save a map of the bundled recording, which a service then continues; as the service does it, not for others."""
    with tempfile.TemporaryDirectory(prefix="attack") as name:
        command = [sys.executable, "-m", "stereo_sfm.cli", "run", str(DEMO), "-q", "--log", "none", "-o", f"{name}/run"]
        command += ["--map-out", str(store)]
        subprocess.run(command, env=_environment(Path(name)), stdout=subprocess.DEVNULL, check=True, umask=0o027)


class Table:
    """Rows are printed as they come."""

    def __init__(self) -> None:
        self.open = 0  # rows that are not closed

    def row(self, item: int, name: str, what: str, closed: bool) -> None:
        """Args: item, its number in the list. what, happened."""
        self.open += not closed
        state = "closed" if closed else NOT_RUN if what.startswith(NOT_RUN) else "OPEN"
        print(f"{item:3}  {name:58}  {state:7}  {what}", flush=True)


def attack_a_service(
    table: Table, attacks: Sequence[tuple[int, Callable[[Target], Outcome]]], requests: int, busy: int
) -> None:
    """Carry out attacks on a service that continues a saved map; then it is ended."""
    with ExitStack() as beside:
        folder = Path(beside.enter_context(tempfile.TemporaryDirectory(prefix="attack"))) / "service"
        folder.mkdir()
        first_map(folder / "store")
        target = beside.enter_context(running(requests, folder))
        for _ in range(busy):
            loop = subprocess.Popen([sys.executable, "-c", "while True: pass"])
            beside.callback(loop.kill)
        for item, attack in attacks:
            table.row(item, named(attack), *attack(target))
            if (seconds := target.pose_within(30)) > 10:
                table.row(item, "  afterwards", f"the next client has a pose after {seconds:.0f} s", False)
        begin = time.monotonic()
        target.process.send_signal(signal.SIGTERM)
        with suppress(subprocess.TimeoutExpired):
            target.process.wait(3 * STOP_S)
        seconds, count = time.monotonic() - begin, sessions(folder / "store")
        table.row(7, "SIGTERM afterwards", f"{seconds:.1f} s, {count} sessions in the saved map",
                  seconds <= STOP_S and count > 1)  # fmt: skip
    found = target.said.count(TRACEBACK)
    table.row(4, "the service's log", f"{found} tracebacks", not found)
    for text in target.said.split(TRACEBACK)[1:]:
        print(f"{TRACEBACK}{text[:MOST_SHOWN]}")


def named(attack: Callable[[Target], Outcome]) -> str:
    """Its name in the table."""
    return (attack.__doc__ or attack.__name__).strip()


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", metavar="WORD", help="rows whose name has this word")
    parser.add_argument("--requests", type=int, default=2000, metavar="N", help="hostile requests")
    parser.add_argument("--busy", type=int, default=0, metavar="N", help="busy loops beside the service")
    args = parser.parse_args()
    signal.signal(signal.SIGHUP, signal.SIG_DFL)  # under nohup a service would ignore it, as it should
    table = Table()
    attacks = [(item, attack) for item, attack in ATTACKS if args.only in named(attack)]
    if attacks:
        attack_a_service(table, attacks, args.requests, args.busy)
    for rows, run in ((PROGRAMS, run_program), (TESTED, run_tests)):
        for item, name, what in rows:
            if args.only in name:
                table.row(item, name, *run(what))
    print(f"{table.open} rows are not closed")
    return table.open


if __name__ == "__main__":
    sys.exit(main())
