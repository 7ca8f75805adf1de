"""Radii, track, pose and time offset of wheel odometry, from its samples and the motion that a camera saw."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np

from stereo_sfm.calib.check import Finding
from stereo_sfm.calib.robust_fit import robust_fit, shift_between
from stereo_sfm.calib.sample_noise import judge_wheel_noise, noise_of_speeds
from stereo_sfm.calib.wheel import Wheel
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.twist_integration import integrate_twists
from stereo_sfm.types import F64, I64, Bool, WheelSamples

REACH_S = 0.3  # of the search for the time offset
LINK_S = 2.0  # between the compared poses: the camera's sway is then small against the path
MIN_WAY_M, MIN_TURN = 2.0, 0.5  # m, rad of the whole recording, below which nothing is found
SCALE_PERCENT, TURN_PERCENT, DIRECTION_DEG, OFFSET_MS = (0.2, 1.0), (0.5, 3.0), (0.2, 1.0), (3.0, 20.0)  # known
POSITION_CM = 2.0, 10.0  # the same
WRONG = {  # warn, fail
    "scale": (0.5, 5.0),
    "turns": (2.0, 20.0),
    "direction": (1.0, 5.0),
    "time offset": (15.0, 60.0),
    "position ahead": (5.0, 30.0),
    "position to the left": (5.0, 30.0),
}
REVERSED = -0.5  # correlation of rates
NAMES = ("scale", "difference of the sides", "turns", "direction", "pitch", "time offset", "ahead", "left")
POSITION = slice(6, 8)  # of these
SCALES = np.array([0.01, 0.01, 0.01, 0.01, 0.01, 0.005, 0.01, 0.01])  # typical changes of these
PLACED_SIGMAS = 3.0  # from the calibration's position, below which that is kept


@dataclass(frozen=True, eq=False)
class WheelFit:
    """What the images say of the wheels' calibration."""

    wheel: Wheel  # corrected
    value: F64  # (8,) of NAMES: shares, radians, seconds and metres by which the calibration is off
    sigma: F64  # (8,)
    way_m: float  # by the images
    agreement: float  # share of the path that both agree on, after the correction; 1 at best
    sign: float  # correlation of the motions ahead, negative if the wheels count backwards
    turn_sign: float  # of the turns
    noise: float = float("nan")  # m/s/sqrt(Hz) of the speed ahead


def fit_wheel(stamp_ns: I64, poses: F64, samples: WheelSamples, wheel: Wheel) -> WheelFit:
    """Estimate what the motion shows.

    Args:
        stamp_ns: (N,) of the images. poses: (N, 4, 4) odom_T_cam. samples: of the whole time. wheel: the calibration.

    Raises:
        StereoSfmError: too little motion, or samples that are not of these wheels.
    """
    drive = _Drive.of(stamp_ns, poses, samples, wheel)
    offset, sign, turn_sign = drive.compared_rates()
    if min(sign, turn_sign) < REVERSED:  # there is nothing to correct by small numbers
        unknown = np.full(len(NAMES), np.inf)
        return WheelFit(wheel, np.zeros(len(NAMES)), unknown, drive.way_m, 0.0, sign, turn_sign)
    links = np.searchsorted(drive.at, np.arange(drive.at[0], drive.at[-1], LINK_S))
    motions = se3.inverse(drive.seen[links[:-1]]) @ drive.seen[links[1:]]
    seen = np.column_stack([motions[:, :3, 3], se3.so3_log(motions[:, :3, :3])[:, 2]])
    turning = bool(np.abs(seen[:, 3]).sum() > MIN_TURN)
    free = np.array([True, wheel.model != "twist", turning, True, True, True, turning, turning])

    def residual(x: F64) -> F64:
        return seen - drive.predicted(links, x)

    def fitted(free: Bool, start: F64) -> tuple[F64, F64]:
        """Values and standard deviations; 0 and infinity where a term is not free."""

        def whole(p: F64) -> F64:
            x = np.zeros(len(NAMES))
            x[free] = p
            return x

        fit = robust_fit(lambda p: residual(whole(p)), start[free], SCALES[free])
        sigma = np.full(len(NAMES), np.inf)
        sigma[free] = fit.sigma
        return whole(fit.value), sigma

    value, sigma = fitted(free, np.array([0, 0, 0, 0, 0, offset, 0, 0]))
    as_calibrated = bool((np.abs(value[POSITION]) < PLACED_SIGMAS * sigma[POSITION]).all())
    if turning and as_calibrated:
        free[POSITION] = False
        value, others = fitted(free, value)
        sigma[free] = others[free]
    left = np.linalg.norm(residual(value)[:, :3], axis=1)
    agreement = 1 - float(np.median(left) / np.median(np.linalg.norm(seen[:, :3], axis=1)))
    value[5] -= wheel.offset_s
    return WheelFit(with_wheel_terms(wheel, value), value, sigma, drive.way_m, agreement, sign, turn_sign, drive.noise)


