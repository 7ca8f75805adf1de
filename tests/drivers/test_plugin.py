"""The driver of docs/drivers.md: a package of its own, installed and run without any change of the core."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from stereo_sfm.calib import save_rig
from stereo_sfm.drivers import open_source

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "examples" / "webcam_driver"
FRAMES = 12


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the example and its metadata, as `pip install` leaves it."""
    target = tmp_path_factory.mktemp("site")
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation", "--no-index"]
    found = subprocess.run([*pip, "--target", target, EXAMPLE], capture_output=True, text=True)
    assert found.returncode == 0, found.stderr
    return target


@pytest.fixture(scope="module")
def videos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """left.avi, right.avi and rig.yaml of the simulated store."""
    folder = tmp_path_factory.mktemp("videos")
    with open_source("sim:aisle", camera="pinhole", size="320x200", frames=FRAMES) as source:
        save_rig(source.rig, folder / "rig.yaml")
        size = source.rig.left.size
        codec = cv2.VideoWriter_fourcc(*"MJPG")  # type: ignore[attr-defined]
        writers = [cv2.VideoWriter(str(folder / f"{side}.avi"), codec, 30.0, size) for side in ("left", "right")]
        for image in source:
            assert image.right is not None
            for writer, pixels in zip(writers, (image.left, image.right), strict=True):
                writer.write(np.repeat(pixels[..., None], 3, axis=2))
        for writer in writers:
            writer.release()
    return folder


def call(installed: Path, folder: Path, *command: str) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(installed), str(ROOT)])}
    run = [sys.executable, "-m", "stereo_sfm.cli", *command]
    return subprocess.run(run, cwd=folder, env=environment, capture_output=True, text=True)


def test_a_driver_of_another_package_is_run(installed: Path, videos: Path) -> None:
    source = "webcam:left.avi,right.avi?rig=rig.yaml&fps=30"
    done = call(installed, videos, "record", source, "-o", "pair.mcap", "-q")
    assert done.returncode == 0, done.stderr
    told = json.loads(call(installed, videos, "info", "pair.mcap", "--json").stdout)
    assert told["images"]["count"] == FRAMES and told["images"]["hz"] == pytest.approx(30, abs=0.01)
    assert told["metadata"]["source"] == source.replace("?rig=rig.yaml&fps=30", "")


def test_it_is_listed_and_documented_and_its_mistakes_are_one_line(installed: Path, videos: Path) -> None:
    assert "webcam:LEFT,RIGHT" in call(installed, videos, "sources").stdout
    assert "images a second" in call(installed, videos, "sources", "webcam").stdout
    assert "webcam" in call(installed, videos, "run", "--help").stdout
    for source, message in (
        ("webcam:0", "name the left and the right camera"),
        ("webcam:left.avi,right.avi?fsp=3", "webcam has no option 'fsp', did you mean fps?"),
        ("webcam:left.avi,right.avi", "give --rig FILE"),
    ):
        done = call(installed, videos, "record", source, "-o", "none.mcap")
        assert done.returncode == 2 and message in done.stderr and len(done.stderr.splitlines()) == 1


def test_the_tutorial_shows_the_example_as_it_is() -> None:
    text = (ROOT / "docs" / "drivers.md").read_text()
    assert "<!-- on the site: examples/webcam_driver/webcam_driver.py -->" in text
    assert '[project.entry-points."stereo_sfm.drivers"]\nwebcam = "webcam_driver:DRIVER"' in text
