"""What must hold of IMU and wheels, each sentence with what is wanted and what is measured.

    python benchmarks/inertial.py [--part euroc drives rest calibration cost] [--seeds 3]
    python benchmarks/inertial.py --part level dark turn slip bumps pushed spot standing slow [--size 424x400]

Each part by itself:

* euroc: as recorded, backwards in time, at a third of the rate, and with three seconds of black images, with the IMU
  and without; the seeds vary the thresholds for keyframes and corners by a few per cent. With and without are compared
  by the means of both directions and their standard error, all else by medians. A step is the motion between two
  images. The ground truth's orientation rests on the same gyroscope: turns agree better than they are.
* drives: roll and pitch, darkness and slip on simulated drives with exact poses and noise instead of images.
* rest: twenty minutes at rest, likewise. calibration: wrong offset, rotation and radius. cost: a frame.
* level, dark, turn, slip, bumps, pushed, spot, standing, slow: rendered drives, every row with the sensors and without
  them on the same images: a lap; five seconds without light at about 1 m/s; a corner at 200 degrees a second with
  motion blur; a lap with wheels that turn 30 % too far in turns; over thresholds and ramps, on which they do, too;
  pushed by hand; with turns on the spot; a minute at rest; 5 m at 0.02 m/s. Minutes each.
* online: the same as calibration, found while driving on a rendered lap; and with the true one.

ATE is the RMSE after SE(3) alignment of every frame that has a pose, of the odometry and of the map; "off" is the
error of the odometry over the time without images (standing: its largest movement; slow: of the distance between the
first and the last image, in per cent); tilt is the largest error of roll and pitch where gravity is known, of the
live poses and of those of the map, which are level by what was measured until the end; yaw the RMSE of the map's
heading.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Iterable, Iterator

import numpy as np
from _sequences import data_root, one_thread

one_thread()

from _inertial_drives import Row, cost, drives, miscalibration, recovery, standing, wrong

from stereo_sfm.calib.sensor_terms import with_sensor_terms
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
RENDERED = ("level", "dark", "turn", "slip", "bumps", "pushed", "spot", "standing", "slow")
WAYS = {"slip": "slip of 30 % in turns", "bumps": "over bumps", "pushed": "pushed by hand", "spot": "turns on the spot"}
ONLINE = "online"
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
COLUMNS = "| images | seed | sensors | frames with a pose | submaps | odometry | map | off | tilt | map's tilt | yaw |"
HEADER = f"{COLUMNS}\n|{'---|' * 11}"


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
    gravity_deg: float  # error of its direction in the map, mean over all frames; NaN likewise
    map_tilt_deg: F64  # (N, 2) errors of roll and pitch of the map's poses; NaN likewise
    yaw_deg: float  # RMSE of the heading in the map


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
        distance_off_m(frames, truth), tilt_deg(frames, truth), *in_map(record, mapped, truth),
    )  # fmt: skip


def in_map(record: RunRecord, mapped: Trajectory | None, truth: Trajectory) -> tuple[float, F64, float]:
    """Of the map's poses, in degrees: the error of gravity's direction, against the mean over all frames; errors of
    roll and pitch, (N, 2); the RMSE of the heading. NaN without a map; the first two if gravity is not known."""
    nothing = np.full((1, 2), np.nan)
    if mapped is None:
        return float("nan"), nothing, float("nan")
    nearest = np.abs(truth.stamp_ns[:, None] - mapped.stamp_ns).argmin(axis=0)
    true, seen = truth.poses[nearest, :3, :3], mapped.poses[:, :3, :3]
    down = -np.einsum("nij,nj->ni", seen, true[:, 2])
    mean = down.mean(axis=0) / np.linalg.norm(down.mean(axis=0))
    map_R_world = np.einsum("nij,nkj->nik", seen, true)
    yaw = np.array([se3.so3_log(map_R_world[0].T @ r)[2] for r in map_R_world])
    yaw_deg = float(np.degrees(yaw.std()))
    if not record.down.any():
        return float("nan"), nothing, yaw_deg
    tilts = [[roll_pitch_deg(down) for down in downs] for downs in (record.down @ seen, -true[:, 2])]
    return float(np.degrees(np.linalg.norm(np.cross(mean, record.down)))), np.subtract(*tilts), yaw_deg


def movement(frames: list[Frame]) -> float:
    """Metres, the largest from the tenth image on."""
    still = frames[9:]
    return max(float(np.linalg.norm(f.odom_T_cam[:3, 3] - still[0].odom_T_cam[:3, 3])) for f in still)


def row(name: str, seed: int, sensors: str, found: Result) -> str:
    """One line of the table."""
    off = "–" if np.isnan(found.off_m) else length(found.off_m)
    if name == "standing":
        off = length(movement(found.frames))
    if name == "slow":
        off = f"{100 * found.distance_m / SLOW_M:.2f} %"
    tilts = (found.tilt_deg, float(np.abs(found.map_tilt_deg).max()))
    live, mapped = ("–" if np.isnan(tilt) else f"{tilt:.2f}°" for tilt in tilts)
    errors = f"{length(found.odometry_m)} | {length(found.map_m)}"
    posed = f"{found.posed} of {len(found.frames)}"
    yaw = f"{found.yaw_deg:.3f}°"
    return f"| {name} | {seed} | {sensors} | {posed} | {found.submaps} | {errors} | {off} | {live} | {mapped} | {yaw} |"


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


def store(part: str, seed: int, size: str, rate: int) -> dict[str, Result]:
    """The rows of one drive, by sensors."""
    common = f"size={size}&seed={seed}&imu=t265&wheel=differential"
    spec, sensors, span = {
        "level": (f"rate={rate}", ["none", "IMU"], range(0)),
        "dark": (f"rate={rate}&frames={20 * rate}&dark={DARK_S[0]}-{DARK_S[1]}", list(SENSORS), range(0)),
        "turn": (f"rate={2 * rate}&corner=0.2&start={16 * rate}&frames={16 * rate}", list(SENSORS), range(0)),
        "slip": (f"rate={rate}&wheel_slip=0.3", list(SENSORS), range(0)),
        "bumps": (f"rate={rate}&wheel_slip=0.3&thresholds=20&ramps=3", list(SENSORS), range(0)),
        "pushed": (f"rate={rate}&pushed=8-24", list(SENSORS), range(0)),
        "spot": (f"rate={rate}&spot_turns=on", list(SENSORS), range(0)),
        "standing": (f"rate=5&rest=70&vibration=0&frames={60 * 5}", ["none", "IMU", "IMU and wheels"], range(0)),
        "slow": (f"rate=2&speed=0.02&length={SLOW_M}", ["none", "IMU", "IMU and wheels"], range(0)),
    }[part]
    if part == "dark":
        span = range(DARK_S[0] * rate, DARK_S[1] * rate)
    with open_source(f"sim:loop?{common}&{spec}") as source:
        images, rig, truth = list(source), source.rig, source.ground_truth
    found = dict[str, Result]()
    for name in sensors:
        found[name] = result(MemorySource(rig, images, truth), name, span)
        print(row(part, seed, name, found[name]), flush=True)
    return found


def rendered(part: str, drives: list[dict[str, Result]]) -> Iterator[Row]:
    """The sentences of a rendered part, of one drive a seed."""

    def of(name: str, sensors: str) -> F64:
        return np.array([getattr(drive[sensors], name) for drive in drives])

    def against(name: str, a: str, b: str, unit: str, factor: float) -> tuple[str, bool]:
        one, other = factor * of(name, a), factor * of(name, b)
        error = float((one - other).std(ddof=1) / len(one) ** 0.5) if len(one) > 1 else 0.0
        text = (
            f"{a} {one.mean():.3g} {unit}, {b} {other.mean():.3g}, difference {(one - other).mean():+.2g} ± {error:.2g}"
        )
        return text, bool((one - other).mean() <= 2 * error)

    if part == "level":
        tilts = [np.abs(drive["IMU"].map_tilt_deg) for drive in drives]
        most = max(float(t.max()) for t in tilts)
        halves = [max(float(np.array_split(t, 2)[half].max()) for t in tilts) for half in (0, 1)]
        live = of("tilt_deg", "IMU").max()
        text = f"{most:.3f}° at most; first half {halves[0]:.3f}°, second {halves[1]:.3f}°; live {live:.2f}°"
        yield "2 roll and pitch of the map's poses, T265", "0.1°, not growing", text, most <= 0.1
        kinds = ("yaw", "yaw_deg", "°", 1), ("odometry", "odometry_m", "mm", 1e3), ("map", "map_m", "mm", 1e3)
        for what, name, unit, factor in kinds:
            yield f"2 {what}", "not worse than vision alone", *against(name, "IMU", "none", unit, factor)
    if part == "dark":
        off, alone = (100 * of("off_m", sensors) for sensors in ("IMU and wheels", "IMU"))
        most = [f"{x.max():.1f} cm at most (median {np.median(x):.1f})" for x in (off, alone)]
        text = f"{most[0]}; IMU alone {most[1]}"
        yield "2 five seconds of darkness, rendered", "10 cm with IMU and wheels", text, bool(off.max() <= 10)
    if part == "turn":
        posed = [drive["IMU"].posed == len(drive["IMU"].frames) and drive["IMU"].submaps == 1 for drive in drives]
        yield "2 a turn of 200°/s", "never lost", f"{sum(posed)} of {len(posed)} drives", all(posed)
    if part == "standing":
        moved = [max(movement(drive[s].frames) for drive in drives) for s in ("IMU", "IMU and wheels")]
        text = ", ".join(f"{1e3 * m:.2f} mm" for m in moved)
        yield "2 a minute at rest, rendered", "2 mm, with the IMU and with both", text, max(moved) <= 2e-3
    if part == "slow":
        off = 100 * of("distance_m", "IMU") / SLOW_M
        yield "2 5 m at 0.02 m/s", "0.3 %", f"{off.max():.2f} % at most", bool(off.max() <= 0.3)
    if part in WAYS:
        without = "IMU" if part == "slip" else "none"
        for what, name in (("odometry", "odometry_m"), ("map", "map_m")):
            yield f"2 {WAYS[part]}, {what}", "no worse", *against(name, "IMU and wheels", without, "mm", 1e3)


def online(seeds: int, size: str, rate: int) -> Iterator[Row]:
    """What calibration while driving leaves of a wrong one, and makes of a true one."""
    config = dataclasses.replace(Config(), tracker=dataclasses.replace(Config().tracker, calibrate_sensors=True))
    left, changed = list[tuple[float, float, float]](), 0
    for seed in range(seeds):
        spec = f"sim:loop?size={size}&rate={rate}&seed={seed}&imu=t265&imu_offset_ms=20&wheel=differential"
        with open_source(f"{spec}&wheel_grade=ideal") as source:
            images, true, truth = list(source), source.rig, source.ground_truth
        for rig in (wrong(true), true):
            record = RunRecord.of(config)
            list(run(MemorySource(rig, images, truth), config, [record]))
            found = with_sensor_terms(rig, record.sensor_updates[-1]) if record.sensor_updates else rig
            if rig is not true:
                left.append(miscalibration(found, true))
            changed += rig is true and max(miscalibration(found, true)) > 0
    for name, wanted, unit, values in zip(
        ("rotation of 3°", "time offset of 20 ms", "radius wrong by 2 %"), (0.1, 0.5, 0.2), ("°", " ms", " %"),
        np.transpose(left), strict=True,
    ):  # fmt: skip
        text = f"{values.max():.3f}{unit} at most, {values.mean():.3f} in the mean"
        yield f"3 {name}, while driving", f"{wanted}{unit}", text, bool(values.max() <= wanted)
    yield "3 a true calibration", "stays", f"{seeds - changed} of {seeds}", changed == 0


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--part", nargs="*", choices=(*SENTENCES, *RENDERED, ONLINE), default=SENTENCES)
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
    if any(part in args.part for part in RENDERED):
        print(HEADER)
    for part in (p for p in RENDERED if p in args.part):
        rows += rendered(part, [store(part, seed, args.size, args.rate) for seed in range(args.seeds)])
    rows += online(args.seeds, args.size, args.rate) if ONLINE in args.part else []
    print("\n| sentence | wanted | measured | holds |\n|---|---|---|---|")
    for sentence, wanted, measured, holds in rows:
        print(f"| {sentence} | {wanted} | {measured} | {'yes' if holds else 'no'} |")


if __name__ == "__main__":
    main()
