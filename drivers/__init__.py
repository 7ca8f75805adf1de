"""Where images come from: one protocol, one table of names, `open_source(spec)` for all of them.

A source is a context manager that knows its rig before the first frame and yields `StereoImage` in stamp order.
"""

from __future__ import annotations

from drivers.source import Source, open_source

__all__ = ["Source", "open_source"]
