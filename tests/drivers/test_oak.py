"""The OAK driver with depthai's real messages, queues and calibration, and without a camera."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from datetime import timedelta
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from stereo_sfm.calib.imu import Imu
from stereo_sfm.drivers.live.counters import Counters
from stereo_sfm.drivers.live.errors import (
    Busy,
    DeviceError,
    DeviceFault,
    DeviceLost,
    NoPermission,
    NotFound,
    TooSlowLink,
)
from stereo_sfm.drivers.oak import library
from stereo_sfm.drivers.oak.calibration import read_calibration
from stereo_sfm.drivers.oak.source import OakSource
from stereo_sfm.drivers.oak.stream import OakStream
from stereo_sfm.drivers.source import open_source
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry.cameras import KannalaBrandt, RadTan, Tilted
from stereo_sfm.types import StereoImage
from tests.drivers.oak_rig import FIXTURES, PERIOD_S, SIZE, FakeOak, calibration, dai, frame, motion


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> FakeOak:
    oak = FakeOak()
    monkeypatch.setattr("stereo_sfm.drivers.oak.source.load", lambda: oak)
    monkeypatch.setattr("stereo_sfm.drivers.oak.source.on_usb", lambda: True)
    return oak


def take(source: OakSource, count: int) -> list[StereoImage]:
    return [image for _, image in zip(range(count), source, strict=False)]


# ---- privacy and absence


def test_depthai_is_imported_late_and_silenced(tmp_path: Path) -> None:
    """Nothing is imported with the driver; its telemetry queue stays empty; no internet socket is opened."""
    code = """
import sys, os, socket
import stereo_sfm.drivers.oak, stereo_sfm.drivers.oak.source, stereo_sfm
assert not any(m == "depthai" or m.startswith("depthai.") for m in sys.modules), "imported too early"
from stereo_sfm.drivers.oak.library import load, ENVIRONMENT
os.environ["DEPTHAI_LEVEL"] = "error"
dai = load()
assert os.environ["DEPTHAI_LEVEL"] == "error", "what the user has set stays"
assert all(os.environ[k] == v for k, v in ENVIRONMENT.items() if k != "DEPTHAI_LEVEL")
pipeline = dai.Pipeline(createImplicitDevice=False)
inodes = {os.readlink(f"/proc/self/fd/{f}")[8:-1] for f in os.listdir("/proc/self/fd")
          if os.path.exists(f"/proc/self/fd/{f}") and os.readlink(f"/proc/self/fd/{f}").startswith("socket:")}