@dataclass(frozen=True, eq=False)
class _Drive:
    """Poses of the wheels by the images and the samples around them, in seconds since the first image."""

    wheel: Wheel
    at: F64  # (N,) of the images
    seen: F64  # (N, 4, 4) odom_T_wheel
    times: F64  # (M,) of the samples, ascending
    samples: WheelSamples

    @staticmethod
    def of(stamp_ns: I64, poses: F64, samples: WheelSamples, wheel: Wheel) -> _Drive:
        """Raises StereoSfmError as `fit_wheel`."""
        good = np.flatnonzero(np.isfinite(wheel.velocities(samples)[0]).all(axis=1))
        if len(good) < 10:
            raise StereoSfmError(f"the samples are not those of {wheel.model} wheels: check the model and its radii")
        stamps, order = np.unique(samples.stamp_ns[good], return_index=True)
        times: F64 = (stamps - int(stamp_ns[0])).astype(np.float64) * 1e-9
        at: F64 = (stamp_ns - int(stamp_ns[0])).astype(np.float64) * 1e-9
        inside = (at > times[0] + REACH_S) & (at < times[-1] - REACH_S)
        found = _Drive(wheel, at[inside], poses[inside] @ wheel.left_T_wheel, times, samples.part(good[order]))
        if found.way_m < MIN_WAY_M:
            short = f"{found.way_m:.2f} m of motion with wheel samples around it"
            raise StereoSfmError(f"{short}: {MIN_WAY_M:g} m are needed, drive farther")
        return found

    @property
    def way_m(self) -> float:
        """Length of the path by the images."""
        return float(np.linalg.norm(np.diff(self.seen[::5, :3, 3], axis=0), axis=1).sum())

    @property
    def noise(self) -> float:
        """Density of the speed ahead, m/s/sqrt(Hz)."""
        return noise_of_speeds(
            np.round(self.times * 1e9).astype(np.int64), self.wheel.velocities(self.samples)[0][:, 0]
        )

    def compared_rates(self) -> tuple[float, float, float]:
        """Time offset in seconds, and the correlations of the speeds ahead and of the turns."""
        steps, seconds = se3.inverse(self.seen[:-1]) @ self.seen[1:], np.diff(self.at)
        rates, ahead = se3.so3_log(steps[:, :3, :3])[:, 2] / seconds, steps[:, 0, 3] / seconds
        middle = 0.5 * (self.at[1:] + self.at[:-1])
        linear, angular = self.wheel.velocities(self.samples)
        turns, speeds = np.nan_to_num(angular[:, 2]), linear[:, 0]
        turning = bool(np.std(rates) > 0.05 and np.std(turns) > 0)
        signal, of_images = (turns, rates) if turning else (speeds, ahead)
        offset = shift_between(lambda t: np.interp(t, self.times, signal), of_images, middle, REACH_S)
        pairs = ((speeds, ahead), (turns, rates))
        signs = [_sign(np.interp(middle + offset, self.times, a), b) for a, b in pairs]
        return offset, signs[0], signs[1]

    def predicted(self, links: I64, x: F64) -> F64:
        """(L, 4) position and turn between images (L + 1,) by the wheels, corrected by x (8,) of NAMES."""
        linear, angular = corrected(self.wheel, x).velocities(self.samples)
        turn, place = se3.so3_exp(np.array([0.0, x[4], x[3]])), np.array([x[6], x[7], 0.0])
        values = np.hstack([linear @ turn.T, np.nan_to_num(angular)])
        ends = self.at[links] + x[5]
        edges = np.sort(np.concatenate([ends, self.times[(self.times > ends[0]) & (self.times < ends[-1])]]))
        at = np.stack([np.interp(edges, self.times, column) for column in values.T], axis=1)
        mean, seconds = 0.5 * (at[1:] + at[:-1]), np.diff(edges)
        out = np.zeros((len(links) - 1, 4))
        for k, (begin, end) in enumerate(itertools.pairwise(np.searchsorted(edges, ends).tolist())):
            moved = integrate_twists(seconds[begin:end], mean[begin:end, 3:], mean[begin:end, :3], 0.0, 0.0)
            out[k, :3] = moved.position + place - moved.rotation @ place
            out[k, 3] = se3.so3_log(moved.rotation)[2]
        return out


