"""What must hold of IMU and wheels, each sentence with what is wanted and what is measured.

    python benchmarks/inertial.py [--part euroc drives rest calibration cost] [--seeds 3]
    python benchmarks/inertial.py --part dark turn slip standing slow [--size 424x400] [--rate 15]

Each part by itself:

* euroc: as recorded, backwards in time, at a third of the rate, and with three seconds of black images, with the IMU
  and without; the seeds vary the thresholds for keyframes and corners by a few per cent. With and without are compared
  by the means of both directions and their standard error, all else by medians. A step is the motion between two
  images. The ground truth's orientation rests on the same gyroscope: turns agree better than they are.
* drives: roll and pitch, darkness and slip on simulated drives with exact poses and noise instead of images.
* rest: twenty minutes at rest, likewise. calibration: wrong offset, rotation and radius. cost: a frame.
* dark, turn, slip, standing, slow: rendered drives, every row with the sensors and without them on the same images:
  five seconds without light at about 1 m/s; a corner at 200 degrees a second with motion blur; wheels that turn 30 %
  too far in turns; a minute at rest; 5 m at 0.02 m/s. Minutes each.

ATE is the RMSE after SE(3) alignment of every frame that has a pose, of the odometry and of the map; "off" is the
error of the odometry over the time without images (standing: its largest movement; slow: of the distance between the
first and the last image, in per cent); tilt is the largest error of roll and pitch where gravity is known.
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
from stereo_sfm.types import F64, Frame, ImuSamples, StereoImage, Trajectory

DARK = range(80, 140)  # frames of EuRoC
DARK_S = 10, 15  # of the simulated drives
SLOW_M = 5.0  # at 0.02 m/s
RENDERED = ("dark", "turn", "slip", "standing", "slow")
SENTENCES = ("euroc", "drives", "rest", "calibration", "cost")
THIRD = "every third", "IMU"
MEASURES = (  # what is compared with and without IMU: field of a result, unit
    ("odometry", "odometry_m", "mm", 1e3),
    ("map", "map_m", "mm", 1e3),
    ("step", "step_m", "mm", 1e3),
    ("turn of a step", "step_deg", "°", 1.0),
)
BOTH_WAYS = "as recorded", "backwards"
SHARES = 1.0, 0.97, 1.03, 0.985, 1.015  # of the keyframe threshold, by seed
QUALITIES = 1.0, 1.1, 0.9  # of the corner threshold, after that many seeds
SENSORS = {"none": (False, False), "IMU": (True, False), "wheels": (False, True), "IMU and wheels": (True, True)}
HEADER = "| images | seed | sensors | frames with a pose | submaps | odometry | map | off | tilt |\n|" + "---|" * 9


def darkened(images: Iterable[StereoImage]) -> Iterator[StereoImage]:
    """The same images, black while the light is off."""
    for image in images:
        black = np.zeros_like(image.left)
        yield dataclasses.replace(image, left=black, right=black) if image.frame_id in DARK else image


def backwards(images: list[StereoImage], truth: Trajectory) -> tuple[list[StereoImage], Trajectory]:
    """The same flight with time reversed: it turns the other way, and is pushed alike."""
    end = images[0].stamp_ns + images[-1].stamp_ns
    samples = ImuSamples.joined([image.imu for image in images if image.imu is not None])
    samples = ImuSamples((end - samples.stamp_ns)[::-1].copy(), -samples.gyro[::-1], samples.accel[::-1].copy())
    edges = np.searchsorted(samples.stamp_ns, [end - image.stamp_ns for image in images[::-1]], side="right").tolist()
    out = [
        dataclasses.replace(image, frame_id=k, stamp_ns=end - image.stamp_ns, imu=samples.part(slice(first, last)))
        for k, (image, first, last) in enumerate(zip(images[::-1], [0, *edges], edges, strict=False))
    ]
    return out, Trajectory((end - truth.stamp_ns)[::-1].copy(), truth.poses[::-1].copy())


def true_pose(frame: Frame, truth: Trajectory) -> F64:
    """world_T_cam (4, 4) of a frame."""
    return truth.poses[int(np.argmin(np.abs(truth.stamp_ns - frame.stamp_ns)))]


def off_m(frame: Frame, before: Frame, truth: Trajectory) -> float:
    """Error in metres of the odometry's way from one frame to another."""
    true = se3.inverse(true_pose(before, truth)) @ true_pose(frame, truth)
    seen = se3.inverse(before.odom_T_cam) @ frame.odom_T_cam
    return float(np.linalg.norm(seen[:3, 3] - true[:3, 3]))


