"""Results of self-calibration for the output folder: numbers, lines of the summary, the corrected calibration."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from stereo_sfm.calib.choice import NAMES, SCALES, UNITS, with_terms
from stereo_sfm.calib.rig import Rig
from stereo_sfm.calib.sensor_terms import with_sensor_terms
from stereo_sfm.calib.wheel_fit import NAMES as WHEEL_NAMES
from stereo_sfm.eval.record import RunRecord
from stereo_sfm.export.run_folder import CORRECTED
from stereo_sfm.maps.mounting import Mounting, mounted
from stereo_sfm.tracking.flow.readout import ROLLING
from stereo_sfm.tracking.flow.sudden_turn import SUSPECTED
from stereo_sfm.types import CalibrationUpdate, SensorUpdate


def calibration_stats(record: RunRecord) -> list[dict[str, Any]]:
    """Every change of the rig as plain values; terms in degrees and, of the focal length, per cent."""
    first_ns = record.frames.begin_ns
    return [
        {
            "kf_id": c.kf_id,
            "seconds": (c.stamp_ns - first_ns) / 1e9,
            "since_kf_id": c.since_kf_id,
            "applied": c.applied,
            "why": c.why,
            "text": c.text,
            "terms": (SCALES * c.terms).tolist(),
            "covariance": (SCALES[:, None] * c.terms_covariance * SCALES).tolist(),
        }
        for c in record.calibrations
    ]


def suspicion_stats(record: RunRecord) -> list[dict[str, Any]]:
    """Each sudden rotation of the right camera that was suspected, and each that did not stay."""
    return _news(record, SUSPECTED)


def shutter_stats(record: RunRecord) -> list[dict[str, Any]]:
    """When the motion showed that the calibration's readout is wrong; empty if it did not."""
    return _news(record, ROLLING)


def _news(record: RunRecord, beginning: str) -> list[dict[str, Any]]:
    first_ns = record.frames.begin_ns
    news = [(stamp_ns, text) for stamp_ns, text in record.news if text.startswith(beginning)]
    return [{"seconds": (stamp_ns - first_ns) * 1e-9, "text": text} for stamp_ns, text in news]


def start_check_stats(record: RunRecord) -> dict[str, Any] | None:
    """What the first images said about the calibration; None where they fit it."""
    found = record.start_check
    return None if found is None else {"text": found.line, "shown": found.shown, "corrected": bool(found.rig)}


def sensor_stats(record: RunRecord) -> list[dict[str, Any]] | None:
    """Every word about the calibration of IMU and wheels; terms in degrees, ms, per cent, mm; no sigma: unknown. None
    where it was not asked for."""
    if not record.calibrates_sensors:
        return None
    first_ns = record.frames.begin_ns
    return [
        {
            "kf_id": u.kf_id,
            "seconds": (u.stamp_ns - first_ns) / 1e9,
            "text": u.text,
            "terms": {
                name: [value, sigma if np.isfinite(sigma) else None] for name, value, sigma, _ in _sensor_terms(u)
            },
        }
        for u in record.sensor_updates
    ]


def _sensor_terms(update: SensorUpdate) -> list[tuple[str, float, float, str]]:
    """Name, value, standard deviation and unit of each."""
    degrees, ms, percent = (float(np.degrees(1.0)), "°"), (1e3, "ms"), (100.0, "%")
    imu = ("IMU rotation x", "IMU rotation y", "IMU rotation z", "IMU time offset")
    units = [degrees, degrees, degrees, ms, percent, percent, percent, degrees, degrees, ms, (1e3, "mm"), (1e3, "mm")]
    values, sigmas = np.append(update.imu, update.wheel), np.append(update.imu_sigma, update.wheel_sigma)
    return [
        (name, scale * value, scale * sigma, unit)
        for name, value, sigma, (scale, unit) in zip(
            (*imu, *(f"wheels' {n}" for n in WHEEL_NAMES)), values.tolist(), sigmas.tolist(), units, strict=True
        )
    ]


def mounting_stats(mounting: Mounting | None) -> dict[str, Any] | None:
    """The camera's tilt on a robot; None where it is given, felt by an IMU, or not measured."""
    if mounting is None:
        return None
    names = "pitch_deg", "roll_deg", "pitch_sigma_deg", "roll_sigma_deg"
    return {"text": mounting.text, **{name: getattr(mounting, name) for name in names}}


def row_error_stats(record: RunRecord) -> dict[str, Any] | None:
    """The last row errors and the largest; None without two cameras."""
    last = record.row_errors
    if last is None:
        return None
    regions = [None if np.isnan(v) else round(float(v), 3) for v in last.region_px]
    return {
        "region_px": regions,
        "systematic_px": last.systematic_px,
        "trend_px": last.trend_px,
        "worst_px": max(px for _, px in record.row_error_px),
        "warning": last.warning,
    }


