"""What must hold of IMU and wheels on drives that are not rendered: exact poses with noise instead of images."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from _best_tilt import BestTilt, TiltGraph, true_tilt_deg
from dead_reckoning import NOTHING, RATE, SENSORS, dark, feed, opened, rest

from stereo_sfm.calib.imu_fit import fit_imu
from stereo_sfm.calib.rig import Rig
from stereo_sfm.calib.wheel_fit import fit_wheel
from stereo_sfm.geometry import se3
from stereo_sfm.types import F64, I64, ImuSamples, StereoImage, WheelSamples
from tests.sensor_drive import THREE_DEGREES, miscalibrated

NOISE = np.array([5e-4, 5e-4, 5e-4, 1e-4, 1e-4, 1e-4])  # of a pose: metres, radians
DRIFT, WANDER = 2e-5, 5e-5  # of the odometry's rotation: rad/s, rad/sqrt(s)
CORNER, RIGHT_ANGLE = 1.0, 1.5  # radians by which the robot has turned when it has rounded a corner
AISLE_S, CORNERS_S = 22.0, 10.0  # when the light goes out
Row = tuple[str, str, str, bool]  # sentence, wanted, measured, holds


@dataclass(frozen=True, eq=False)
class Lap:
    """Roll and pitch over a lap with a T265's IMU."""

    turned: F64  # (N,) rad from the first heading
    tilt: F64  # (N, 3) degrees: errors of roll and pitch, and the standard deviation that is said of each
    best: list[BestTilt]  # every half second until the first corner is rounded


