"""Who may use a port: whoever has the token; everyone on this computer only where the configuration says so."""

from __future__ import annotations

import contextlib
import hashlib
import hmac
import ipaddress
import logging
import os
import secrets
import ssl
import stat
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.input_file import open_regular
from stereo_sfm.service.outputs.settings import SecurityConfig
from stereo_sfm.storage.folders import state_root

if TYPE_CHECKING:
    from stereo_sfm.service.config import RobotConfig

log = logging.getLogger("stereo_sfm")

LEAST_TOKEN = 16  # characters
MOST_TOKEN = 4096
WRONG_A_SECOND, WRONG_AT_ONCE = 0.5, 5  # wrong tokens of one peer before it has to wait
MOST_PEERS = 1024  # whose wrong tokens are counted
MOST_REFUSED = 8  # wrong tokens of one peer that are remembered
LINK_S = 600.0  # that a link may wait for its log-in


class TooManyAttempts(StereoSfmError):
    """A peer has sent too many wrong tokens and has to wait."""


class Bucket:
    """Lets `rate` a second through, and `burst` at once."""

    def __init__(self, rate: float, burst: int, clock: Callable[[], float] = time.monotonic) -> None:
        self._rate, self._burst, self._clock = rate, burst, clock
        self._left, self._at = float(burst), clock()

    @property
    def left(self) -> float:
        """How many may pass now."""
        now = self._clock()
        self._left, self._at = min(self._burst, self._left + (now - self._at) * self._rate), now
        return self._left

    def take(self) -> bool:
        """Whether one more may pass now."""
        if self.left < 1:
            return False
        self._left -= 1
        return True


class _Guesser:
    """What one peer has sent wrongly. A token that it repeats is no other guess: it counts for itself."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._guesses = Bucket(WRONG_A_SECOND, WRONG_AT_ONCE, clock)
        self._refused: OrderedDict[bytes, Bucket] = OrderedDict()  # by hash: nobody reads a token here

    def has_to_wait(self, sent: bytes) -> bool:
        """Whether this token is not looked at now."""
        again = self._refused.get(sent)
        return self._guesses.left < 1 if again is None else again.left < 1

    def refuse(self, sent: bytes) -> None:
        """It was wrong."""
        (self._refused.get(sent) or self._guesses).take()
        if sent not in self._refused:
            self._refused[sent] = Bucket(WRONG_A_SECOND, WRONG_AT_ONCE, self._clock)
            while len(self._refused) > MOST_REFUSED:
                self._refused.popitem(last=False)


class Attempts:
    """Wrong tokens by peer: one that guesses makes itself wait, and no other.

    A client that repeats an old token makes nobody wait but itself.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._buckets: OrderedDict[str, _Guesser] = OrderedDict()
        self._lock = threading.Lock()

    def check(self, peer: str, right: Callable[[], bool], sent: bytes = b"") -> bool:
        """Whether a token is right.

        Args: peer, who sent it. right: compares it. sent: it.

        Raises:
            TooManyAttempts: the peer has to wait; its token is not looked at.
        """
        name = hashlib.sha256(sent).digest()
        with self._lock:
            guesser = self._buckets.get(peer)
            if guesser is not None and guesser.has_to_wait(name):
                raise TooManyAttempts("too many attempts: wait a moment")
            if right():
                return True
            self._buckets.setdefault(peer, _Guesser(self._clock)).refuse(name)
            self._buckets.move_to_end(peer)
            while len(self._buckets) > MOST_PEERS:
                self._buckets.popitem(last=False)
        return False


@dataclass(frozen=True)
class Access:
    """What a client needs to use a port."""

    token: str = ""  # "": nothing
    tls: ssl.SSLContext | None = None
    _attempts: Attempts = field(default_factory=Attempts, compare=False, repr=False)

    def allows(self, token: str, peer: str) -> bool:
        """Whether this is the token; compared in constant time.

        Args: token, any text that a client sent. peer: who sent it.

        Raises:
            TooManyAttempts: this peer has to wait.
        """
        if not self.token or not token:  # who sends none does not guess
            return not self.token
        sent = token.encode("utf-8", "surrogatepass")
        return self._attempts.check(peer, lambda: hmac.compare_digest(sent, self.token.encode()), sent)


