"""Quality of a finished calibration: its measures, their limits and the verdict."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereo_sfm.calib.check import Finding, Limit, level_of
from stereo_sfm.calib.coverage import Coverage
from stereo_sfm.calib.solve import Calibration
from stereo_sfm.geometry.stereo import epipolar_angle
from stereo_sfm.types import F64

RMS_PX = Limit(0.5, 1.2, 0.0)
EPIPOLAR_PX = Limit(0.4, 1.0, 0.0)
FOCAL_SIGMA_PERCENT = Limit(0.15, 0.6, 0.0)
CENTRE_SIGMA_PX = Limit(0.6, 2.0, 0.0)


@dataclass(frozen=True, eq=False)
class Quality:
    """The measures of a calibration, each with a verdict."""

    findings: tuple[Finding, ...]
    epipolar_px: F64  # (K,) row error of corners seen by both cameras, px at the centre of the left image
    epipolar_uv: F64  # (K, 2) where, in the left image

    @property
    def level(self) -> int:
        """Level of the worst finding, index into VERDICTS."""
        return max(f.level for f in self.findings)


def judge(calibration: Calibration, views: Coverage) -> Quality:
    """Judge by reprojection error, epipolar error, the parameters' standard deviations and coverage."""
    sigma = dict(zip(calibration.names, calibration.sigma, strict=True))
    rig = calibration.rig
    focal = 100 * max(v for n, v in sigma.items() if n.endswith(("fx", "fy"))) / rig.left.fx
    centre = max(v for n, v in sigma.items() if n.endswith(("cx", "cy")))
    findings = [
        Finding("reprojection", level_of(calibration.rms, 0, RMS_PX), f"{calibration.rms:.3f} px root mean square"),
        Finding("focal length", level_of(focal, 0, FOCAL_SIGMA_PERCENT), f"known to {focal:.3f} % (one deviation)"),
        Finding("principal point", level_of(centre, 0, CENTRE_SIGMA_PX), f"known to {centre:.2f} px (one deviation)"),
    ]
    error, uv = np.zeros(0), np.zeros((0, 2))
    if rig.right is not None:
        error, uv = epipolar_errors(calibration)
        rms = float(np.sqrt(np.mean(error**2))) if len(error) else np.inf
        findings.append(Finding("epipolar error", level_of(rms, 0, EPIPOLAR_PX), f"{rms:.3f} px root mean square"))
        deviation = 1000 * float(sigma["left_T_right tx"])
        findings.append(Finding("baseline", 0, f"{1000 * rig.baseline:.2f} +- {deviation:.2f} mm"))
    level = 0 if views.fraction >= 0.75 else 1 if views.fraction >= 0.4 else 2
    findings.append(Finding("coverage", level, f"{100 * views.fraction:.0f} % of the image, {views.total} views"))
    return Quality(tuple(findings), error, uv)


def epipolar_errors(calibration: Calibration) -> tuple[F64, F64]:
    """Row errors (K,) px and positions (K, 2) px in the left image of the corners seen by both cameras."""
    observed, rig = calibration.observed, calibration.rig
    assert rig.right is not None
    key = {}
    for i in np.flatnonzero(observed.side == 1):
        key[(int(observed.view[i]), *observed.point[i])] = i
    pairs = [
        (i, key[k])
        for i in np.flatnonzero(observed.side == 0)
        if (k := (int(observed.view[i]), *observed.point[i])) in key
    ]
    if not pairs:
        return np.zeros(0), np.zeros((0, 2))
    a, b = np.array(pairs).T
    left, right = rig.left.unproject(observed.uv[a]), rig.right.unproject(observed.uv[b])
    return epipolar_angle(left, right, rig.left_T_right) * rig.left.fy, observed.uv[a]