tables = [open(f"/proc/self/net/{t}").read() for t in ("tcp", "tcp6", "udp", "udp6")]
assert not any(f" {i} " in t for i in inodes for t in tables), "an internet socket is open"
"""
    environment = {k: v for k, v in os.environ.items() if not k.startswith("DEPTHAI_")}
    environment |= {"XDG_CACHE_HOME": str(tmp_path), "HOME": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert not [p for p in tmp_path.rglob("*") if p.is_file() and "telemetry" in str(p)]


def test_no_camera_is_one_line_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("stereo_sfm.drivers.oak.source.on_usb", lambda: False)
    with pytest.raises(NotFound, match="no OAK attached") as caught:
        open_source("oak")
    assert "\n" not in str(caught.value)


def test_an_unbooted_t265_is_not_an_oak() -> None:
    assert 0x2150 not in library._USB_PRODUCTS


def test_depthai_finds_no_camera_quickly() -> None:
    began = time.monotonic()
    assert isinstance(library.find(dai), list)
    assert time.monotonic() - began < 20


@pytest.mark.parametrize(
    ("text", "kind"),
    [
        ("No available devices", NotFound),
        ("Cannot find any device with given deviceInfo", NotFound),
        ("Failed to connect: X_LINK_INSUFFICIENT_PERMISSIONS", NoPermission),
        ("Failed to find device, error message: X_LINK_DEVICE_ALREADY_IN_USE", Busy),
        ("Couldn't read data from stream: '__x_1_out' (X_LINK_ERROR)", DeviceLost),
        ("Device already closed or disconnected", DeviceLost),
        ("something else\nwith more lines", DeviceFault),
    ],
)
def test_errors_of_depthai(text: str, kind: type[DeviceError]) -> None:
    error = library.device_error(RuntimeError(text))
    assert type(error) is kind
    assert "\n" not in str(error)


# ---- calibration


def test_factory_calibration_in_metres_and_our_directions() -> None:
    rig = read_calibration(dai, calibration(), (1280, 800), "OAK-D", "1")
    assert isinstance(rig.left, RadTan) and rig.right is not None
    np.testing.assert_allclose(rig.left.params[:4], [796.2, 796.5, 645.1, 398.7], rtol=1e-6)
    np.testing.assert_allclose(
        rig.left.params[4:12], [-4.21, 8.93, 0.00041, -0.00032, 2.17, -4.27, 9.12, 1.86], rtol=1e-5
    )
    assert rig.baseline == pytest.approx(0.07512, abs=1e-5)
    assert rig.left_T_right[0, 3] == pytest.approx(0.0751, abs=1e-4)
    raw = json.loads((FIXTURES / "oak_d.json").read_text())
    left = dict(raw["cameraData"])[1]["extrinsics"]
    assert left["toCameraSocket"] == 2
    right_T_left = np.array(left["rotationMatrix"])
    np.testing.assert_allclose(rig.left_T_right[:3, :3], right_T_left.T, atol=1e-6)
    t = left["translation"]
    np.testing.assert_allclose(
        rig.left_T_right[:3, 3], -right_T_left.T @ np.array([t["x"], t["y"], t["z"]]) / 100, atol=1e-6
    )
    assert rig.imu is not None
    assert np.linalg.norm(rig.imu.left_T_imu[:3, 3]) == pytest.approx(0.0863, abs=1e-3)


def test_the_factory_calibration_of_the_imu() -> None:
    data = json.loads((FIXTURES / "oak_d.json").read_text())
    affine = [[1.01, 0.0, 0.002, 0.05], [0.0, 0.99, 0.0, -0.1], [0.001, 0.0, 1.0, 0.2]]  # [Q | b]
    data["imuCalibrationParams"]["accelerometer"] = affine
    data["imuCalibrationParams"]["noise"]["gyroscope"] = {
        k: {"noiseDensity": 2e-4, "randomWalk": 3e-5, "biasStability": 0.0} for k in "xyz"
    }
    imu = read_calibration(dai, dai.CalibrationHandler.fromJson(data), (1280, 800), "OAK-D", "1").imu
    assert imu is not None
    raw = np.array([[1.0, -9.0, 2.0]])
    np.testing.assert_allclose(imu.correct(raw, raw)[1][0], np.array(affine) @ [1.0, -9.0, 2.0, 1.0], atol=1e-6)
    assert (imu.gyro_noise, imu.gyro_walk) == pytest.approx((2e-4, 3e-5))
    assert imu.accel_noise == Imu().accel_noise  # the board does not know it


def test_calibration_of_another_image_size() -> None:
    """Half the size: the centre of pixel (0, 0) moves by a quarter of a pixel. Another shape: cut off evenly."""
    half = read_calibration(dai, calibration(), (640, 400), "OAK-D", "1").left
    assert (half.fx, half.cx, half.cy) == pytest.approx((398.1, (645.1 + 0.5) / 2 - 0.5, (398.7 + 0.5) / 2 - 0.5))
    cut = read_calibration(dai, calibration(), (1280, 720), "OAK-D", "1").left
    assert (cut.fx, cut.cx, cut.cy) == pytest.approx((796.2, 645.1, 358.7))
    tall = read_calibration(dai, calibration(), (640, 480), "OAK-D", "1").left
    assert tall.fx == pytest.approx(796.2 * 0.6)
    assert tall.cx == pytest.approx((645.1 + 0.5) * 0.6 - 0.5 - 64)


def test_wide_lenses_are_fisheyes_and_boards_may_not_know_their_imu() -> None:
    found = read_calibration(dai, calibration("oak_d_wide"), (1280, 800), "OAK-D-W", "2")
    assert isinstance(found.left, KannalaBrandt)
    assert found.left.distortion == pytest.approx((0.0312, -0.0124, 0.0041, -0.0011))
    assert found.imu is None


def test_tilted_lenses_of_newer_cameras() -> None:
    data = json.loads((FIXTURES / "oak_d.json").read_text())
    d = [0.32, -0.06, -4e-05, 8e-05, -0.0023, 0.654, -0.034, -0.009, 0.0011, -4e-4, 7e-4, 2e-4, 0.003, -0.001]
    dict(data["cameraData"])[1]["distortionCoeff"] = d
    found = read_calibration(dai, dai.CalibrationHandler.fromJson(data), (640, 400), "OAK-D", "1").left
    assert isinstance(found, Tilted) and found.distortion == pytest.approx(d, rel=1e-6)
    points = np.array([[0.5, -0.3, 1.0], [-0.7, 0.2, 1.2]])
    theirs, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), found.matrix, np.array(found.distortion))
    np.testing.assert_allclose(found.project(points), theirs[:, 0], rtol=0, atol=1e-9)


def changed(**extrinsics: float) -> Any:
    data = json.loads((FIXTURES / "oak_d.json").read_text())
    dict(data["cameraData"])[1]["extrinsics"]["translation"] |= extrinsics
    return dai.CalibrationHandler.fromJson(data)


def test_senseless_calibration_is_refused() -> None:
    with pytest.raises(DeviceFault, match="not calibrated"):
        read_calibration(dai, dai.CalibrationHandler(), SIZE, "OAK-D", "1")
    with pytest.raises(DeviceFault, match=r"right camera at \[-?7[0-9.]+"):
        read_calibration(dai, changed(x=7.5), SIZE, "OAK-D", "1")  # the wrong direction
    with pytest.raises(DeviceFault, match="invalid factory extrinsics"):
        read_calibration(dai, changed(x=-0.075), SIZE, "OAK-D", "1")  # metres, where centimetres should be


# ---- real queues


def stream_of(left: Any, right: Any, imu: Any = None) -> tuple[OakStream, Counters]:
    counters = Counters()
    return OakStream(dai, left, right, imu, SIZE, counters, round(PERIOD_S * 1e9), 30), counters


def test_pairs_by_number_and_time_through_real_queues() -> None:
    left, right, imu = (dai.MessageQueue(n, 64, True) for n in ("left", "right", "imu"))
    stream, counters = stream_of(left, right, imu)
    for k in range(12):
        stamp = 5 + k * PERIOD_S
        if k != 3:
            left.send(frame(1, k, stamp))
        if k != 7:
            right.send(frame(2, k, stamp + (0.002 if k == 9 else 0.0001)))
    for k in range(4):
        imu.send(motion(5 + k * 0.005, k))
        imu.send(motion(5 + k * 0.005, k))  # repeated readings count once
    stream.start()
    got = [stream.pairs.get(2.0) for _ in range(9)]
    deadline = time.monotonic() + 5
    while imu.getSize() and time.monotonic() < deadline:  # its reader may be behind
        time.sleep(0.01)
    stream.stop()
    pairs = [g[0] for g in got if g is not None]
    assert [p.left.counter for p in pairs] == [0, 1, 2, 4, 5, 6, 8, 10, 11]
    assert [p.right.counter for p in pairs] == [0, 1, 2, 4, 5, 6, 8, 10, 11]
    assert [p.dropped_before for p in pairs] == [0, 0, 0, 1, 0, 0, 1, 1, 0]
    assert pairs[0].left.stamp_ns == pytest.approx(
        5e9 - 4e6, abs=2000
    )  # middle of an exposure of 8 ms that ends at 5 s
    assert (pairs[0].left.exposure_us, pairs[0].left.gain) == (8000, 4.0)
    assert pairs[4].left.pixels.mean() == (5 * 7 + 1) % 256
    assert counters["skewed"] == 1
    taken = stream.motion.take(10**12)
    assert taken is not None and len(taken.stamp_ns) == 8
    assert stream.clock.known
    shift = time.monotonic_ns() - dai.Clock.now() / timedelta(microseconds=1) * 1000
    assert stream.clock.to_host(5_000_000_000) == pytest.approx(105e9 + shift, abs=5e6)


def test_the_clock_is_read_with_each_left_image() -> None:
    """depthai's own mapping follows the drift."""
    left, right = (dai.MessageQueue(n, 8, True) for n in ("left", "right"))
    stream, _ = stream_of(left, right)
    for k, drift_s in enumerate((0.0, 0.5)):
        sent = frame(1, k, 5 + k * PERIOD_S)
        sent.setTimestamp(timedelta(seconds=5 + k * PERIOD_S + 100 + drift_s))
        left.send(sent)
        right.send(frame(2, k, 5 + k * PERIOD_S))
    stream.start()
    assert all(stream.pairs.get(2.0) is not None for _ in range(2))
    stream.stop()
    shift = time.monotonic_ns() - dai.Clock.now() / timedelta(microseconds=1) * 1000
    assert stream.clock.to_host(5_000_000_000) == pytest.approx(105.5e9 + shift, abs=5e6)


