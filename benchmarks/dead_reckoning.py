"""IMU and wheels without images: five seconds of darkness on simulated drives, and minutes at rest.

    python benchmarks/dead_reckoning.py [--seeds 10] [--rest 20]

Before the dark the sensors get the pose of each image, half a millimetre and a tenth of a milliradian off; nothing
is rendered, so that many seeds take seconds. "error" is that of the pose at the end of the dark, median and
largest over the seeds, "expected" the median of its own standard deviation. At rest each image is a third of a
millimetre and a twentieth of a milliradian off, and every second new points are seen from its pose, with that error.
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np
from _sequences import one_thread

one_thread()

from stereo_sfm.config import Config
from stereo_sfm.drivers.options import read_options
from stereo_sfm.drivers.sim.options import SimOptions
from stereo_sfm.drivers.sim.scenes import SCENES
from stereo_sfm.drivers.sim.source import SimSource
from stereo_sfm.geometry import se3
from stereo_sfm.tracking.inertial.motion_sensors import MotionSensors
from stereo_sfm.types import F64, StereoImage

RATE = 15  # images a second
DARK_S = 5
STARTS = {"aisle": 22.0, "two corners": 10.0}  # seconds at which the light goes out
SENSORS: dict[str, dict[str, Any]] = {
    "IMU (T265)": {"imu": "t265"},
    "IMU (OAK)": {"imu": "oak"},
    "wheels": {"wheel": "differential"},
    "IMU and wheels": {"imu": "t265", "wheel": "differential"},
    "IMU and mecanum": {"imu": "t265", "wheel": "mecanum"},
    "IMU and wheels, 30 % slip": {"imu": "t265", "wheel": "differential", "wheel_slip": 0.3},
}
NOTHING = np.zeros((1, 1), np.uint8)


def opened(seed: int, **options: Any) -> tuple[SimSource, MotionSensors, F64]:
    """A drive, its sensors, and the poses (N, 4, 4) of its images."""
    given = read_options(SimOptions, "sim", {"size": "106x100", "rate": RATE, "seed": seed, **options})
    source = SimSource("loop", SCENES["loop"], given)
    sensors = MotionSensors.of(Config().tracker, source.rig)
    assert sensors is not None
    poses = source.drive.poses(source.frame_ids / RATE)
    return source, sensors, se3.inverse(poses[0]) @ poses


def feed(source: SimSource, sensors: MotionSensors, frame_id: int) -> int:
    """The samples up to an image; its stamp."""
    stamp = source.stamp_ns(frame_id)
    imu, wheel = source.sampled(frame_id)
    sensors.feed(StereoImage(frame_id, stamp, NOTHING, imu=imu, wheel=wheel))
    return stamp


def dark(seed: int, start_s: float, options: dict[str, Any]) -> tuple[float, float, float] | None:
    """Error in metres, expected error, error in degrees at the end of the dark; None if no pose was left."""
    source, sensors, poses = opened(seed, **options)
    rng, last = np.random.default_rng(seed), int((start_s + DARK_S) * RATE)
    stamp = 0
    for k in range(last + 1):
        stamp = feed(source, sensors, k)
        if k < start_s * RATE:
            noise = rng.normal(0, 1, 6) * [5e-4, 5e-4, 5e-4, 1e-4, 1e-4, 1e-4]
            sensors.accept(stamp, poses[k] @ se3.exp(noise))
    bridge = sensors.bridge(stamp)
    if bridge is None:
        return None
    off = se3.log(se3.inverse(bridge[0]) @ poses[last])
    expected = float(np.sqrt(np.trace(bridge[1][:3, :3])))
    return float(np.linalg.norm(off[:3])), expected, float(np.degrees(np.linalg.norm(off[3:])))


def rest(seed: int, seconds: int, options: dict[str, Any], hold: bool) -> tuple[float, float]:
    """Largest movement in metres and degrees from the second second on."""
    source, sensors, poses = opened(seed, rest=seconds + 10.0, vibration=0.0, **options)
    rng, offset, found = np.random.default_rng(seed), np.eye(4), list[F64]()
    for k in range(seconds * RATE):
        stamp = feed(source, sensors, k)
        seen = offset @ poses[k] @ se3.exp(rng.normal(0, 1, 6) * [3e-4, 3e-4, 3e-4, 5e-5, 5e-5, 5e-5])
        found.append(sensors.settled(stamp, seen) if hold else seen)
        sensors.accept(stamp, found[-1])
        if k % RATE == 0:
            offset = found[-1] @ se3.inverse(poses[k])
    metres, radians = se3.extent(se3.inverse(found[2 * RATE]) @ np.array(found[2 * RATE :]))
    return float(np.max(metres)), float(np.degrees(np.max(radians)))


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--rest", type=int, default=20, metavar="MINUTES", help="0: not measured")
    args = parser.parse_args()
    seeds = range(args.seeds)
    print("| dark | sensors | poses left | error, median | largest | expected | turned, largest |\n|" + "---|" * 7)
    for place, start in STARTS.items():
        for name, options in SENSORS.items():
            rows = [row for seed in seeds if (row := dark(seed, start, options)) is not None]
            text = f"| {place} | {name} | {len(rows)} of {len(seeds)} | "
            if rows:
                error, expected, turned = np.array(rows).T
                text += (
                    f"{100 * np.median(error):.1f} cm | {100 * error.max():.1f} cm | {100 * np.median(expected):.1f} cm"
                )
                text += f" | {turned.max():.2f}° |"
            print(text if rows else text + "– | – | – | – |", flush=True)
    if not args.rest:
        return
    print(f"\n| {args.rest} minutes at rest | sensors | movement | turn |\n|" + "---|" * 4)
    for hold in (True, False):
        for name in ("IMU (T265)", "IMU and wheels"):
            metres, degrees = rest(0, 60 * args.rest, SENSORS[name], hold)
            what = "held" if hold else "not held"
            print(f"| {what} | {name} | {1e3 * metres:.2f} mm | {degrees:.4f}° |", flush=True)


if __name__ == "__main__":
    main()
