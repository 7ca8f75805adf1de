"""Who may use a port: the token, links to the page, guessing, and the names of peers."""

from __future__ import annotations

import os
import socket
import stat
from contextlib import suppress
from pathlib import Path

import pytest

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.service.config import RobotConfig
from stereo_sfm.service.outputs.access import (
    MOST_PEERS,
    MOST_REFUSED,
    WRONG_A_SECOND,
    WRONG_AT_ONCE,
    Access,
    Attempts,
    Links,
    TooManyAttempts,
    access,
    is_loopback,
    page_link,
    token_file,
)
from stereo_sfm.service.outputs.peers import peer
from stereo_sfm.service.outputs.settings import PageConfig, SecurityConfig

TOKEN = "a-token-of-thirty-two-characters"


class Clock:
    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        return self.now


def test_a_token_is_made_where_none_is_configured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    first, second = access(SecurityConfig(), "127.0.0.1"), access(SecurityConfig(), "0.0.0.0")
    file = tmp_path / "stereo-sfm" / "token"
    assert first.token == second.token == file.read_text().strip() and len(first.token) >= 32
    assert stat.S_IMODE(file.stat().st_mode) == 0o600 and list(file.parent.iterdir()) == [file]
    assert token_file(SecurityConfig()) == file
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "of-another-user"))
    assert access(SecurityConfig(), "::1").token != first.token


def test_everybody_is_let_in_by_choice_and_on_this_computer_only() -> None:
    assert access(SecurityConfig(auth="none"), "127.0.0.1") == Access()
    with pytest.raises(StereoSfmError, match=r"others could connect to 0\.0\.0\.0"):
        access(SecurityConfig(auth="none"), "0.0.0.0")
    assert is_loopback("localhost") and not is_loopback("0.0.0.0") and not is_loopback("robot.example")


def test_a_bad_token_file_is_one_line(tmp_path: Path) -> None:
    file, pipe = tmp_path / "token", tmp_path / "pipe"
    os.mkfifo(pipe, 0o600)
    file.write_text(TOKEN + "\n")
    for mode, why in ((0o604, "everyone on this computer"), (0o640, ""), (0o600, "")):
        file.chmod(mode)
        if why:
            with pytest.raises(StereoSfmError, match=why):
                access(SecurityConfig(str(file)), "10.0.0.1")
        else:
            assert access(SecurityConfig(str(file)), "10.0.0.1").token == TOKEN
    file.write_text("short")
    for path, why in ((file, "at least 16 characters"), (pipe, "at least 16"), (tmp_path / "none", "cannot read")):
        with pytest.raises(StereoSfmError, match=why):
            access(SecurityConfig(str(path)), "127.0.0.1")


def test_a_link_allows_one_log_in_in_ten_minutes() -> None:
    clock = Clock()
    links, other = Links(TOKEN, clock), Links(TOKEN + "x", clock)
    code = links.new()
    assert TOKEN not in code and not other.take(code)
    assert links.take(code) and not links.take(code)
    late, forged = links.new(), links.new().replace("once-", "once-f")
    clock.now += 601
    for wrong in (late, forged, "once-1-2-3", "once--\udc80-a-b", "", "once-" + "9" * 5000 + "-a-b"):
        assert not links.take(wrong)


