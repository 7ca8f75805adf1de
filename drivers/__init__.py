"""Sources of images: one protocol, drivers as plugins, and `open_source(spec)` for all of them.

A source is a context manager that knows its rig before the first frame and yields `StereoImage` in stamp order.
"""

from __future__ import annotations

from stereo_sfm.drivers.source import BaseSource, Source, open_source

__all__ = ["BaseSource", "Source", "open_source"]
