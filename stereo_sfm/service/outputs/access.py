"""Who may connect: this computer only, or others with a token and, where there is a certificate, encrypted."""

from __future__ import annotations

import hmac
import ipaddress
import ssl
from dataclasses import dataclass
from pathlib import Path

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.service.outputs.settings import SecurityConfig

LEAST_TOKEN = 16  # characters
MOST_TOKEN = 4096


@dataclass(frozen=True)
class Access:
    """What a client needs to connect to a port."""

    token: str = ""  # "": none
    tls: ssl.SSLContext | None = None

    def allows(self, token: str) -> bool:
        """Whether this is the token; compared in constant time."""
        return not self.token or hmac.compare_digest(token.encode(), self.token.encode())


def is_loopback(address: str) -> bool:
    """Whether only this computer can reach an address."""
    try:
        return address == "localhost" or ipaddress.ip_address(address).is_loopback
    except ValueError:
        return False


def access(security: SecurityConfig, address: str) -> Access:
    """The rules for a port on an address: nothing on the loopback, a token beyond it.

    Raises:
        StereoSfmError: no token for an address beyond this computer, or a token or certificate that cannot be read.
    """
    if is_loopback(address):
        return Access()
    if not security.token_file:
        raise StereoSfmError(f"others could connect to {address}: name a file with a token (security.token_file)")
    return Access(_token(Path(security.token_file)), _tls(security))


def _token(path: Path) -> str:
    try:
        with path.open(encoding="ascii") as file:
            token = file.read(MOST_TOKEN + 1).strip()
    except (OSError, ValueError):
        raise StereoSfmError(f"cannot read the token in {path}") from None
    if not LEAST_TOKEN <= len(token) <= MOST_TOKEN or not token.isprintable():
        raise StereoSfmError(f"{path}: a token is one line of at least {LEAST_TOKEN} characters")
    return token


def _tls(security: SecurityConfig) -> ssl.SSLContext | None:
    if not security.tls_cert:
        return None
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    try:
        context.load_cert_chain(security.tls_cert, security.tls_key or None)
    except (OSError, ssl.SSLError) as error:
        raise StereoSfmError(f"cannot use the certificate {security.tls_cert}: {error}") from None
    return context