def calibration_lines(stats: dict[str, Any]) -> list[str]:
    """Lines about the start check, the tilt, the row errors, and one for each change of the calibration."""
    rows, checked = stats["row_errors"], stats["start_check"]
    begun = [f"calibration at the start: {checked['text']}"] if checked and checked["shown"] else []
    tilt = stats["mounting"]
    begun += [f"{tilt['text']}: {CORRECTED} has it as body_T_left"] if tilt else []
    off = [] if rows is None else [f"row error {rows['systematic_px']:.2f} px (worst {rows['worst_px']:.2f} px)"]
    if rows is not None and rows["warning"]:
        off[0] += ": the calibration does not fit (see check-calib)"
    changes = [
        f"calibration {'corrected' if c['applied'] else 'doubtful'} at {c['seconds']:.1f} s ({c['why']}): {c['text']}"
        for c in stats["calibration"]
    ]
    news = [f"{new['text']} ({new['seconds']:.1f} s)" for new in (*stats["shutter"], *stats["suspected"])]
    lines = [*begun, *off, *changes, *news]
    compared = stats["sensor_calibration"]
    if compared is None:
        return lines
    if not compared:
        return [
            *lines,
            "IMU and wheels are not calibrated: the source has none, or moved for less than 15 s or too little",
        ]
    return lines + [f"sensors compared with the images at {c['seconds']:.1f} s: {c['text']}" for c in compared]


def write_corrected_rig(folder: Path, rig: Rig, record: RunRecord, mounting: Mounting | None = None) -> None:
    """`rig_corrected.yaml` of the last changes, their terms and covariance in comments; nothing without one.

    Args: mounting, of the camera on the robot, where it was measured.
    """
    from stereo_sfm.calib import save_rig

    sensors = record.sensor_updates[-1] if record.sensor_updates else None
    changed = sensors is not None and bool(sensors.imu.any() or sensors.wheel.any())
    if not record.calibrations and not changed and mounting is None:
        return
    path = folder / CORRECTED
    corrected = rig if sensors is None else with_sensor_terms(rig, sensors)
    if record.calibrations:
        corrected = with_terms(corrected, record.calibrations[-1].terms)
    save_rig(corrected if mounting is None else mounted(corrected, mounting), path)
    lines = _camera_comments(record.calibrations[-1]) if record.calibrations else []
    if sensors is not None:
        lines += [
            "",
            "# What was added to the source's calibration of IMU and wheels; nothing where a term is not known:",
        ]
        lines += [
            f"# {name}: {value:+.4f} +- {sigma:.4f} {unit}"
            for name, value, sigma, unit in _sensor_terms(sensors)
            if np.isfinite(sigma)
        ]
    if mounting is not None:
        lines += ["", f"# body_T_left was measured while driving: {mounting.text}"]
    path.write_text(path.read_text("utf-8").rstrip() + "\n".join(lines) + "\n", encoding="utf-8")


def _camera_comments(last: CalibrationUpdate) -> list[str]:
    """The terms of a correction and their covariance."""
    sigma = np.sqrt(np.diag(last.terms_covariance))
    lines = ["", "# What self-calibration added to the source's calibration, and the covariance of these numbers:"]
    lines += [
        f"# {name}: {value:+.5f} +- {deviation:.5f} {unit}"
        for name, value, deviation, unit in zip(NAMES, SCALES * last.terms, SCALES * sigma, UNITS, strict=True)
    ]
    scaled = SCALES[:, None] * last.terms_covariance * SCALES
    return lines + ["# " + " ".join(f"{value:.4e}" for value in row) for row in scaled]


def calibration_table(stats: dict[str, Any]) -> list[str]:
    """The section of report.md about changes of the calibration, empty if there were none."""
    if not stats["calibration"]:
        return []
    head = ["seconds", *(f"{n} ({u})" for n, u in zip(NAMES, UNITS, strict=True)), "why"]
    lines = ["", "## Calibration", "", "| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for c in stats["calibration"]:
        sigma = np.sqrt(np.diag(np.array(c["covariance"])))
        cells = [f"{v:+.3f} ± {s:.3f}" if v else "unchanged" for v, s in zip(c["terms"], sigma, strict=True)]
        lines.append("| " + " | ".join([f"{c['seconds']:.1f}", *cells, c["why"]]) + " |")
    applied = all(c["applied"] for c in stats["calibration"])
    use = "The run used the corrections" if applied else "They were only reported"
    return [*lines, "", f"{use}; `{CORRECTED}` holds the corrected calibration."]