class Links:
    """Codes in links to the page, made from the token: each allows one log-in, within ten minutes."""

    def __init__(self, token: str, clock: Callable[[], float] = time.time, kept: Path | None = None) -> None:
        """Args:
        clock: Unix time: another process makes the codes.
        kept: folder that remembers those used after this process; without it, they are remembered here only.
        """
        self._key, self._clock, self._kept = token.encode(), clock, kept
        self._used: dict[str, float] = {}  # until when they would be valid

    def new(self) -> str:
        """Another code."""
        until, name = f"{int(self._clock() + LINK_S):x}", secrets.token_hex(8)
        return f"once-{until}-{name}-{self._signature(until, name)}"

    def take(self, code: str) -> bool:
        """Whether a code is valid; it is not, the next time."""
        parts = code.split("-")
        if len(parts) != 4 or parts[0] != "once":
            return False
        signature = self._signature(parts[1], parts[2])
        if not hmac.compare_digest(parts[3].encode("utf-8", "surrogatepass"), signature.encode()):
            return False
        now, until = self._clock(), float(int(parts[1], 16))
        self._used = {name: end for name, end in self._used.items() if end > now}
        if until <= now or parts[2] in self._used or self._was_used(signature, until):
            return False
        self._used[parts[2]] = until
        return True

    def _was_used(self, name: str, until: float) -> bool:
        """Whether a file says so; else one does from now on, where it can be written."""
        if self._kept is None:
            return False
        try:
            self._kept.mkdir(parents=True, exist_ok=True, mode=0o700)
            (self._kept / name).touch(0o600, exist_ok=False)
            os.utime(self._kept / name, (until, until))
        except FileExistsError:
            return True
        except OSError as error:  # a full disk must not keep the operator out
            log.warning("a used link may log in again after a restart: %s: %s", self._kept, error.strerror)
            return False
        with contextlib.suppress(OSError):
            for file in self._kept.iterdir():
                if file.stat().st_mtime <= self._clock():
                    file.unlink()
        return False

    def _signature(self, until: str, name: str) -> str:
        text = f"once-{until}-{name}".encode("utf-8", "surrogatepass")
        return hmac.new(self._key, text, hashlib.sha256).hexdigest()


def is_loopback(address: str) -> bool:
    """Whether only this computer can reach an address."""
    try:
        return address == "localhost" or ipaddress.ip_address(address).is_loopback
    except ValueError:
        return False


def access(security: SecurityConfig, address: str) -> Access:
    """The rules for a port on an address. The token is made where none is configured.

    Raises:
        StereoSfmError: no token although others could connect, or a token or certificate that cannot be used.
    """
    if security.auth == "none":
        if not is_loopback(address):
            raise StereoSfmError(f'others could connect to {address}: security.auth = "none" is for 127.0.0.1 only')
        return Access()
    return Access(token(security), None if is_loopback(address) else _tls(security))


def token(security: SecurityConfig) -> str:
    """The token that clients must send.

    Raises:
        StereoSfmError: it cannot be read or made, others can read it, or it is too short.
    """
    if security.token_file:
        return _read(Path(security.token_file))
    path = token_file(security)
    if not path.exists():
        _make(path)
    return _read(path)


def token_file(security: SecurityConfig) -> Path:
    """Where the token is: as configured, else in the folder for the state of the service's user."""
    if security.token_file:
        return Path(security.token_file)
    folder = _state()
    if folder is None:
        raise StereoSfmError("this user has no home folder: set security.token_file")
    return folder / "token"


def used_links() -> Path | None:
    """Where `Links` may remember the codes that were used; None: this user has no home folder."""
    folder = _state()
    return None if folder is None else folder / "used-links"


def page_link(config: RobotConfig) -> str:
    """The address of the page, with a code for one log-in.

    Raises:
        StereoSfmError: as `access`.
    """
    page, rules = config.page, access(config.security, config.page.address)
    host = "127.0.0.1" if page.address in ("0.0.0.0", "::") else page.address
    host = f"[{host}]" if ":" in host else host
    code = f"#{Links(rules.token).new()}" if rules.token else ""
    return f"http{'s' if rules.tls is not None else ''}://{host}:{page.port}/{code}"


def _state() -> Path | None:
    """The folder for the state of this user; None: it has no home folder."""
    with contextlib.suppress(RuntimeError):
        return state_root()
    return None


def _make(path: Path) -> None:
    """A new token that only this user can read. Of two processes that do this at once, one wins."""
    part = path.with_name(f"{path.name}.{secrets.token_hex(4)}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        with os.fdopen(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
            file.write(secrets.token_urlsafe(32) + "\n")
        with contextlib.suppress(FileExistsError):
            os.link(part, path)
    except OSError as error:
        raise StereoSfmError(
            f"cannot make a token in {path}: {error.strerror}; name another file (security.token_file)"
        ) from None
    finally:
        part.unlink(missing_ok=True)


def _read(path: Path) -> str:
    try:
        with os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK), encoding="ascii") as file:
            mode = os.fstat(file.fileno()).st_mode
            text = file.read(MOST_TOKEN + 1).strip() if stat.S_ISREG(mode) else ""
    except (OSError, ValueError) as error:
        why = error.strerror if isinstance(error, OSError) else "it is not plain text"
        raise StereoSfmError(
            f"cannot read the token in {path}: {why}; name another file (security.token_file)"
        ) from None
    if mode & stat.S_IRWXO:
        raise StereoSfmError(f"{path}: everyone on this computer can use this token: chmod 640 {path}")
    if not LEAST_TOKEN <= len(text) <= MOST_TOKEN or not text.isprintable():
        raise StereoSfmError(f"{path}: a token is one line of at least {LEAST_TOKEN} characters")
    return text


def _tls(security: SecurityConfig) -> ssl.SSLContext | None:
    if not security.tls_cert:
        return None
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    try:
        for file in filter(None, (security.tls_cert, security.tls_key)):
            open_regular(Path(file)).close()  # a pipe would hold up whoever reads it
        context.load_cert_chain(security.tls_cert, security.tls_key or None)
    except (OSError, ssl.SSLError) as error:
        raise StereoSfmError(f"cannot use the certificate {security.tls_cert}: {error}") from None
    return context
