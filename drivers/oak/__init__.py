"""OAK cameras over depthai 3. Nothing of depthai is imported before a camera is asked for."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from drivers.oak.source import OakSource


def open_oak(rest: str = "", **options: Any) -> OakSource:
    """Open an OAK: see drivers.oak.source.open_oak."""
    from drivers.oak.source import open_oak as open_now

    return open_now(rest, **options)