def lap(seed: int) -> Lap:
    """From poses with noise, and what is best from the same."""
    source, sensors, poses = opened(seed, imu="t265")
    world, rng, imu = source.drive.poses(source.frame_ids / RATE), np.random.default_rng(seed), source.rig.imu
    assert imu is not None
    drift, turned, tilt = rng.normal(0, DRIFT, 3), np.zeros(3), np.full((len(poses), 3), np.nan)
    headings = np.arccos(np.clip(world[:, :3, 2] @ world[0, :3, 2], -1, 1))
    graph, best = TiltGraph(imu, NOISE, float(np.hypot(DRIFT, WANDER))), list[BestTilt]()
    for k, pose in enumerate(poses):
        stamp = feed(source, sensors, k)
        turned = turned + drift / RATE + rng.normal(0, WANDER / RATE**0.5, 3)
        seen = se3.from_rotation_translation(se3.so3_exp(turned) @ pose[:3, :3], pose[:3, 3])
        seen = seen @ se3.exp(rng.normal(0, 1, 6) * NOISE)
        sensors.accept(stamp, seen)
        level = sensors.level(seen)
        if level:
            off = np.array([level["roll_deg"], level["pitch_deg"]]) - true_tilt_deg(world[k])
            tilt[k] = *off, level["tilt_sigma_deg"]
        if headings[: k + 1].max() < CORNER:
            graph.add(stamp, source.sampled(k)[0], seen, world[k])
            if k % (RATE // 2) == 0 and level:
                best.append(graph.best(world[k]))
    return Lap(np.maximum.accumulate(headings), tilt, best)


def tilts(seeds: int) -> Iterator[Row]:
    """Before and after the first corner."""
    laps = [lap(seed) for seed in range(seeds)]
    ours = np.array([[*x.tilt[b.image], *b.off_deg, b.sigma_deg] for x in laps for b in x.best])
    (rms, other), most = (np.sqrt(np.mean(ours[:, c : c + 2] ** 2)) for c in (0, 3)), np.abs(ours[:, :2]).max()
    text = (
        f"{most:.2f}° at most, {rms:.2f}° rms; the best of the same data (GTSAM): {np.abs(ours[:, 3:5]).max():.2f}°, "
    )
    text += f"{other:.2f}° rms, {ours[:, 5].max():.2f}° expected of it at first"
    yield "2 roll and pitch, T265, until the first corner is rounded", "0.1°", text, most <= 0.1
    yield "2 the same, against the best of the same data", "1.1 x its rms", f"{rms / other:.2f}", rms <= 1.1 * other
    normal = np.sqrt(np.mean((ours[:, :2] / ours[:, 2:3]) ** 2))
    yield (
        "2 the same, against what is said of it",
        "0.5 to 1.5 standard deviations",
        f"{normal:.2f}",
        0.5 < normal < 1.5,
    )
    after = [np.abs(x.tilt[x.turned > CORNER, :2]).max(axis=1) for x in laps]
    first, second = np.array([[part.max() for part in np.array_split(a, 2)] for a in after]).max(axis=0)
    late = max(float(np.abs(x.tilt[x.turned > RIGHT_ANGLE, :2]).max()) for x in laps)
    text = f"{first:.2f}°, once it has turned by 86° {late:.2f}°, in the second half {second:.2f}°"
    yield "2 roll and pitch from then on", "0.1°, not growing", text, max(first, second) <= 0.1


def drives(seeds: int) -> Iterator[Row]:
    """Tilt, darkness, slip."""
    yield from tilts(seeds)
    ways = {
        name: [dark(seed, AISLE_S, SENSORS[name]) for seed in range(seeds)]
        for name in ("IMU (T265)", "IMU and wheels", "IMU and wheels, 30 % slip")
    }
    most = {name: [100 * way[0] if way is not None else np.inf for way in found] for name, found in ways.items()}
    alone, both, slip = (np.array(v) for v in most.values())
    text = f"{both.max():.1f} cm (median {np.median(both):.1f}); IMU alone {alone.max():.1f} ({np.median(alone):.1f})"
    yield "2 five seconds of darkness, aisle", "10 cm with IMU and wheels", text, both.max() <= 10
    text = f"{slip.max():.1f} cm (median {np.median(slip):.1f})"
    yield "2 slip of 30 % in turns", "no worse than without wheels", text, np.median(slip) <= np.median(alone)
    names = "IMU and wheels, 30 % slip", "IMU (T265)"
    corners = [[dark(seed, CORNERS_S, SENSORS[name]) for seed in range(seeds)] for name in names]
    slip, alone = (np.array([np.inf if way is None else 100 * way[0] for way in found]) for found in corners)
    text = f"{slip.max():.0f} cm (median {np.median(slip):.0f}); IMU alone {alone.max():.0f} ({np.median(alone):.0f})"
    yield "2 the same round two corners", "no worse than without wheels", text, np.median(slip) <= np.median(alone)


def standing(minutes: int) -> Iterator[Row]:
    """At rest."""
    metres, degrees = rest(0, 60 * minutes, SENSORS["IMU and wheels"], hold=True)
    holds = metres <= 2e-3 and degrees <= 0.02
    yield f"2 {minutes} minutes at rest", "2 mm, 0.02°", f"{1e3 * metres:.2f} mm, {degrees:.4f}°", holds


def wrong(rig: Rig) -> Rig:
    """3 degrees and 2 % off, and without the IMU's time offset."""
    return miscalibrated(rig, THREE_DEGREES, 0.0, 0.02)


def miscalibration(found: Rig, true: Rig) -> tuple[float, float, float]:
    """Degrees, milliseconds and per cent that are left."""
    assert found.imu is not None and true.imu is not None and found.wheel is not None and true.wheel is not None
    off = se3.so3_log(found.imu.left_T_imu[:3, :3].T @ true.imu.left_T_imu[:3, :3])
    radius = float(np.mean(found.wheel.radii_m) / np.mean(true.wheel.radii_m))
    offset_s = found.imu.offset_s - true.imu.offset_s
    return float(np.degrees(np.linalg.norm(off))), 1e3 * abs(offset_s), 100 * abs(radius - 1)


def recovery(seeds: int) -> Iterator[Row]:
    """Wrong calibrations, from half a minute each."""
    offsets, turns, radii = list[float](), list[float](), list[float]()
    for seed in range(seeds):
        source, _, poses = opened(seed, imu="t265", wheel="differential", wheel_grade="ideal", imu_offset_ms=20)
        count, imu, wheel = 30 * RATE, source.rig.imu, source.rig.wheel
        assert imu is not None and wheel is not None
        parts = [source.sampled(k) for k in range(count)]
        rng = np.random.default_rng(seed)
        seen = poses[:count] @ np.array([se3.exp(n) for n in rng.normal(0, 1, (count, 6)) * NOISE])
        stamps: I64 = np.array([source.stamp_ns(k) for k in range(count)], np.int64)
        rig = wrong(source.rig)
        samples = ImuSamples.joined([i for i, _ in parts if i is not None])
        speeds = WheelSamples.joined([w for _, w in parts if w is not None])
        assert rig.imu is not None and rig.wheel is not None
        new_imu, new_wheel = (
            fit_imu(stamps, seen, samples, rig.imu).imu,
            fit_wheel(stamps, seen, speeds, rig.wheel).wheel,
        )
        left = miscalibration(replace(rig, imu=new_imu, wheel=new_wheel), source.rig)
        for values, value in zip((turns, offsets, radii), left, strict=True):
            values.append(value)
    yield "3 time offset of 20 ms", "0.5 ms", f"{max(offsets):.2f} ms at most", max(offsets) <= 0.5
    yield "3 rotation of 3°", "0.1°", f"{max(turns):.3f}° at most", max(turns) <= 0.1
    yield "3 radius wrong by 2 %", "0.2 %", f"{max(radii):.2f} % at most", max(radii) <= 0.2


def cost() -> Iterator[Row]:
    """Processor time of the sensors a frame, 15 images and 200 samples a second: the least mean of three drives."""
    for name, limit in (("IMU (T265)", 0.5), ("IMU and wheels", 0.5)):
        ms = min(_cost(name) for _ in range(3))
        yield f"4 cost a frame, {name}", f"{limit} ms", f"{ms:.2f} ms", ms <= limit


def _cost(name: str) -> float:
    """Milliseconds, mean from the third second on."""
    source, sensors, poses = opened(0, **SENSORS[name])
    rng, took, last = np.random.default_rng(0), list[float](), np.eye(4)
    for k in range(20 * RATE):
        seen = poses[k] @ se3.exp(rng.normal(0, 1, 6) * NOISE)
        (imu, wheel), stamp = source.sampled(k), source.stamp_ns(k)
        image = StereoImage(k, stamp, NOTHING, imu=imu, wheel=wheel)
        begin = time.process_time()
        sensors.feed(image)
        sensors.predict(stamp, last, np.zeros(6))
        last = sensors.corrected(stamp, seen, np.diag(NOISE**2))
        sensors.accept(stamp, last)
        took.append(time.process_time() - begin)
    return 1e3 * float(np.mean(took[2 * RATE :]))
