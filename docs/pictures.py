"""The pictures of the documentation, from a run on the bundled recording.

    python docs/pictures.py [NAME ...]

rerun draws `viewer.png` without a window. It needs a graphics adapter, or Mesa's software one (Debian:
mesa-vulkan-drivers). `errors.png` is a plot of the report, `surface.png` four pictures of `stereo-sfm dense`.
"""

from __future__ import annotations

import itertools
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

T = TypeVar("T")
DOCS = Path(__file__).parent
SIZE = "1600x950"
MESSAGES_S = 15.0  # that the viewer shows its first messages
ATTEMPTS = 60
WIDE_PX = 1000  # of surface.png


def viewer(run: Path, picture: Path) -> None:
    """The viewer at the end of the run, once it has loaded and its first messages are gone."""
    from PIL import Image
    from rerun.experimental import ViewerClient

    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    options = ["--headless", "--hide-welcome-screen", "--bind", "127.0.0.1", "--port", port, "--window-size", SIZE]
    command = [Path(sys.executable).with_name("rerun"), *options]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        try:
            url = f"rerun+http://127.0.0.1:{port}/proxy"
            client = repeated(lambda: ViewerClient.connect(url), process)
            repeated(lambda: client.open(str(run / "run.rrd")), process)
            time.sleep(MESSAGES_S)
            repeated(lambda: client.save_screenshot(str(run / "viewer.png")), process)
        finally:
            process.terminate()
    with Image.open(run / "viewer.png") as shown:
        shown.convert("RGB").quantize(256).save(picture, optimize=True)


def repeated(action: Callable[[], T], process: subprocess.Popen[bytes]) -> T:
    """An action of the viewer, again while it starts or draws slowly."""
    for attempt in itertools.count(1):
        try:
            return action()
        except Exception:
            if process.poll() is not None:
                raise SystemExit(
                    "viewer.png: rerun finds no graphics adapter here (Debian: mesa-vulkan-drivers)"
                ) from None
            if attempt == ATTEMPTS:
                raise
            time.sleep(1.0)
    raise AssertionError


def errors(run: Path, picture: Path) -> None:
    """The errors of the run, as its report shows them."""
    shutil.copy(run / "errors.png", picture)


def surface(run: Path, picture: Path) -> None:
    """The mesh by height and by grey level, and two depth images below."""
    import cv2
    import numpy as np

    folder = run / "surface"
    subprocess.run(
        [sys.executable, "-m", "stereo_sfm.cli", "dense", run, "-q", "-o", folder, "--voxel", "0.05"], check=True
    )
    parts: list[Any] = []
    for names in (("mesh_height", "mesh_grey"), ("depth_1", "depth_2")):
        pair = [cv2.imread(str(folder / f"{name}.png")) for name in names]
        parts.append(np.hstack([_half(image) for image in pair]))
    cv2.imwrite(str(picture), np.vstack(parts), [cv2.IMWRITE_PNG_COMPRESSION, 9])


def _half(image: Any) -> Any:
    """Half as wide as the picture, as both of a row are of one shape."""
    import cv2

    return cv2.resize(
        image, (WIDE_PX // 2, WIDE_PX // 2 * image.shape[0] // image.shape[1]), interpolation=cv2.INTER_AREA
    )


PICTURES: dict[str, Callable[[Path, Path], None]] = {"errors.png": errors, "surface.png": surface, "viewer.png": viewer}


def main(names: list[str]) -> None:
    """Run once, then make the named pictures, or all."""
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        command = [sys.executable, "-m", "stereo_sfm.cli", "run", "--viz", "save", "-q", "--inline", "-o", run]
        subprocess.run(command, check=True, cwd=DOCS.parent)
        for name in names or PICTURES:
            PICTURES[name](run, DOCS / name)


if __name__ == "__main__":
    main(sys.argv[1:])
