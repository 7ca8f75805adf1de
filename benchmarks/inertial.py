"""What must hold of IMU and wheels, each sentence with what is wanted and what is measured.

    python benchmarks/inertial.py [--part euroc drives rest calibration cost] [--seeds 3]
    python benchmarks/inertial.py --part dark turn slip standing [--size 424x400] [--rate 15]

Each part by itself:

* euroc: as recorded, at a third of the rate, and with three seconds of black images, with the IMU and without; the
  seeds vary the keyframe threshold by 3 %, and medians are compared.
* drives: roll and pitch, darkness and slip on simulated drives with exact poses and noise instead of images.
* rest: twenty minutes at rest, likewise. calibration: wrong offset, rotation and radius. cost: a frame.
* dark, turn, slip, standing: rendered drives, every row with the sensors and without them on the same images: five
  seconds without light at about 1 m/s; a corner at 200 degrees a second with motion blur; wheels that turn 30 % too far
  in turns; a minute at rest. Minutes each.

ATE is the RMSE after SE(3) alignment of every frame that has a pose, of the odometry and of the map; "off" is the
error of the odometry over the time without images (standing: its largest movement); tilt is the largest error of roll
and pitch where gravity is known.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Iterable, Iterator

import numpy as np
from _sequences import data_root, one_thread

one_thread()

from _inertial_drives import Row, cost, drives, recovery, standing

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
RENDERED = ("dark", "turn", "slip", "standing")
SENTENCES = ("euroc", "drives", "rest", "calibration", "cost")
THIRD = "every third", "IMU"
SHARES = 1.0, 0.97, 1.03  # of the keyframe threshold, by seed
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


@dataclasses.dataclass(frozen=True)
class Result:
    """One run."""

    frames: list[Frame]
    posed: int
    submaps: int
    odometry_m: float  # ATE
    map_m: float
    off_m: float  # at the end of the time without images; NaN without one
    back_m: float  # the same a second later
    tilt_deg: float  # of the frames, largest; NaN if gravity is not known
    gravity_deg: float  # error of its direction in the map; NaN likewise


def result(source: Source, sensors: str, without_images: range, share: float = 1.0) -> Result:
    """Run on a source; `without_images`: the frames over which the error of the odometry is measured."""
    inertial, wheels = SENSORS[sensors]
    tracker = Config().tracker
    tracker = dataclasses.replace(
        tracker, inertial=inertial, wheels=wheels, keyframe_share=share * tracker.keyframe_share
    )
    config = dataclasses.replace(Config(), tracker=tracker)
    record = RunRecord.of(config)
    frames = list(run(source, config, [record]))
    truth = source.ground_truth
    assert truth is not None
    odometry, mapped = record.odometry(), record.mapped()
    map_m = evaluate(mapped, truth).ape_m.rmse if mapped is not None else float("nan")
    off = back = float("nan")
    if without_images:
        before = next(f for f in reversed(frames) if f.frame_id < without_images.start)
        off = off_m(next(f for f in reversed(frames) if f.frame_id in without_images), before, truth)
        later = [f for f in frames if f.frame_id >= without_images.stop]
        again = [f for f in later if f.stamp_ns <= later[0].stamp_ns + 1_000_000_000]
        back = off_m(again[-1], before, truth)
    submaps = 1 + max((k.submap_id for k in record.keyframes.values()), default=0)
    gravity = gravity_deg(record, mapped, truth)
    return Result(
        frames, len(odometry), submaps, evaluate(odometry, truth).ape_m.rmse, map_m, off, back,
        tilt_deg(frames, truth), gravity,
    )  # fmt: skip


def gravity_deg(record: RunRecord, mapped: Trajectory | None, truth: Trajectory) -> float:
    """Error in degrees of gravity's direction in the map, against the mean over all frames; NaN if it is not known."""
    if mapped is None or not record.down.any():
        return float("nan")
    nearest = np.abs(truth.stamp_ns[:, None] - mapped.stamp_ns).argmin(axis=0)
    down = -np.einsum("nij,nj->ni", mapped.poses[:, :3, :3], truth.poses[nearest, 2, :3])
    mean = down.mean(axis=0) / np.linalg.norm(down.mean(axis=0))
    return float(np.degrees(np.linalg.norm(np.cross(mean, record.down))))


def row(name: str, seed: int, sensors: str, found: Result) -> str:
    """One line of the table."""
    off = "–" if np.isnan(found.off_m) else length(found.off_m)
    if name.startswith("standing"):
        still = found.frames[9:]
        off = length(max(float(np.linalg.norm(f.odom_T_cam[:3, 3] - still[0].odom_T_cam[:3, 3])) for f in still))
    level = "–" if np.isnan(found.tilt_deg) else f"{found.tilt_deg:.2f}°"
    errors = f"{length(found.odometry_m)} | {length(found.map_m)}"
    posed = f"{found.posed} of {len(found.frames)}"
    return f"| {name} | {seed} | {sensors} | {posed} | {found.submaps} | {errors} | {off} | {level} |"


