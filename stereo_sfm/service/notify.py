"""Notifications to systemd: one datagram each to the socket that it names (sd_notify(3))."""

from __future__ import annotations

import contextlib
import os
import socket
import time


class SystemdNotifier:
    """Does nothing where the service was not started by systemd with `Type=notify`."""

    def __init__(self, address: str | None = None) -> None:
        """Args: address, of the socket; what systemd has set when omitted."""
        given = os.environ.get("NOTIFY_SOCKET", "") if address is None else address
        self._address = f"\0{given[1:]}" if given.startswith("@") else given
        limit_us = os.environ.get("WATCHDOG_USEC", "")
        self.watchdog_s = int(limit_us) / 2e6 if limit_us.isdigit() else 0.0  # between two keep-alive messages; 0: none
        self._status = ""

    def ready(self) -> None:
        """The service is up."""
        self._send("READY=1")

    def watchdog(self) -> None:
        """Keep-alive."""
        self._send("WATCHDOG=1")

    def status(self, text: str) -> None:
        """A line for `systemctl status`, when it changes."""
        if text != self._status:
            self._status = text
            self._send(f"STATUS={text}")

    def reloading(self) -> None:
        """Restarting with another map or configuration; `ready` follows."""
        self._send(f"RELOADING=1\nMONOTONIC_USEC={time.monotonic_ns() // 1000}")

    def stopping(self) -> None:
        """The service ends."""
        self._send("STOPPING=1")

    def _send(self, text: str) -> None:
        if not self._address:
            return
        with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as out:
            out.sendto(text.encode(), self._address)
