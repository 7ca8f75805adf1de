"""Time offset and rotation of an IMU, from its samples and the motion that a camera saw."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from stereo_sfm.calib.check import Finding
from stereo_sfm.calib.force_fit import Forces
from stereo_sfm.calib.imu import Imu
from stereo_sfm.calib.robust_fit import Whitening, robust_fit, shift_between
from stereo_sfm.calib.sample_noise import judge_noise, noise_at_rest
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.procrustes import rotation_between
from stereo_sfm.types import F64, I64, ImuSamples

REACH_S = 0.3  # of the search for the time offset
MIN_FRAMES = 60
CLIP = 3.0  # standard deviations of an error
MIN_TURN = 0.03  # rad/s, root mean square, below which a rotation shows nothing
OFFSET_MS, ROTATION_DEG = (0.5, 3.0), (0.1, 1.0)  # standard deviations: known well, known at all
WRONG_OFFSET_MS, WRONG_ROTATION_DEG = (3.0, 20.0), (1.0, 5.0)  # differences that warn and fail
GRAVITY_RANGE = 9.3, 10.3  # m/s^2
MEAN_S = 0.5  # of forces: vibration averages out, and the device hardly tilts


@dataclass(frozen=True, eq=False)
class ImuFit:
    """What the images say of an IMU's calibration."""

    imu: Imu  # corrected
    offset_sigma_s: float
    rotation_sigma: F64  # (3,) rad about the camera's axes
    turned: float  # angle in radians from the calibration's rotation
    scale: float  # rates of the gyroscope over those of the images
    gyro_bias: F64  # (3,) rad/s, subtracted from corrected samples
    agreement: float  # correlation of the rates, 1 at best
    gravity: float  # m/s^2, of the accelerometer, see `mean_force`
    noise: F64  # (2,) densities while the camera stood, see `noise_at_rest`


def fit_imu(stamp_ns: I64, poses: F64, samples: ImuSamples, imu: Imu) -> ImuFit:
    """Estimate offset and rotation; positions, scales and noise stay as they are.

    Args:
        stamp_ns: (N,) of the images. poses: (N, 4, 4) odom_T_cam. samples: of the whole time. imu: the calibration.

    Raises:
        StereoSfmError: too few images or samples, or no rotation.
    """
    rates = _Rates.of(stamp_ns, poses, samples, imu)
    offset = rates.offset()
    start = rotation_between(rates.turned(offset), rates.turns)
    scale = float(np.linalg.norm(rates.turned(offset)) / np.linalg.norm(rates.turns))

    def turns(x: F64) -> F64:
        seen = (rates.turned(x[3]) / (scale * (1 + x[7])) - x[4:7] * rates.seconds) @ (se3.so3_exp(x[:3]) @ start).T
        return rates.turns - seen

    scales = np.array([0.01, 0.01, 0.01, 0.001, 0.01, 0.01, 0.01, 0.01])
    fit = robust_fit(turns, np.array([0, 0, 0, offset, 0, 0, 0, 0]), scales)
    pose_sigma = rotation_sigma(turns(fit.value))
    white_turns = _turn_whitening(turns(fit.value), pose_sigma)
    forces = rates.forces(float(fit.value[3]))
    if forces is None:
        fit = robust_fit(lambda x: white_turns(turns(x)), fit.value, scales)
    else:

        def pushes(x: F64) -> F64:
            return forces.residual(se3.so3_exp(x[:3]) @ start, x[8:11], x[11:])

        begin = np.concatenate([fit.value, np.zeros(3), imu.left_T_imu[:3, 3]])
        scales = np.concatenate([scales, [0.1, 0.1, 0.1, 0.05, 0.05, 0.05]])
        white_pushes = forces.whitening(pushes(begin), imu, pose_sigma)
        fit = robust_fit(
            lambda x: np.column_stack([white_turns(turns(x))[1:-1], white_pushes(pushes(x))]), begin, scales
        )
    left_R_imu = se3.so3_exp(fit.value[:3]) @ start
    left_T_imu = se3.from_rotation_translation(left_R_imu, imu.left_T_imu[:3, 3])
    change = se3.so3_log(imu.left_T_imu[:3, :3].T @ left_R_imu)
    unexplained = np.median(turns(fit.value) ** 2) / np.median(rates.turns**2)
    return ImuFit(
        imu=replace(imu, left_T_imu=left_T_imu, offset_s=float(fit.value[3])),
        offset_sigma_s=float(fit.sigma[3]),
        rotation_sigma=fit.sigma[:3],
        turned=float(np.linalg.norm(change)),
        scale=scale * float(1 + fit.value[7]),
        gyro_bias=fit.value[4:7],
        agreement=float(np.sqrt(max(0.0, 1 - unexplained))),
        gravity=rates.gravity,
        noise=noise_at_rest(stamp_ns, poses, samples),
    )


