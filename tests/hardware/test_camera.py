"""Tests for the owner of a T265 or an OAK: `pytest -m hardware` (about two minutes), then pastes the report.

$STEREO_SFM_CAMERA chooses the camera; t265:simulated runs the tests without one. $STEREO_SFM_UNPLUG=1 adds the test
that asks for the cable to be pulled.
"""

from __future__ import annotations

import os
import time
from typing import Any

import numpy as np
import pytest

from stereo_sfm.drivers.live.source import LiveSource
from stereo_sfm.drivers.source import open_source
from stereo_sfm.types import StereoImage

pytestmark = pytest.mark.hardware

SECONDS = float(os.environ.get("STEREO_SFM_HARDWARE_SECONDS", "30"))


def open_camera(spec: str, **options: Any) -> LiveSource:
    source = open_source(spec, **options)
    assert isinstance(source, LiveSource)
    return source


def take(source: LiveSource, seconds: float) -> list[StereoImage]:
    """Images without their pixels' memory: means and shapes are enough."""
    out: list[StereoImage] = []
    for image in source:
        out.append(image)
        if (image.stamp_ns - out[0].stamp_ns) * 1e-9 >= seconds:
            break
    return out


def test_attached(camera: str, report: dict[str, Any]) -> None:
    """`stereo-sfm devices` sees it."""
    from stereo_sfm.drivers.devices import list_devices

    began = time.monotonic()
    cameras, problems = list_devices()
    report |= {"seconds": time.monotonic() - began, "devices": [str(c) for c in cameras], "problems": problems}
    if "simulated" not in camera:
        assert any(c.driver == camera.partition(":")[0] for c in cameras)


def test_opens_with_a_sensible_calibration(camera: str, report: dict[str, Any]) -> None:
    began = time.monotonic()
    with open_camera(camera) as source:
        rig = source.rig
        report |= {"open_seconds": time.monotonic() - began, "name": rig.name, "serial": rig.serial}
        report |= {
            "left": str(rig.left),
            "right": str(rig.right),
            "left_T_right": np.round(rig.left_T_right, 6).tolist(),
        }
    assert 0.02 < rig.baseline < 0.2
    assert rig.left_T_right[0, 3] > 0


def test_streams_without_loss(camera: str, report: dict[str, Any]) -> None:
    """The stamps are regular, the cameras are synchronised, no frame is lost, the IMU runs."""
    with open_camera(camera) as source:
        began, cpu = time.monotonic(), time.process_time()
        images = [
            (i.stamp_ns, i.right_stamp_ns, i.exposure_us, i.gain, float(i.left[::8, ::8].mean()), i.imu)
            for i in _limited(source, SECONDS)
        ]
        wall, cpu = time.monotonic() - began, time.process_time() - cpu
    stamps, rights, exposures, gains, means = (np.array([i[k] for i in images], float) for k in range(5))
    steps_ms = np.diff(stamps) * 1e-6
    imu = [i[5] for i in images if i[5] is not None]
    gyro = sum(int(np.isfinite(s.gyro[:, 0]).sum()) for s in imu) / wall
    accel = np.concatenate([s.accel for s in imu]) if imu else np.full((1, 3), np.nan)
    report |= {
        "frames": len(images),
        "rate_hz": 1e3 / float(steps_ms.mean()),
        "step_ms_p1_p50_p99_max": np.percentile(steps_ms, [1, 50, 99, 100]).round(3).tolist(),
        "eyes_apart_us_max": float(np.abs(rights - stamps).max() * 1e-3),
        "exposure_us_min_max": [float(exposures.min()), float(exposures.max())],
        "gain_min_max": [float(gains.min()), float(gains.max())],
        "brightness_min_max": [float(means.min()), float(means.max())],
        "cpu_percent": 100 * cpu / wall,
        "gyro_hz": gyro,
        "gravity": float(np.linalg.norm(np.nanmean(accel, axis=0))) if imu else None,
        "counters": {k: v for k, v in source.counters.items() if v},
    }
    assert source.counters["dropped"] == 0
    assert np.abs(rights - stamps).max() < 1e6
    assert (steps_ms > 0).all()
    assert means.max() > 3, "the images are black: is the lens covered?"
    if imu:
        assert 8.5 < np.linalg.norm(np.nanmean(accel, axis=0)) < 11, "hold the camera still"


def _limited(source: LiveSource, seconds: float) -> Any:
    first = None
    for image in source:
        first = image.stamp_ns if first is None else first
        yield image
        if (image.stamp_ns - first) * 1e-9 >= seconds:
            return


def test_stops_and_starts_again_at_once(camera: str, report: dict[str, Any]) -> None:
    """Some cameras reply "busy" then; the driver waits for them."""
    seconds: list[float] = []
    retries: list[float] = []
    for _ in range(3):
        began = time.monotonic()
        with open_camera(camera) as source:
            assert len(take(source, 1.0)) > 5
            retries.append(source.counters["busy_retries"])
        seconds.append(time.monotonic() - began)
    report |= {"seconds_each": seconds, "busy_retries_each": retries}


@pytest.mark.parametrize("exposure_us", [2000, 8000])
def test_manual_exposure_is_obeyed(camera: str, exposure_us: int, report: dict[str, Any]) -> None:
    if "simulated" in camera:
        pytest.skip("the simulated camera's images are made before")
    with open_camera(camera, exposure=str(exposure_us)) as source:
        images = take(source, 2.0)
    got = [i.exposure_us for i in images[-10:]]
    report |= {"asked_us": exposure_us, "got_us": got, "brightness": float(images[-1].left.mean())}
    assert got == pytest.approx([exposure_us] * len(got), rel=0.05)


@pytest.mark.skipif(os.environ.get("STEREO_SFM_UNPLUG") != "1", reason="set STEREO_SFM_UNPLUG=1 and pull the cable")
def test_unplugged_and_back(camera: str, report: dict[str, Any]) -> None:
    print("\npull the cable in the next 20 seconds, and plug it in again after 3")
    with open_camera(camera, reconnect="60") as source:
        images = take(source, 40.0)
    report |= {"frames": len(images), "counters": {k: v for k, v in source.counters.items() if v}}
    assert source.counters["segments"] >= 2
    assert source.counters["dropped"] == sum(i.dropped_before for i in images)