def corrected(wheel: Wheel, x: F64) -> Wheel:
    """Wheels with other radii and track, by the first three of NAMES."""
    if wheel.model == "twist":
        return replace(
            wheel, linear_matrix=wheel.linear_matrix * (1 + x[0]), angular_scale=wheel.angular_scale * (1 + x[2])
        )
    sides = 1 + x[0] + np.where(np.arange(len(wheel.radii_m)) % 2, 0.5, -0.5) * x[1]
    radii = tuple((np.array(wheel.radii_m) * sides).tolist())
    return replace(wheel, radii_m=radii, track_m=wheel.track_m / (1 + x[2]), wheelbase_m=wheel.wheelbase_m / (1 + x[2]))


def with_wheel_terms(wheel: Wheel, x: F64) -> Wheel:
    """A calibration corrected by terms (8,) of NAMES."""
    place = np.array([x[6], x[7], 0.0])
    turn = se3.from_rotation_translation(se3.so3_exp(np.array([0.0, x[4], x[3]])), place)
    return replace(corrected(wheel, x), left_T_wheel=wheel.left_T_wheel @ turn, offset_s=wheel.offset_s + float(x[5]))


def _sign(a: F64, b: F64) -> float:
    return float(a @ b / (np.linalg.norm(a) * np.linalg.norm(b) + 1e-12))


def judge_wheel(found: WheelFit, known: Wheel) -> list[Finding]:
    """Whether a calibration agrees with what the images say, and what to correct."""
    if found.sign < REVERSED:
        return [Finding("wheels", 2, "they count backwards: reverse their sign")]
    if found.turn_sign < REVERSED:
        return [Finding("wheels", 2, "they turn in the opposite direction to the camera: exchange left and right")]
    percent, degrees, ms = 100.0, float(np.degrees(1.0)), 1e3
    rows = (
        ("scale", 0, percent, "%", SCALE_PERCENT),
        ("turns", 2, percent, "%", TURN_PERCENT),
        ("direction", 3, degrees, "°", DIRECTION_DEG),
        ("time offset", 5, ms, " ms", OFFSET_MS),
        ("position ahead", 6, percent, " cm", POSITION_CM),
        ("position to the left", 7, percent, " cm", POSITION_CM),
    )
    level = 0 if found.agreement > 0.9 else 1 if found.agreement > 0.7 else 2
    out = [
        Finding("wheels", level, f"agree with the images in {100 * found.agreement:.1f} % of the path after correction")
    ]
    for name, k, unit, text, sure in rows:
        value, sigma = float(found.value[k] * unit), float(found.sigma[k] * unit)
        level = sum(abs(value) > max(limit, 3 * sigma) for limit in WRONG[name])
        what = (
            f"{value:+.2f} ± {sigma:.2f}{text} from the calibration"
            if np.isfinite(sigma)
            else "not shown by the motion"
        )
        out.append(Finding(f"wheels' {name}", level, what, sigma < sure[1], (value,), (sigma,)))
    return [*out, judge_wheel_noise(found.noise, known)]


def precision_wheel(found: WheelFit) -> list[Finding]:
    """How well a recording determined the calibration."""
    if found.sign < REVERSED or found.turn_sign < REVERSED:
        return judge_wheel(found, found.wheel)
    wheel, percent = found.wheel, 100 * found.sigma[:3]
    radii = ", ".join(f"{1e3 * r:.2f}" for r in wheel.radii_m)
    size = f"radii {radii} mm" if radii else f"velocities times {np.linalg.norm(wheel.linear_matrix, 2):.4f}"
    turns = f"track {1e3 * wheel.track_m:.1f} mm" if radii else f"turns times {wheel.angular_scale:.4f}"
    degrees, ms = float(np.degrees(found.sigma[3])), float(1e3 * found.sigma[5])
    rows = (
        ("scale", percent[0], SCALE_PERCENT, f"{size}, known to {percent[0]:.2f} %"),
        ("turns", percent[2], TURN_PERCENT, f"{turns}, known to {percent[2]:.2f} %"),
        ("direction", degrees, DIRECTION_DEG, f"{np.degrees(found.value[3]):+.2f} ± {degrees:.2f}°"),
        ("time offset", ms, OFFSET_MS, f"{1e3 * wheel.offset_s:+.1f} ± {ms:.1f} ms"),
    )
    for name, k in (("position ahead", 6), ("position to the left", 7)):
        value, sigma = float(100 * found.value[k]), float(100 * found.sigma[k])
        text = f"{value:+.1f} ± {sigma:.1f} cm" if np.isfinite(sigma) else "not shown by the motion"
        rows = (*rows, (name, sigma, POSITION_CM, text))
    levels = [sum(not sigma <= limit for limit in known) for _, sigma, known, _ in rows]
    return [Finding(f"wheels' {row[0]}", min(level, 1), row[3]) for row, level in zip(rows, levels, strict=True)]