def distance_off_m(frames: list[Frame], truth: Trajectory) -> float:
    """Error in metres of the odometry's distance between the first and the last frame."""
    first, last = frames[0], frames[-1]
    seen = last.odom_T_cam[:3, 3] - first.odom_T_cam[:3, 3]
    true = true_pose(last, truth)[:3, 3] - true_pose(first, truth)[:3, 3]
    return abs(float(np.linalg.norm(seen) - np.linalg.norm(true)))


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
    step_m: float  # RMSE of the odometry's motion between two images
    step_deg: float
    off_m: float  # at the end of the time without images; NaN without one
    back_m: float  # the same a second later
    distance_m: float  # error of the distance between the first and the last frame
    tilt_deg: float  # of the frames, largest; NaN if gravity is not known
    gravity_deg: float  # error of its direction in the map; NaN likewise


def result(source: Source, sensors: str, without_images: range, seed: int = 0) -> Result:
    """Run on a source; `without_images`: the frames over which the error of the odometry is measured.

    `seed`: of the thresholds.
    """
    inertial, wheels = SENSORS[sensors]
    tracker = Config().tracker
    share, quality = SHARES[seed % len(SHARES)], QUALITIES[seed // len(SHARES) % len(QUALITIES)]
    tracker = dataclasses.replace(
        tracker,
        inertial=inertial,
        wheels=wheels,
        keyframe_share=share * tracker.keyframe_share,
        corner_quality=quality * tracker.corner_quality,
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
    live = evaluate(odometry, truth)
    return Result(
        frames, len(odometry), submaps, live.ape_m.rmse, map_m, live.rpe_m.rmse, live.rpe_deg.rmse, off, back,
        distance_off_m(frames, truth), tilt_deg(frames, truth), gravity_deg(record, mapped, truth),
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
    if name == "slow":
        off = f"{100 * found.distance_m / SLOW_M:.2f} %"
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
    assert truth is not None
    found: dict[tuple[str, str], list[Result]] = {}
    print(HEADER)
    for name in (*BOTH_WAYS, "every third", "3 s black"):
        way, true = backwards(images, truth) if name == "backwards" else (images, truth)
        memory = MemorySource(rig, list(darkened(way)) if "black" in name else way, true)
        part = SelectedFrames(memory, frame_skip=3) if name == "every third" else memory
        for sensors in ("IMU", "none"):
            for seed in range(seeds):
                one = result(part, sensors, DARK if "black" in name else range(0), seed)
                found.setdefault((name, sensors), []).append(one)
                print(row(name, seed, sensors, one), flush=True)

    def mm(name: str, sensors: str, of: str) -> float:
        return 1e3 * float(np.median([getattr(one, of) for one in found[name, sensors]]))

    for what, of, unit, factor in MEASURES:
        runs = [[factor * getattr(one, of) for way in BOTH_WAYS for one in found[way, s]] for s in ("IMU", "none")]
        with_imu, without = (np.array(r).reshape(len(BOTH_WAYS), -1) for r in runs)
        error = float(np.sqrt((with_imu.var(axis=1) + without.var(axis=1)).sum() / max(seeds - 1, 1)) / len(BOTH_WAYS))
        text = f"{with_imu.mean():.4g} and {without.mean():.4g} {unit}, standard error {error:.2g}"
        yield f"1 EuRoC with and without IMU, {what}", "not worse", text, with_imu.mean() <= without.mean() + 2 * error
    full, third = mm("as recorded", "IMU", "map_m"), mm(*THIRD, "map_m")
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
    spec, sensors, span = {
        "dark": (f"rate={rate}&frames={20 * rate}&dark={DARK_S[0]}-{DARK_S[1]}", list(SENSORS), range(0)),
        "turn": (f"rate={2 * rate}&corner=0.2&start={16 * rate}&frames={16 * rate}", list(SENSORS), range(0)),
        "slip": (f"rate={rate}&wheel_slip=0.3&frames={25 * rate}", ["none", "wheels", "IMU and wheels"], range(0)),
        "standing": (f"rate=5&rest=70&vibration=0&frames={60 * 5}", ["none", "IMU", "IMU and wheels"], range(0)),
        "slow": (f"rate=2&speed=0.02&length={SLOW_M}", ["none", "IMU", "IMU and wheels"], range(0)),
    }[part]
    if part == "dark":
        span = range(DARK_S[0] * rate, DARK_S[1] * rate)
    with open_source(f"sim:loop?{common}&{spec}") as source:
        images, rig, truth = list(source), source.rig, source.ground_truth
    for name in sensors:
        print(row(part, seed, name, result(MemorySource(rig, images, truth), name, span)), flush=True)


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
