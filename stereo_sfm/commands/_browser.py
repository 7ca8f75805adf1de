"""Shows a page in the browser of a desktop."""

from __future__ import annotations

import os
import sys
from pathlib import Path


def show(page: Path) -> None:
    """Open a page; where there is no desktop, one line says where it is."""
    import webbrowser

    desktop = sys.platform != "linux" or any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER"))
    if not (desktop and webbrowser.open(page.resolve().as_uri())):
        print(f"no browser to open here: {page}", file=sys.stderr)
