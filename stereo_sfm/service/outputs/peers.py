"""Who is at the other end of a connection: an address, and on this computer a user."""

from __future__ import annotations

import ipaddress
import socket
import struct
from typing import Any

_NETLINK_SOCK_DIAG = 4  # of <linux/netlink.h>
_SOCK_DIAG, _REQUEST = 20, 1  # of <linux/sock_diag.h>: SOCK_DIAG_BY_FAMILY, NLM_F_REQUEST
_HEADER = struct.Struct("=IHHII")  # struct nlmsghdr
_ID = struct.Struct("!HH16s16s")  # struct inet_diag_sockid up to the addresses; then interface and cookie
_UID_AT = _HEADER.size + 4 + 48 + 12  # in the answer, of struct inet_diag_msg
NETWORK_BITS = 64  # of an IPv6 address: one customer has all of such a network


def peer(connection: socket.socket) -> str:
    """Who is at the other end: who shares this name shares the limits."""
    if connection.family == socket.AF_UNIX:
        _, uid, _ = struct.unpack("3i", connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))
        return f"user {uid}"
    other = connection.getpeername()
    address = ipaddress.ip_address(other[0].partition("%")[0])
    if isinstance(address, ipaddress.IPv6Address) and address.ipv4_mapped is not None:
        address = address.ipv4_mapped
    if address.is_loopback:  # a user of this computer has all of 127.0.0.0/8
        return f"user {_uid(connection.family, other, connection.getsockname())}"
    if isinstance(address, ipaddress.IPv6Address):
        return str(ipaddress.ip_network((address, NETWORK_BITS), strict=False))
    return str(address)


def _uid(family: int, client: tuple[Any, ...], server: tuple[Any, ...]) -> str:
    """The user who owns the client's end of a connection within this computer; "?" where the system does not tell."""
    ends = (socket.inet_pton(family, end[0].partition("%")[0]).ljust(16, b"\0") for end in (client, server))
    body = struct.pack("=BBBBI", family, socket.IPPROTO_TCP, 0, 0, 0xFFFFFFFF)
    body += _ID.pack(client[1], server[1], *ends) + bytes(4) + b"\xff" * 8
    try:
        with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, _NETLINK_SOCK_DIAG) as system:
            system.settimeout(0.5)
            system.sendto(_HEADER.pack(_HEADER.size + len(body), _SOCK_DIAG, _REQUEST, 1, 0) + body, (0, 0))
            answer = system.recv(4096)
    except OSError:
        return "?"
    if len(answer) < _UID_AT + 8 or _HEADER.unpack_from(answer)[1] != _SOCK_DIAG:
        return "?"
    uid, inode = struct.unpack_from("=2I", answer, _UID_AT)
    return str(uid) if inode else "?"  # a socket that its process has closed is nobody's
