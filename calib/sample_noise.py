"""White noise of sensors from their samples: of an IMU while the camera stands, of wheels over quiet seconds.

Second differences of successive samples contain white noise with six times its variance, and of anything slow nothing.
"""

from __future__ import annotations

import numpy as np

from stereo_sfm.calib.check import Finding
from stereo_sfm.calib.imu import Imu
from stereo_sfm.calib.wheel import Wheel
from stereo_sfm.geometry import se3
from stereo_sfm.types import F64, I64, ImuSamples

REST_S = 1.0  # of a rest, at least
REST_M, REST_RAD = 5e-3, np.radians(0.3)  # by which poses of images at rest differ
MIN_SAMPLES = 20  # in a rest
LOUD = 3.0, 10.0  # times the calibration's noise: warn, fail


def noise_at_rest(stamp_ns: I64, poses: F64, samples: ImuSamples) -> F64:
    """Noise densities (2,) of gyroscope (rad/s/sqrt(Hz)) and accelerometer (m/s^2/sqrt(Hz)); NaN if nothing rests.

    The quiet rests count: a motor may run in others.

    Args:
        stamp_ns: (N,) of the images. poses: (N, 4, 4) odom_T_cam. samples: uncorrected.
    """
    found = [
        [_density(samples.stamp_ns, values, begin, end) for values in (samples.gyro, samples.accel)]
        for begin, end in _rests(stamp_ns, poses)
    ]
    table = np.array(found, float).reshape(-1, 2)
    return np.array([_lower_quartile(column) for column in table.T])


def noise_of_speeds(stamp_ns: I64, speeds: F64) -> float:
    """Noise density (m/s/sqrt(Hz)) of speeds (N,) with stamps (N,); NaN if they are too few.

    Ticks of the encoders are part of it. Seconds in which nothing turns do not count.
    """
    edges = np.arange(stamp_ns[0], stamp_ns[-1], round(REST_S * 1e9)) if len(stamp_ns) else np.zeros(0, np.int64)
    found = [
        _density(stamp_ns, speeds[:, None], int(begin), int(begin + REST_S * 1e9))
        for begin in edges
        if (np.abs(speeds[(stamp_ns >= begin) & (stamp_ns < begin + REST_S * 1e9)]) > 0).all()
    ]
    return _lower_quartile(np.array(found, float))


def _lower_quartile(values: F64) -> float:
    known = values[np.isfinite(values)]
    return float(np.quantile(known, 0.25)) if len(known) else float("nan")


def _rests(stamp_ns: I64, poses: F64) -> list[tuple[int, int]]:
    """Stamps between which the camera stands, a second each."""
    out: list[tuple[int, int]] = []
    lasts = np.searchsorted(stamp_ns, stamp_ns + round(REST_S * 1e9), "right") - 1
    near = np.linalg.norm(poses[lasts, :3, 3] - poses[:, :3, 3], axis=1) < REST_M
    possible = near & (stamp_ns[lasts] - stamp_ns >= 0.8 * REST_S * 1e9)  # most of a drive is not
    until = 0
    for first in np.flatnonzero(possible).tolist():
        last = int(lasts[first])
        if first < until:
            continue
        moved = se3.inverse(poses[first]) @ poses[first : last + 1]
        metres, radians = np.linalg.norm(moved[:, :3, 3], axis=1), np.linalg.norm(se3.so3_log(moved[:, :3, :3]), axis=1)
        if metres.max() < REST_M and radians.max() < REST_RAD:
            out.append((int(stamp_ns[first]), int(stamp_ns[last])))
            until = last + 1
    return out


def _density(stamp_ns: I64, values: F64, begin_ns: int, end_ns: int) -> float:
    """Of samples (N, 3) with stamps (N,) between two times; NaN where they are too few."""
    rows = (stamp_ns > begin_ns) & (stamp_ns < end_ns) & np.isfinite(values).all(axis=1)
    if rows.sum() < MIN_SAMPLES:
        return float("nan")
    sigma = np.diff(values[rows], 2, axis=0).std(axis=0) / np.sqrt(6.0)
    period_s = float(np.median(np.diff(stamp_ns[rows]))) * 1e-9
    return float(np.sqrt(np.mean(sigma**2) * period_s))


def judge_wheel_noise(noise: float, known: Wheel) -> Finding:
    """Whether a density found in the samples is what a calibration says."""
    if not np.isfinite(noise):
        return Finding("wheels' noise", 0, "the robot drives less than a second: not shown", judged=False)
    ticks = known.tick_m * np.sqrt(5 / 18 * known.rate_hz)  # third differences of a path that is rounded
    stated = float(np.hypot(known.speed_noise, ticks))
    level = sum(noise / stated > limit for limit in LOUD)
    return Finding("wheels' noise", level, f"{noise:.2g} m/s/√Hz (calibration {stated:.2g})")


def judge_noise(noise: F64, known: Imu) -> Finding:
    """Whether densities (2,) found at rest are what a calibration says. A filter with too small a density trusts the
    sensor too much; too much does no harm."""
    if not np.isfinite(noise).any():
        return Finding("IMU noise", 0, "the camera does not stand for a second: not shown", judged=False)
    stated = np.array([known.gyro_noise, known.accel_noise])
    factor = float(np.nanmax(noise / stated))
    level = sum(factor > limit for limit in LOUD)
    said = ", ".join(
        f"{name} {value:.2g} (calibration {of:.2g}) {unit}"
        for name, value, of, unit in zip(
            ("gyroscope", "accelerometer"), noise, stated, ("rad/s/√Hz", "m/s²/√Hz"), strict=True
        )
        if np.isfinite(value)
    )
    return Finding("IMU noise", level, said)
