"""What the pages of the documentation call their reader's files: small ones, made in a folder when they are named."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from stereo_sfm.calib import save_rig
from stereo_sfm.calib.targets import Target
from stereo_sfm.cli import main
from stereo_sfm.demo import demo_recording
from stereo_sfm.drivers import open_source
from stereo_sfm.drivers.sim.boards import Faults, render_boards
from stereo_sfm.drivers.sim.rigs import make_rig
from tests.drivers.ros_bags import write_bag


def part(name: str, start_s: float, frames: int) -> Callable[[Path], None]:
    """A part of the bundled recording, which turns after 5 s and is at its beginning again after 19 s."""

    def make(shop: Path) -> None:
        options = ["--start", str(start_s), "--frames", str(frames), "-q"]
        assert main(["record", str(demo_recording()), "-o", str(shop / name), *options]) == 0

    return make


def run_of(name: str, *options: str) -> Callable[[Path], None]:
    def make(shop: Path) -> None:
        file_of(shop, "session.mcap")
        words = ["run", str(shop / "session.mcap"), "-o", str(shop / name), "--max-frames", "12", *options]
        assert main([*words, "--inline", "-q"]) == 0

    return make


def map_of(name: str, session: str) -> Callable[[Path], None]:
    def make(shop: Path) -> None:
        file_of(shop, session)
        words = ["run", str(shop / session), "--map-out", str(shop / name), "-o", str(shop / "runs" / name)]
        assert main([*words, "--inline", "-q"]) == 0

    return make


def images(shop: Path) -> None:
    """mydata, the same as two videos, as one with both images in each frame, and as a bag of ROS 1."""
    (shop / "mydata" / "left").mkdir(parents=True)
    (shop / "mydata" / "right").mkdir()
    with open_source("sim:aisle", camera="pinhole", size="320x200", frames=6) as source:
        save_rig(source.rig, shop / "mydata" / "rig.yaml")
        save_rig(source.rig, shop / "rig.yaml")
        pairs, size = list(source), source.rig.left.size
        write_bag(shop, ".bag", source.rig, pairs).rename(shop / "drive.bag")
        write_bag(shop, "folder of .db3", source.rig, pairs).rename(shop / "drive")
    codec = cv2.VideoWriter_fourcc(*"MJPG")  # type: ignore[attr-defined]
    videos = [cv2.VideoWriter(str(shop / f"{side}.mkv"), codec, 30.0, size) for side in ("left", "right")]
    both = cv2.VideoWriter(str(shop / "drive.avi"), codec, 30.0, (2 * size[0], size[1]))
    for number, pair in enumerate(pairs, 1):
        assert pair.right is not None
        for side, pixels, video in zip(("left", "right"), (pair.left, pair.right), videos, strict=True):
            cv2.imwrite(str(shop / "mydata" / side / f"{number:06}.png"), pixels)
            video.write(np.repeat(pixels[..., None], 3, axis=2))
        both.write(np.repeat(np.hstack([pair.left, pair.right])[..., None], 3, axis=2))
    for video in (*videos, both):
        video.release()
    (shop / "drive.avi").rename(shop / "drive.mp4")


def kalibr(shop: Path) -> None:
    file_of(shop, "mydata")
    assert main(["convert-calib", str(shop / "rig.yaml"), str(shop / "camchain.yaml"), "--to", "kalibr"]) == 0
    (shop / "rig.yaml").unlink()


def boards(shop: Path) -> None:
    (shop / "boards").mkdir()
    rig = make_rig("pinhole", (640, 480))
    for number, pair in enumerate(render_boards(rig, Target("checkerboard", 9, 6, 0.025), 16, 0, Faults(), 45.0)[0]):
        for side, pixels in zip(("left", "right"), pair, strict=True):
            cv2.imwrite(str(shop / "boards" / f"{side}_{number:02}.png"), pixels)


def copies(shop: Path) -> None:
    file_of(shop, "session.mcap")
    for name in "ABC":
        shutil.copy(shop / "session.mcap", shop / f"{name}.mcap")


MAKERS: dict[str, Callable[[Path], None]] = {
    "session.mcap": part("session.mcap", 5, 30),
    "monday.mcap": part("monday.mcap", 1.5, 36),
    "tuesday.mcap": part("tuesday.mcap", 19, 30),
    "wednesday.mcap": part("wednesday.mcap", 2.5, 30),
    "A.mcap": copies,
    "runs/latest": run_of("runs/a"),
    "runs/a": run_of("runs/a"),
    "runs/b": run_of("runs/b", "--seed", "1"),
    "runs/c": run_of("runs/c", "--seed", "2"),
    "store": map_of("store", "monday.mcap"),
    "store3": map_of("store3", "wednesday.mcap"),
    **dict.fromkeys(("mydata", "drive.mp4", "video:left.mkv?right=right.mkv", "drive/", "drive.bag"), images),
    "camchain.yaml": kalibr,
    "boards": boards,
}


def file_of(shop: Path, name: str) -> None:
    """Make what a page names, once."""
    if name in MAKERS and not (shop / name.rstrip("/").partition("?")[0].removeprefix("video:")).exists():
        MAKERS[name](shop)