def euroc(seeds: int) -> Iterator[Row]:
    """The rows of the real part, if it is available, and its sentences."""
    root = data_root()
    if root is None:
        return
    with open_source(root / "euroc_mh01") as source:
        images, rig, truth = list(source), source.rig, source.ground_truth
    found: dict[tuple[str, str], list[Result]] = {}
    print(HEADER)
    for name in ("as recorded", "every third", "3 s black"):
        for sensors in ("IMU", "none"):
            for seed, share in enumerate(SHARES[:seeds]):
                memory = MemorySource(rig, list(darkened(images)) if "black" in name else images, truth)
                part = SelectedFrames(memory, frame_skip=3) if name == "every third" else memory
                one = result(part, sensors, DARK if "black" in name else range(0), share)
                found.setdefault((name, sensors), []).append(one)
                print(row(name, seed, sensors, one), flush=True)

    def mm(name: str, sensors: str, of: str) -> float:
        return 1e3 * float(np.median([getattr(one, of) for one in found[name, sensors]]))

    full, plain, third = (mm(*key, "map_m") for key in (("as recorded", "IMU"), ("as recorded", "none"), THIRD))
    live, live_plain = mm("as recorded", "IMU", "odometry_m"), mm("as recorded", "none", "odometry_m")
    text = f"odometry {live:.2f} and {live_plain:.2f} mm, map {full:.2f} and {plain:.2f} mm"
    yield "1 EuRoC with and without IMU", "not worse by more than the spread, 0.07 mm", text, full <= plain + 0.07
    gravity = max(one.gravity_deg for one in found["as recorded", "IMU"])
    yield "1 direction of gravity", "0.3°", f"{gravity:.2f}° at most", gravity <= 0.3
    yield "1 every third frame", f"1.5 x {full:.2f} mm", f"{third:.2f} mm", third <= 1.5 * full
    black = found["3 s black", "IMU"]
    posed = all(one.posed == len(one.frames) and one.submaps == 1 for one in black)
    other = found["3 s black", "none"][0]
    text = f"{black[0].posed} of {len(black[0].frames)}; without IMU {other.posed}, map {1e3 * other.map_m:.1f} mm"
    yield "1 3 s of black images", "a pose for every frame, one piece", text, posed
    off, back = (100 * max(getattr(one, of) for one in black) for of in ("off_m", "back_m"))
    yield "1 the live odometry at the end of the dark", "10 cm", f"{off:.1f} cm at most", off <= 10
    yield "1 and a second later", "back on the old points (1 cm)", f"{back:.1f} cm at most", back <= 1
    smoothed = mm("3 s black", "IMU", "map_m")
    yield "1 the map's trajectory", f"2 x {full:.2f} mm", f"{smoothed:.2f} mm", smoothed <= 2 * full


def store(part: str, seed: int, size: str, rate: int) -> None:
    """The rows of one drive."""
    common = f"size={size}&seed={seed}&imu=t265&wheel=differential"
    spec, sensors, dark = {
        "dark": (f"rate={rate}&frames={20 * rate}&dark={DARK_S[0]}-{DARK_S[1]}", list(SENSORS), range(0)),
        "turn": (f"rate={2 * rate}&corner=0.2&start={16 * rate}&frames={16 * rate}", list(SENSORS), range(0)),
        "slip": (f"rate={rate}&wheel_slip=0.3&frames={25 * rate}", ["none", "wheels", "IMU and wheels"], range(0)),
        "standing": (f"rate=5&rest=70&vibration=0&frames={60 * 5}", ["none", "IMU", "IMU and wheels"], range(0)),
    }[part]
    if part == "dark":
        dark = range(DARK_S[0] * rate, DARK_S[1] * rate)
    with open_source(f"sim:loop?{common}&{spec}") as source:
        images, rig, truth = list(source), source.rig, source.ground_truth
    for name in sensors:
        print(row(part, seed, name, result(MemorySource(rig, images, truth), name, dark)), flush=True)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--part", nargs="*", choices=(*SENTENCES, *RENDERED), default=SENTENCES)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--minutes", type=int, default=20, help="at rest")
    parser.add_argument("--size", default="212x200", help="of the rendered images")
    parser.add_argument("--rate", type=int, default=15, help="rendered images a second")
    args = parser.parse_args()
    of = {
        "euroc": lambda: euroc(args.seeds),
        "drives": lambda: drives(args.seeds),
        "rest": lambda: standing(args.minutes),
        "calibration": lambda: recovery(args.seeds),
        "cost": cost,
    }
    rows = [found for part in SENTENCES if part in args.part for found in of[part]()]
    if rows:
        print("\n| sentence | wanted | measured | holds |\n|---|---|---|---|")
    for sentence, wanted, measured, holds in rows:
        print(f"| {sentence} | {wanted} | {measured} | {'yes' if holds else 'no'} |")
    if any(part in args.part for part in RENDERED):
        print(HEADER)
    for part in (p for p in RENDERED if p in args.part):
        for seed in range(args.seeds):
            store(part, seed, args.size, args.rate)


if __name__ == "__main__":
    main()