def test_a_closed_queue_is_a_lost_camera() -> None:
    left, right = (dai.MessageQueue(n, 8, True) for n in ("left", "right"))
    stream, _ = stream_of(left, right)
    stream.start()
    left.send(frame(1, 0, 5))
    right.send(frame(2, 0, 5))
    assert stream.pairs.get(2.0) is not None
    left.close()
    with pytest.raises(DeviceLost, match="disconnected"):
        stream.pairs.get(2.0)
    stream.stop()


def test_images_of_another_size_are_refused() -> None:
    left, right = (dai.MessageQueue(n, 8, True) for n in ("left", "right"))
    stream, counters = stream_of(left, right)
    stream.start()
    left.send(frame(1, 0, 5, size=(320, 200)))
    right.send(frame(2, 0, 5))
    assert stream.pairs.get(0.3) is None
    stream.stop()
    assert counters["malformed"] == 1


class CameraNode(dai.node.ThreadedHostNode):  # depthai's own base of host nodes
    """Sends frames from a thread of depthai; an exception in `run` would abort Python, so there is none."""

    def __init__(self, socket: int) -> None:
        super().__init__()
        self.socket = socket
        self.output = self.createOutput()

    def run(self) -> None:
        try:
            for k in range(10):
                if k != 4 or self.socket == 1:
                    self.output.send(frame(self.socket, k, 5 + k * PERIOD_S))
        except dai.MessageQueue.QueueException:
            return


