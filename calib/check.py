"""Checks a calibration with any recording, without a target: row errors by region, the correction that a small bundle
adjustment estimates, and a verdict with its reasons."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from stereo_sfm.calib.amount import FOCAL_BOTH, FOCAL_RATIO, TURN
from stereo_sfm.calib.choice import Choice, choose
from stereo_sfm.calib.consequences import Consequences, consequences
from stereo_sfm.calib.consistency import Correction, estimate
from stereo_sfm.calib.rectification import Rectification
from stereo_sfm.calib.rig import Rig
from stereo_sfm.calib.scene_model import DIRECTION, SKEW
from stereo_sfm.calib.tracks import MIN_POINTS, Window
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.types import F64, I64, Bool

GRID = (4, 5)  # rows and columns of regions
VERDICTS = ("PASS", "WARN", "FAIL")


@dataclass(frozen=True)
class Finding:
    """The result of one check."""

    name: str
    level: int  # index into VERDICTS
    text: str
    judged: bool = True  # False: the recording does not contain the motion or points that the check needs
    value: tuple[float, ...] = ()  # the estimated correction, in the text's unit
    sigma: tuple[float, ...] = ()  # its standard deviation

    @property
    def verdict(self) -> str:
        """PASS, WARN or FAIL; empty if not judged."""
        return VERDICTS[self.level] if self.judged or self.level else ""


@dataclass(frozen=True, eq=False)
class CheckReport:
    """All checks of a calibration."""

    findings: tuple[Finding, ...]
    matches: int
    windows: int
    region_median: F64  # (4, 5) px row error, NaN where fewer than 8 matches
    region_count: I64  # (4, 5)
    correction: Correction
    choice: Choice  # its significant terms
    consequences: Consequences  # of not applying them

    @property
    def level(self) -> int:
        """Level of the worst finding, index into VERDICTS."""
        return max(f.level for f in self.findings)

    @property
    def verdict(self) -> str:
        """PASS, WARN or FAIL."""
        return VERDICTS[self.level]


@dataclass(frozen=True)
class Limit:
    """Absolute values above which a check warns and fails, if the value is also significant."""

    warn: float
    fail: float
    deviations: float  # standard deviations from zero that make a value significant


# benchmarks/check_calib.py checks these limits with known errors added to good calibrations.
DISPARITY_PX = Limit(0.5, 1.0, 2.5)
LENGTH_PERCENT = Limit(1.5, 4.0, 0.0)
SYSTEMATIC_PX = Limit(0.5, 0.75, 0.0)
ROTATION_DEG = Limit(0.08, 0.11, 2.5)
DIRECTION_DEG = Limit(1.5, 3.0, 4.0)
FOCAL_PERCENT = Limit(1.0, 1.0, 2.5)
FOCAL_RIGHT_PERCENT = Limit(0.4, 1.0, 4.0)
SKEW_MS = Limit(0.5, 2.0, 5.0)
UNKNOWN = "cannot be judged from this recording: move the camera"
ROLLING = "cannot be judged with a rolling shutter"


def check(rig: Rig, rectification: Rectification, windows: list[Window], rolling: bool = False) -> CheckReport:
    """Judge `rig` by windows collected through its rectification.

    `rolling`: rolling shutter; parameters that only motion determines are not judged then.

    Raises:
        StereoSfmError: too few matches.
    """
    total = sum(len(w.rows) for w in windows)
    if total < 40:
        raise StereoSfmError(
            f"only {total} stereo matches in all images: too dark, too little texture, swapped cameras, or a wrong"
            " calibration"
        )
    correction = replace(estimate(rig, windows), rolling=rolling)
    good = np.concatenate(correction.explained)
    good = good if good.sum() >= MIN_POINTS else np.ones(total, bool)
    left = np.concatenate([w.rows.left for w in windows])[good]
    error = np.concatenate([w.rows.row_error for w in windows])[good]
    median, count = regions(left, error, rectification.rig.left.size)
    choice = choose(correction.whole, correction.halves, rolling)
    effect = consequences(rig, choice.apply(rig), windows)
    findings = (
        _distances(rig, choice, effect),
        _rows(error, median, count),
        _baseline(rig),
        *_judged(correction),
    )
    return CheckReport(findings, total, len(windows), median, count, correction, choice, effect)


def regions(left: F64, error: F64, size: tuple[int, int]) -> tuple[F64, I64]:
    """Median row error and number of matches by image region.

    Args:
        left: (N, 2) rectified px. error: (N,) px. size: (width, height).
    """
    rows, columns = GRID
    column = np.clip((left[:, 0] * columns / size[0]).astype(int), 0, columns - 1)
    row = np.clip((left[:, 1] * rows / size[1]).astype(int), 0, rows - 1)
    median, count = np.full(GRID, np.nan), np.zeros(GRID, np.int64)
    for r in range(rows):
        for c in range(columns):
            here = (row == r) & (column == c)
            count[r, c] = here.sum()
            if count[r, c] >= 8:
                median[r, c] = np.median(error[here])
    return median, count


def level_of(value: float, sigma: float, limit: Limit) -> int:
    """0 pass, 1 warn, 2 fail."""
    if abs(value) < limit.deviations * sigma:
        return 0
    return 2 if abs(value) > limit.fail else 1 if abs(value) > limit.warn else 0


def _distances(rig: Rig, choice: Choice, effect: Consequences) -> Finding:
    """Effect of the significant terms on distances and on the trajectory's length if they are not corrected."""
    sigma = rig.left.fx * float(choice.sigma[1])
    text = f"disparity off by {effect.disparity_px:+.2f} +- {sigma:.2f} px"
    if not choice.selected.any():
        return Finding("distances", 0, f"no significant error; disparity known to {sigma:.2f} px")
    level = max(level_of(effect.disparity_px, sigma, DISPARITY_PX), level_of(100 * effect.length, 0.0, LENGTH_PERCENT))
    return Finding("distances", level, f"{text}: {effect.text}", True, (effect.disparity_px,), (sigma,))


