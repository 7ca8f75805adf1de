"""Effect of IMU and wheels: on the EuRoC part, and on drives through the simulated store.

    python benchmarks/inertial.py [--part euroc dark turn slip rest] [--seeds 3] [--size 424x400] [--rate 15]

Every row with the sensors and without them, on the same images, in one run:

* euroc: as recorded, at a third of the rate, and with three seconds of black images, with the IMU and without.
* dark: five seconds without light at about 1 m/s, without sensors, with each, and with both.
* turn: a corner at 200 degrees a second with motion blur.
* slip: wheels that turn 30 % too far in turns.
* rest: a minute at rest.

ATE is the RMSE after SE(3) alignment of every frame that has a pose, of the odometry and of the map; "off" is the
error of the odometry over the time without images (of rest: its largest movement); tilt is the largest error of roll
and pitch where gravity is known.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Iterable, Iterator

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
from stereo_sfm.tracking.inertial.inertial_motion import roll_pitch_deg
from stereo_sfm.types import F64, Frame, StereoImage, Trajectory

DARK = range(80, 140)  # frames of EuRoC
DARK_S = 10, 15  # of the simulated drives
PARTS = ("euroc", "dark", "turn", "slip", "rest")
SENSORS = {"none": (False, False), "IMU": (True, False), "wheels": (False, True), "IMU and wheels": (True, True)}
HEADER = "| images | seed | sensors | frames with a pose | submaps | odometry | map | off | tilt |\n|" + "---|" * 9


def darkened(images: Iterable[StereoImage]) -> Iterator[StereoImage]:
    """The same images, black while the light is off."""
    for image in images:
        black = np.zeros_like(image.left)
        yield dataclasses.replace(image, left=black, right=black) if image.frame_id in DARK else image


def true_pose(frame: Frame, truth: Trajectory) -> F64:
    """world_T_cam (4, 4) of a frame."""
    return truth.poses[int(np.argmin(np.abs(truth.stamp_ns - frame.stamp_ns)))]


def off_m(frame: Frame, before: Frame, truth: Trajectory) -> float:
    """Error in metres of the odometry's way from one frame to another."""
    true = se3.inverse(true_pose(before, truth)) @ true_pose(frame, truth)
    seen = se3.inverse(before.odom_T_cam) @ frame.odom_T_cam
    return float(np.linalg.norm(seen[:3, 3] - true[:3, 3]))


def tilt_deg(frames: list[Frame], truth: Trajectory) -> float:
    """Largest error of roll and pitch against a ground truth whose z axis is vertical; NaN if gravity is not known."""
    errors = [float("nan")]
    for frame in frames:
        if "roll_deg" in frame.stats:
            down = true_pose(frame, truth)[:3, :3].T @ np.array([0.0, 0.0, -1.0])
            seen = np.array([frame.stats["roll_deg"], frame.stats["pitch_deg"]])
            errors.append(float(np.abs(seen - roll_pitch_deg(down)).max()))
    return float(np.nanmax(errors)) if len(errors) > 1 else errors[0]


def row(name: str, seed: int, source: Source, sensors: str, without_images: range) -> str:
    """One line of the table. `without_images`: the frames over which the error of the odometry is stated."""
    inertial, wheels = SENSORS[sensors]
    config = Config()
    tracker = dataclasses.replace(config.tracker, inertial=inertial, wheels=wheels)
    record = RunRecord.of(dataclasses.replace(config, tracker=tracker))
    frames = list(run(source, dataclasses.replace(config, tracker=tracker), [record]))
    truth = source.ground_truth
    assert truth is not None
    odometry, mapped = record.odometry(), record.mapped()
    errors = " | ".join(length(evaluate(t, truth).ape_m.rmse) if t is not None else "–" for t in (odometry, mapped))
    off = "–"
    if name.startswith("rest"):
        off = length(max(float(np.linalg.norm(f.odom_T_cam[:3, 3] - frames[9].odom_T_cam[:3, 3])) for f in frames[9:]))
    elif without_images:
        dark = [f for f in frames if f.frame_id in without_images]
        before = next(f for f in reversed(frames) if f.frame_id < without_images.start)
        off = length(off_m(dark[-1], before, truth))
    submaps = 1 + max((k.submap_id for k in record.keyframes.values()), default=0)
    tilt = tilt_deg(frames, truth)
    level = "–" if np.isnan(tilt) else f"{tilt:.2f}°"
    posed = f"{len(odometry)} of {len(frames)}"
    return f"| {name} | {seed} | {sensors} | {posed} | {submaps} | {errors} | {off} | {level} |"


def euroc() -> None:
    """The rows of the real part, if it is available."""
    root = data_root()
    if root is None:
        return
    with open_source(root / "euroc_mh01") as source:
        images, rig, truth = list(source), source.rig, source.ground_truth
    for name in ("as recorded", "every third", "3 s black"):
        for sensors in ("IMU", "none"):
            shown = list(darkened(images)) if "black" in name else images
            memory = MemorySource(rig, shown, truth)
            part = SelectedFrames(memory, frame_skip=3) if name == "every third" else memory
            print(row(name, 0, part, sensors, DARK if "black" in name else range(0)), flush=True)


def store(part: str, seed: int, size: str, rate: int) -> None:
    """The rows of one drive."""
    common = f"size={size}&seed={seed}&imu=t265&wheel=differential"
    spec, sensors, dark = {
        "dark": (f"rate={rate}&frames={20 * rate}&dark={DARK_S[0]}-{DARK_S[1]}", list(SENSORS), range(0)),
        "turn": (f"rate={2 * rate}&corner=0.2&start={16 * rate}&frames={16 * rate}", list(SENSORS), range(0)),
        "slip": (f"rate={rate}&wheel_slip=0.3&frames={25 * rate}", ["none", "wheels", "IMU and wheels"], range(0)),
        "rest": (f"rate=5&rest=70&vibration=0&frames={60 * 5}", ["none", "IMU", "IMU and wheels"], range(0)),
    }[part]
    if part == "dark":
        dark = range(DARK_S[0] * rate, DARK_S[1] * rate)
    with open_source(f"sim:loop?{common}&{spec}") as source:
        images, rig, truth = list(source), source.rig, source.ground_truth
    for name in sensors:
        print(row(part, seed, MemorySource(rig, images, truth), name, dark), flush=True)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--part", nargs="*", choices=PARTS, default=PARTS)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--size", default="424x400", help="of the simulated images")
    parser.add_argument("--rate", type=int, default=15, help="simulated images a second")
    args = parser.parse_args()
    print(HEADER)
    if "euroc" in args.part:
        euroc()
    for part in (p for p in PARTS[1:] if p in args.part):
        for seed in range(args.seeds):
            store(part, seed, args.size, args.rate)


if __name__ == "__main__":
    main()
