"""Is this calibration good? Judged from any recording, without a target: row errors by region, what a small bundle
adjustment would change, and a verdict with its reasons."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.consistency import Correction, estimate
from calib.rectification import Rectification
from calib.rig import Rig
from calib.scene_model import DIRECTION, FOCAL, FOCAL_RIGHT, ROTATION, SKEW
from calib.tracks import Window
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.types import F64, I64

GRID = (4, 5)  # rows and columns of regions
VERDICTS = ("PASS", "WARN", "FAIL")


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at."""

    name: str
    level: int  # index into VERDICTS
    text: str


@dataclass(frozen=True, eq=False)
class CheckReport:
    """The answer."""

    findings: tuple[Finding, ...]
    matches: int
    windows: int
    region_median: F64  # (4, 5) px row error, NaN where fewer than 8 matches
    region_count: I64  # (4, 5)
    correction: Correction

    @property
    def level(self) -> int:
        """The worst finding's."""
        return max(f.level for f in self.findings)

    @property
    def verdict(self) -> str:
        """PASS, WARN or FAIL."""
        return VERDICTS[self.level]


@dataclass(frozen=True)
class Limit:
    """A value warns above `warn` and fails above `fail`, when it is also that many deviations from zero."""

    warn: float
    fail: float
    deviations: float


SYSTEMATIC_PX = Limit(0.3, 0.75, 0.0)
ROTATION_DEG = Limit(0.10, 0.16, 3.0)
DIRECTION_DEG = Limit(1.0, 3.0, 4.0)
FOCAL_PERCENT = Limit(0.6, 1.2, 3.0)
FOCAL_RIGHT_PERCENT = Limit(0.4, 1.0, 4.0)
SKEW_MS = Limit(0.5, 2.0, 5.0)


def check(rig: Rig, rectification: Rectification, windows: list[Window]) -> CheckReport:
    """Judge `rig` by windows collected through its rectification.

    Raises:
        StereoSfmError: too few matches to say anything.
    """
    left = np.concatenate([w.rows.left for w in windows]) if windows else np.zeros((0, 2))
    if len(left) < 40:
        raise StereoSfmError(
            f"only {len(left)} stereo matches in the whole source: too dark, too plain, swapped eyes, or a calibration"
            " so wrong that nothing matches"
        )
    error = np.concatenate([w.rows.row_error for w in windows])
    median, count = regions(left, error, rectification.rig.left.size)
    correction = estimate(rig, windows)
    findings = (
        _rows(error, median, count),
        _baseline(rig),
        *_judged(correction),
    )
    return CheckReport(findings, len(left), len(windows), median, count, correction)


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


def _rows(error: F64, median: F64, count: I64) -> Finding:
    known = np.isfinite(median)
    if known.any():
        weight = np.sqrt(count[known])
        systematic = float(np.sqrt((median[known] ** 2 * weight).sum() / weight.sum()))
        worst = float(np.nanmax(np.abs(median)))
    else:
        systematic = worst = float(abs(np.median(error)))
    text = (
        f"median {np.median(error):+.2f} px, of its size {np.median(np.abs(error)):.2f} px;"
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
    vector, sigma = correction.vector, correction.sigma
    out: list[Finding] = []
    rotation, deviation = np.rad2deg(vector[ROTATION]), np.rad2deg(sigma[ROTATION])
    level = max(level_of(float(v), float(s), ROTATION_DEG) for v, s in zip(rotation, deviation, strict=True))
    out.append(
        Finding("rotation between the eyes", level, f"off by {_list(rotation)} +- {_list(deviation)} degrees (x y z)")
    )
    direction, deviation = np.rad2deg(vector[DIRECTION]), np.rad2deg(sigma[DIRECTION])
    level = max(level_of(float(v), float(s), DIRECTION_DEG) for v, s in zip(direction, deviation, strict=True))
    out.append(
        Finding("baseline direction", min(level, 1), f"off by {_list(direction)} +- {_list(deviation)} degrees (y z)")
    )
    ratio, deviation = 100 * vector[FOCAL_RIGHT], 100 * sigma[FOCAL_RIGHT]
    level = level_of(float(ratio), float(deviation), FOCAL_RIGHT_PERCENT)
    out.append(Finding("focal length, right against left", level, f"off by {ratio:+.2f} +- {deviation:.2f} %"))
    # The focal length of both eyes shows only through the images' second order, which lenses have too.
    both, deviation = 100 * vector[FOCAL], 100 * float(np.sqrt(correction.loose_covariance[FOCAL, FOCAL]))
    text = f"off by {both:+.2f} +- {deviation:.2f} %"
    seen = deviation < 0.5
    text += "" if seen else " (this motion does not show it)"
    out.append(
        Finding("focal length, both eyes", level_of(float(both), float(deviation), FOCAL_PERCENT) if seen else 0, text)
    )
    skew, deviation = 1e3 * vector[SKEW], 1e3 * sigma[SKEW]
    text = f"{skew:+.2f} +- {deviation:.2f} ms" + ("" if deviation < 2 else " (this motion does not show it)")
    out.append(Finding("time skew of the right eye", level_of(float(skew), float(deviation), SKEW_MS), text))
    return out


def _list(values: F64) -> str:
    return "(" + ", ".join(f"{v:+.3f}" if abs(v) < 1 else f"{v:+.2f}" for v in values) + ")"