def _rows(error: F64, median: F64, count: I64) -> Finding:
    known = np.isfinite(median)
    if known.any():
        weight = np.sqrt(count[known])
        systematic = float(np.sqrt((median[known] ** 2 * weight).sum() / weight.sum()))
        worst = float(np.nanmax(np.abs(median)))
    else:
        systematic = worst = float(abs(np.median(error)))
    text = (
        f"median {np.median(error):+.2f} px, absolute median {np.median(np.abs(error)):.2f} px;"
        f" systematic part {systematic:.2f} px, worst region {worst:.2f} px"
    )
    return Finding("row error", level_of(systematic, 0.0, SYSTEMATIC_PX), text)


def _baseline(rig: Rig) -> Finding:
    x, y, z = rig.left_T_right[:3, 3]
    length = rig.baseline
    level, remark = 0, ""
    if length < 0.005 or length > 3.0:
        level, remark = 2, ": not a length in metres (millimetres or centimetres?)"
    elif length < 0.02 or length > 1.0 or np.hypot(y, z) > 0.3 * abs(x):
        level, remark = 1, ": unusual, compare with the device"
    return Finding(
        "baseline", level, f"{length * 1000:.1f} mm ({x * 1000:+.1f}, {y * 1000:+.1f}, {z * 1000:+.1f}){remark}"
    )


def _judged(correction: Correction) -> list[Finding]:
    amount, sigma, still = correction.amount, correction.amount_sigma, not correction.rolling
    why = UNKNOWN if still else ROLLING
    turn = np.rad2deg(amount[TURN]), np.rad2deg(sigma[TURN])
    shown = (turn[1] < 0.06) & np.array([True, still, True])
    rotation = _measured("rotation between the cameras", *turn, ROTATION_DEG, "degrees", shown, "xyz", why)
    along = np.rad2deg(correction.vector[DIRECTION]), np.rad2deg(correction.sigma[DIRECTION])
    direction = _measured("baseline direction", *along, DIRECTION_DEG, "degrees", (along[1] < 1.1) & still, "yz", why)
    ratio = 100 * amount[[FOCAL_RATIO]], 100 * sigma[[FOCAL_RATIO]]
    right = _measured("focal length, right relative to left", *ratio, FOCAL_RIGHT_PERCENT, "%", ratio[1] < 0.4)
    both = 100 * amount[[FOCAL_BOTH]], 100 * sigma[[FOCAL_BOTH]]
    shown = np.array([correction.shows_focal])
    common = _measured("focal length, both cameras", *both, FOCAL_PERCENT, "%", shown, why=why)
    skew = 1e3 * correction.vector[[SKEW]], 1e3 * correction.sigma[[SKEW]]
    time = _measured("time skew of the right camera", *skew, SKEW_MS, "ms", skew[1] < 1.0)
    return [rotation, replace(direction, level=min(direction.level, 1)), right, common, time]


def _measured(
    name: str, value: F64, sigma: F64, limit: Limit, unit: str, known: Bool, axes: str = "", why: str = UNKNOWN
) -> Finding:
    """A finding about a parameter's estimated correction and its standard deviation.

    Args:
        value: (K,) in `unit`. sigma: (K,). known: (K,) whether the recording determines it. axes: K letters.
        why: text for the components that it does not determine.
    """
    levels = [level_of(float(v), float(s), limit) for v, s in zip(value[known], sigma[known], strict=True)]
    text = f"off by {_list(value)} +- {_list(sigma, '')} {unit}" + (f" ({' '.join(axes)})" if axes else "")
    if not known.all():
        which = " and ".join(a for a, k in zip(axes, known, strict=True) if not k) + " " if axes else ""
        text += f" ({which}{why})"
    values, deviations = tuple(float(v) for v in value), tuple(float(s) for s in sigma)
    return Finding(name, max(levels, default=0), text, bool(known.all()), values, deviations)


def _list(values: F64, sign: str = "+") -> str:
    texts = [f"{v:{sign}.3f}" if abs(v) < 1 else f"{v:{sign}.2f}" for v in values]
    return texts[0] if len(texts) == 1 else "(" + ", ".join(texts) + ")"
