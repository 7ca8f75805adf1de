"""Which of IMU and wheels a run used, and why not: for stats.json, the closing lines and the report."""

from __future__ import annotations

from typing import Any

from stereo_sfm.eval.record import RunRecord
from stereo_sfm.tracking.inertial.agreement import SensorUse

NAMES = {"imu": "IMU", "wheels": "wheel odometry"}
UNDECIDED = {
    "imu": "the camera's motion did not show whether it agrees with the images: turn and move the camera more at first",
    "wheels": "the camera's motion did not show whether it agrees with the images: drive further at first",
}


def sensor_use_stats(record: RunRecord) -> dict[str, dict[str, Any]]:
    """By sensor of the calibration: how far it counted at the end, and since when and why it is left out."""
    first_ns = record.frames.begin_ns
    out: dict[str, dict[str, Any]] = {}
    for name, code in record.sensor_use.items():
        out[name] = {"use": SensorUse(code).name.lower(), "seconds": None, "why": ""}
        word = {"imu": ("gyro", "accel", "imu"), "wheels": ("wheels",)}[name]
        news = [(stamp_ns, text) for stamp_ns, text in record.news if text.startswith(word)]
        if code <= SensorUse.MISSING and news:
            why = news[-1][1].partition(": ")
            out[name] |= {"seconds": (news[-1][0] - first_ns) * 1e-9, "why": f"{why[0].replace('_', ' ')}: {why[2]}"}
    return out


def sensor_lines(stats: dict[str, Any]) -> list[str]:
    """A line for each sensor that was not used, or not to the end."""
    return [f"{NAMES[name]} {text}" for name, use in stats["sensors"].items() if (text := _text(name, use))]


def _text(name: str, use: dict[str, Any]) -> str:
    if use["use"] == "unknown":
        return f"not used: {UNDECIDED[name]}"
    if use["use"] == "rotation":
        return "used for rotations only: the camera's motion did not show whether the accelerometer is right"
    if use["use"] == "missing" and not use["why"]:
        return "not used: no samples came"
    return "" if use["use"] == "used" else f"not used at {use['seconds']:.1f} s and later: {use['why']}"