def imu_terms(found: ImuFit, known: Imu) -> F64:
    """(4,) by which a calibration differs from what was found: rotation about the IMU's axes (radians), offset (s)."""
    turn = se3.so3_log(known.left_T_imu[:3, :3].T @ found.imu.left_T_imu[:3, :3])
    return np.append(turn, found.imu.offset_s - known.offset_s)


def with_imu_terms(imu: Imu, terms: F64) -> Imu:
    """A calibration corrected by `imu_terms` (4,)."""
    turn = se3.from_rotation_translation(se3.so3_exp(terms[:3]), np.zeros(3))
    return replace(imu, left_T_imu=imu.left_T_imu @ turn, offset_s=imu.offset_s + float(terms[3]))


def rotation_sigma(steps: F64) -> float:
    """Radians by which a pose is off by itself: an error of a step (N, 3) that returns, negated, in the next one."""
    limit = CLIP * 1.4826 * np.median(np.abs(steps), axis=0)
    clipped = np.clip(steps, -limit, limit)
    return float(np.sqrt(max(-np.mean(clipped[1:] * clipped[:-1]), 0.0)))


def _turn_whitening(steps: F64, pose_sigma: float) -> Whitening:
    variance = float(np.mean((1.4826 * np.median(np.abs(steps), axis=0)) ** 2))
    shared = min(pose_sigma**2, 0.48 * variance)
    return Whitening(np.array([variance, -shared]))


@dataclass(frozen=True, eq=False)
class _Rates:
    """Rotations of the camera between images and the gyroscope's samples, in seconds since the first image."""

    at: F64  # (N,) of the images
    turns: F64  # (N - 1, 3) rad, camera axes
    times: F64  # (M,) of the samples, ascending
    gyro: F64  # (M, 3) rad/s
    total: F64  # (M, 3) rad, its integral
    poses: F64  # (N, 4, 4) odom_T_cam
    force_times: F64  # (L,) of the accelerometer's samples, ascending
    force: F64  # (L, 3) m/s^2

    @staticmethod
    def of(stamp_ns: I64, poses: F64, samples: ImuSamples, imu: Imu) -> _Rates:
        """Raises StereoSfmError as `fit_imu`."""
        (times, gyro), (force_times, force) = (
            _ordered(samples.stamp_ns - stamp_ns[0], values) for values in imu.correct(samples.gyro, samples.accel)
        )
        at = (stamp_ns - stamp_ns[0]).astype(np.float64) * 1e-9
        inside = (at > times[0] + REACH_S) & (at < times[-1] - REACH_S) if len(times) else np.zeros(len(at), bool)
        if inside.sum() < MIN_FRAMES:
            raise StereoSfmError(
                f"only {int(inside.sum())} images lie within IMU samples, {MIN_FRAMES} are needed: record longer"
            )
        at, poses = at[inside], poses[inside]
        turns = se3.so3_log(np.swapaxes(poses[:-1, :3, :3], 1, 2) @ poses[1:, :3, :3])
        if np.sqrt(np.mean((turns / np.diff(at)[:, None]) ** 2)) < MIN_TURN / 3**0.5:
            raise StereoSfmError("the camera hardly turns in this recording: turn it about all axes")
        steps = 0.5 * (gyro[1:] + gyro[:-1]) * np.diff(times)[:, None]
        total = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
        return _Rates(at, turns, times, gyro, total, poses, force_times, force)

    @property
    def seconds(self) -> F64:
        """(N - 1, 1) between images."""
        return np.diff(self.at)[:, None]

    def turned(self, offset: float) -> F64:
        """(N - 1, 3) integral of the gyroscope between the images."""
        return np.diff(np.stack([np.interp(self.at + offset, self.times, c) for c in self.total.T], axis=1), axis=0)

    def offset(self) -> float:
        """Seconds at which the sizes of the rates agree best."""
        size, seen = np.linalg.norm(self.gyro, axis=1), np.linalg.norm(self.turns / self.seconds, axis=1)
        middle = 0.5 * (self.at[1:] + self.at[:-1])
        return shift_between(lambda t: np.interp(t, self.times, size), seen, middle, REACH_S)

    def forces(self, offset: float) -> Forces | None:
        """What the accelerometer says, with a time offset; None if it is none, or says too little."""
        if not GRAVITY_RANGE[0] < self.gravity < GRAVITY_RANGE[1]:
            return None
        return Forces.of(self.at, self.poses, self.force_times - offset, self.force)

    @property
    def gravity(self) -> float:
        """m/s^2, see `mean_force`."""
        return mean_force(self.force_times, self.force)