def test_a_link_that_was_used_stays_so_after_a_restart(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    clock, folder = Clock(), tmp_path / "state" / "used"
    links = [Links(TOKEN, clock, folder) for _ in range(3)]
    code, waiting = links[0].new(), links[0].new()
    assert links[0].take(code) and not links[1].take(code)
    assert links[1].take(waiting) and not links[2].take(waiting)  # printed before the restart, used after it
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700 and len(list(folder.iterdir())) == 2
    assert not any(part in file.name for file in folder.iterdir() for part in (code, waiting, TOKEN))
    clock.now += 601
    late = links[2].new()
    assert links[2].take(late) and len(list(folder.iterdir())) == 1  # what is over needs no file
    clock.now -= 500  # set back
    assert not links[1].take(late)
    full = Links(TOKEN, clock, Path("/proc/nowhere"))
    code = full.new()
    assert full.take(code) and not full.take(code) and "may log in again after a restart" in caplog.text


def test_the_link_to_the_page_has_a_code(tmp_path: Path) -> None:
    file = tmp_path / "token"
    file.write_text(TOKEN)
    file.chmod(0o600)
    link = page_link(RobotConfig(page=PageConfig(True, "0.0.0.0"), security=SecurityConfig(str(file))))
    place, _, code = link.partition("#")
    assert place == "http://127.0.0.1:8080/" and TOKEN not in link and Links(TOKEN).take(code)
    config = RobotConfig(page=PageConfig(True, "::1"), security=SecurityConfig(auth="none"))
    assert page_link(config) == "http://[::1]:8080/"


def test_who_guesses_waits_and_nobody_else() -> None:
    clock = Clock()
    rules = Access(TOKEN, None, Attempts(clock))
    assert not any(rules.allows(f"guess {i}", "mallory") for i in range(WRONG_AT_ONCE))
    for text in (TOKEN, "another"):  # the right one would be found, too, if it were looked at
        with pytest.raises(TooManyAttempts):
            rules.allows(text, "mallory")
    assert not rules.allows("", "mallory")  # nothing is guessed by sending nothing
    assert all(rules.allows(TOKEN, "operator") for _ in range(50))
    clock.now += 2.0
    assert rules.allows(TOKEN, "mallory")
    assert not rules.allows("\ud800", "operator") and not rules.allows("é", "operator")  # any text at all


def test_a_client_that_repeats_an_old_token_keeps_nobody_out() -> None:
    clock = Clock()
    rules, late = Access(TOKEN, None, Attempts(clock)), 0
    for _ in range(600):
        for old in ("a token of yesterday", "a token of the day before"):
            with suppress(TooManyAttempts):
                assert not rules.allows(old, "operator")
        assert rules.allows(TOKEN, "operator")
        clock.now += 0.5
    for _ in range(20):
        try:
            rules.allows("a token of yesterday", "operator")
        except TooManyAttempts:
            late += 1
    assert late >= 20 - WRONG_AT_ONCE  # who floods waits
    assert rules.allows(TOKEN, "operator")


def test_tokens_sent_twice_are_guessed_no_faster() -> None:
    """Neither repeats nor old guesses buy another look at a token."""
    clock, looks = Clock(), set[str]()
    attempts = Attempts(clock)

    def guess(text: str) -> None:
        def right() -> bool:
            looks.add(text)
            return False

        with suppress(TooManyAttempts):
            attempts.check("mallory", right, text.encode())

    for i in range(200):
        for text in (f"guess {i}", f"guess {i}", f"guess {i - 1}", f"guess {i // 2}"):
            guess(text)
        clock.now += 0.5
    assert len(looks) <= WRONG_AT_ONCE + 200 * 0.5 * WRONG_A_SECOND
    (guesser,) = attempts._buckets.values()  # pyright: ignore[reportPrivateUsage]
    assert len(guesser._refused) <= MOST_REFUSED  # pyright: ignore[reportPrivateUsage]


def test_peers_that_guess_are_remembered_within_bounds() -> None:
    attempts = Attempts(Clock())
    for i in range(MOST_PEERS + 50):
        attempts.check(f"peer {i}", lambda: False)
    assert len(attempts._buckets) == MOST_PEERS  # pyright: ignore[reportPrivateUsage]


def test_a_peer_is_an_address_or_a_user_of_this_computer(tmp_path: Path) -> None:
    for family, address in ((socket.AF_INET, "127.0.0.1"), (socket.AF_INET6, "::1")):
        try:
            server = socket.create_server((address, 0), family=family)
        except OSError:
            continue
        with server, socket.create_connection(server.getsockname()[:2]) as client:
            connection, _ = server.accept()
            with connection:
                assert peer(connection) == peer(client) == f"user {os.getuid()}"
    place = str(tmp_path / "socket")
    with socket.socket(socket.AF_UNIX) as server, socket.socket(socket.AF_UNIX) as client:
        server.bind(place)
        server.listen()
        client.connect(place)
        with server.accept()[0] as connection:
            assert peer(connection) == f"user {os.getuid()}"


class _Elsewhere:
    """A connection from another computer, as far as `peer` looks at it."""

    family = socket.AF_INET6

    def __init__(self, address: str) -> None:
        self._address = address

    def getpeername(self) -> tuple[str, int]:
        return self._address, 1234


def test_a_network_of_ipv6_is_one_peer() -> None:
    names = [peer(_Elsewhere(address)) for address in ("2001:db8::1", "2001:db8::ffff:1", "2001:db8:0:1::1")]  # type: ignore[arg-type]
    assert names[0] == names[1] != names[2]
    assert peer(_Elsewhere("::ffff:10.0.0.7")) == "10.0.0.7"  # type: ignore[arg-type]