def test_a_host_only_pipeline_of_depthai() -> None:
    """Real nodes, real threads, real output queues; only the camera is missing."""
    with dai.Pipeline(createImplicitDevice=False) as pipeline:
        nodes = [pipeline.create(CameraNode, socket) for socket in (1, 2)]
        queues = [n.output.createOutputQueue(maxSize=32, blocking=False) for n in nodes]
        stream, counters = stream_of(*queues)
        stream.start()
        pipeline.start()
        got = [stream.pairs.get(3.0) for _ in range(9)]
        stream.stop()
    assert [g[0].left.counter for g in got if g] == [0, 1, 2, 3, 5, 6, 7, 8, 9]
    assert [g[0].dropped_before for g in got if g] == [0, 0, 0, 0, 1, 0, 0, 0, 0]
    assert counters["unpaired"] == 1


# ---- the source


def test_stream_with_calibration_and_imu(fake: FakeOak) -> None:
    fake.skip = {5}
    with open_source("oak", size="640x400", fps="30", exposure="8000", iso="800") as source:
        images = take(source, 10)
    assert source.rig.baseline == pytest.approx(0.07512, abs=1e-5)
    assert source.rig.serial == "18443010"
    assert [i.frame_id for i in images] == list(range(10))
    assert [i.dropped_before for i in images] == [0] * 5 + [1] + [0] * 4
    assert all(i.left.shape == (400, 640) for i in images)
    assert sum(len(i.imu.stamp_ns) for i in images if i.imu) >= 16
    assert source.counters["imu_samples"] == sum(len(i.imu.stamp_ns) for i in images if i.imu)
    assert [str(c[0]).rpartition(".")[2] for c in fake.controls] == ["CAM_B", "CAM_C"]
    assert all(c.expManual.exposureTimeUs == 8000 and c.expManual.sensitivityIso == 800 for _, c in fake.controls)
    assert all(o["type"] == dai.ImgFrame.Type.GRAY8 and o["enableUndistortion"] is False for o in fake.outputs)
    assert fake.projector == [0.0]


def test_anti_banding(fake: FakeOak) -> None:
    with open_source("oak", anti_flicker="60", max_exposure="10000", imu="0") as source:
        assert take(source, 2)[1].imu is None
    control = fake.controls[0][1]
    assert control.antiBandingMode == dai.CameraControl.AntiBandingMode.MAINS_60_HZ
    assert control.aeMaxExposureTimeUs == 10_000


def test_a_lost_camera_comes_back_as_a_new_segment(fake: FakeOak, caplog: pytest.LogCaptureFixture) -> None:
    fake.loses_after = 5
    with open_source("oak") as source:
        images = take(source, 10)
    assert [i.frame_id for i in images] == list(range(10))
    stamps = np.array([i.stamp_ns for i in images])
    assert (np.diff(stamps) > 0).all()
    assert (source.counters["disconnects"], source.counters["segments"], fake.opened) == (1, 2, 2)
    assert "OAK is back: segment 2" in caplog.text


def test_impossible_options_are_errors(fake: FakeOak, monkeypatch: pytest.MonkeyPatch) -> None:
    fake.speed = "HIGH"
    with pytest.raises(TooSlowLink, match=r"cannot carry 61 MB/s.*USB 3"):
        open_source("oak", size="1280x800")
    with open_source("oak", size="640x400") as source:  # 15 MB/s fit
        assert source.rig.left.width == 640
    fake.open_error = "X_LINK_DEVICE_ALREADY_IN_USE"
    with pytest.raises(Busy, match="another program"):
        open_source("oak")
    fake.open_error, fake.calibrated, fake.speed = "", False, "SUPER"
    with pytest.raises(DeviceFault, match="not calibrated"):
        open_source("oak")
    fake.attached = 2
    with pytest.raises(DeviceFault, match="2 OAKs are attached"):
        open_source("oak")
    with pytest.raises(NotFound, match=r"no OAK 'x' attached \(attached: 18443010, 18443011\)"):
        open_source("oak:x")
    with pytest.raises(StereoSfmError, match="size=big"):
        open_source("oak", size="big")
    with pytest.raises(StereoSfmError, match="no option 'colour'"):
        open_source("oak", colour="1")
