"""The recording that comes with the package."""

from __future__ import annotations

from pathlib import Path

from stereo_sfm.errors import StereoSfmError


def demo_recording() -> Path:
    """The bundled recording: inside an installed package, or in `recordings/` of a checkout.

    Raises:
        StereoSfmError: it is in neither place.
    """
    package = Path(__file__).parent
    for path in (package / "data" / "demo.mcap", package.parent / "recordings" / "demo.mcap"):
        if path.is_file():
            return path
    raise StereoSfmError("the bundled recording is missing: name a source (see 'stereo-sfm run --help')")
