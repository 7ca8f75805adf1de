"""Effect of the IMU: the EuRoC part as it is, at a third of its rate, and with three seconds of black images.

    python -m benchmarks inertial

Each with the IMU and without it, in one run. ATE is the RMSE after SE(3) alignment of every frame that has a pose.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Iterator

import numpy as np
from _sequences import data_root, one_thread

one_thread()

from stereo_sfm.config import Config
from stereo_sfm.drivers.memory import MemorySource
from stereo_sfm.drivers.select import SelectedFrames
from stereo_sfm.drivers.source import Source, open_source
from stereo_sfm.eval.evaluate import evaluate, length
from stereo_sfm.eval.record import RunRecord
from stereo_sfm.geometry import se3
from stereo_sfm.pipeline.run import run
from stereo_sfm.types import Frame, StereoImage, Trajectory

DARK = range(80, 140)  # frames


def darkened(images: list[StereoImage]) -> Iterator[StereoImage]:
    """The same images, black while the light is off."""
    for image in images:
        black = np.zeros_like(image.left)
        yield dataclasses.replace(image, left=black, right=black) if image.frame_id in DARK else image


def off_m(frame: Frame, before: Frame, truth: Trajectory) -> float:
    """Error of the live odometry in metres from the last frame before the dark."""
    at = [int(np.argmin(np.abs(truth.stamp_ns - f.stamp_ns))) for f in (before, frame)]
    true = se3.inverse(truth.poses[at[0]]) @ truth.poses[at[1]]
    seen = se3.inverse(before.odom_T_cam) @ frame.odom_T_cam
    return float(np.linalg.norm(seen[:3, 3] - true[:3, 3]))


def row(name: str, source: Source, inertial: bool) -> str:
    """One line of the table."""
    config = Config()
    config = dataclasses.replace(config, tracker=dataclasses.replace(config.tracker, inertial=inertial))
    record = RunRecord.of(config)
    frames = list(run(source, config, [record]))
    truth = source.ground_truth
    assert truth is not None
    odometry, mapped = record.odometry(), record.mapped()
    errors = " | ".join(length(evaluate(t, truth).ape_m.rmse) if t is not None else "–" for t in (odometry, mapped))
    dark = [f for f in frames if f.frame_id in DARK]
    end = length(off_m(dark[-1], frames[DARK.start - 1], truth)) if name == "black" else "–"
    submaps = 1 + max((k.submap_id for k in record.keyframes.values()), default=0)
    who = "with" if inertial else "without"
    return f"| {name} | {who} | {len(odometry)} of {len(frames)} | {submaps} | {errors} | {end} |"


def main() -> None:
    """Print the table."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    root = data_root()
    if root is None:
        return
    with open_source(root / "euroc_mh01") as source:
        images, rig, truth = list(source), source.rig, source.ground_truth
    print("| images | IMU | frames with a pose | submaps | odometry | map | off at the end of the dark |")
    print("|---|---|---|---|---|---|---|")
    for name in ("as recorded", "every third", "black"):
        for inertial in (True, False):
            shown = list(darkened(images)) if name == "black" else images
            memory = MemorySource(rig, shown, truth)
            part = SelectedFrames(memory, frame_skip=3) if name == "every third" else memory
            print(row(name, part, inertial), flush=True)


if __name__ == "__main__":
    main()