def mean_force(times: F64, force: F64) -> float:
    """m/s^2: median size of the means (3,) over `MEAN_S`; NaN without samples. Of a tilting device, a longer mean would
    be too small.

    Args:
        times: (L,) seconds, ascending. force: (L, 3) m/s^2.
    """
    if not len(force):
        return float("nan")
    begins = np.unique((times - times[0]) // MEAN_S, return_index=True)[1]
    counts = np.diff(begins, append=len(force))
    return float(np.median(np.linalg.norm(np.add.reduceat(force, begins) / counts[:, None], axis=1)))


def _ordered(stamp_ns: I64, values: F64) -> tuple[F64, F64]:
    """Seconds (M,), ascending, and finite values (M, 3) of samples."""
    good = np.flatnonzero(np.isfinite(values).all(axis=1))
    stamps, order = np.unique(stamp_ns[good], return_index=True)
    return stamps.astype(np.float64) * 1e-9, values[good[order]]


def judge_imu(found: ImuFit, known: Imu) -> list[Finding]:
    """Whether a calibration agrees with what the images say, and what to correct."""
    degrees, sigma_deg = np.degrees(found.turned), np.degrees(found.rotation_sigma)
    off_ms, sigma_ms = 1e3 * (found.imu.offset_s - known.offset_s), 1e3 * found.offset_sigma_s
    out: list[Finding] = []
    if found.agreement < 0.5:
        text = "its rates are not those of the images: another sensor's data, or left- and right-handed axes mixed"
        return [Finding("gyroscope", 2, text)]
    units = "degrees instead of radians?" if 30 < found.scale < 90 else "check units and scale"
    wrong = abs(found.scale - 1) > 0.05
    rates = f"rates {found.scale:.3f} times those of the images" + (f": {units}" if wrong else "")
    out.append(Finding("gyroscope", 2 if wrong else 0, rates))
    worst = float(sigma_deg.max())
    sure = worst < ROTATION_DEG[1]
    level = sum(degrees > max(limit, 3 * worst) for limit in WRONG_ROTATION_DEG)
    axes = ": axes are exchanged or reversed" if degrees > 45 else ""
    text = f"turned by {degrees:.2f}° against the calibration{axes}, known to {worst:.2f}°"
    out.append(Finding("IMU rotation", level, text, sure, (degrees,), (worst,)))
    level = sum(abs(off_ms) > max(limit, 3 * sigma_ms) for limit in WRONG_OFFSET_MS)
    text = f"offset {1e3 * found.imu.offset_s:+.2f} ms, {off_ms:+.2f} ± {sigma_ms:.2f} ms from the calibration"
    out.append(Finding("IMU time offset", level, text, sigma_ms < OFFSET_MS[1], (off_ms,), (sigma_ms,)))
    if np.isfinite(found.gravity):
        low, high = GRAVITY_RANGE
        units = " (in g?)" if 0.5 < found.gravity < 2 else ""
        level = 0 if low < found.gravity < high else 2
        out.append(Finding("accelerometer", level, f"mean force {found.gravity:.2f} m/s^2{units}"))
    return [*out, judge_noise(found.noise, known)]


def precision_imu(found: ImuFit) -> list[Finding]:
    """How well a recording determined the calibration."""
    degrees, ms = float(np.degrees(found.rotation_sigma).max()), 1e3 * found.offset_sigma_s
    axes = ", ".join(f"{v:+.2f}" for v in np.degrees(se3.so3_log(found.imu.left_T_imu[:3, :3])))
    return [
        Finding(
            "gyroscope", 0 if abs(found.scale - 1) < 0.02 else 2, f"rates {found.scale:.3f} times those of the images"
        ),
        Finding(
            "IMU rotation", _level(degrees, ROTATION_DEG), f"({axes})° in the left camera, known to {degrees:.3f}°"
        ),
        Finding("IMU time offset", _level(ms, OFFSET_MS), f"{1e3 * found.imu.offset_s:+.2f} ± {ms:.2f} ms"),
    ]


def _level(sigma: float, known: tuple[float, float]) -> int:
    return sum(not sigma <= limit for limit in known)
