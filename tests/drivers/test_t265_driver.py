"""The real driver on a simulated camera: start, stream, every fault with its outcome and its count."""

from __future__ import annotations

import logging
import re
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import stereo_sfm.drivers.t265
from stereo_sfm.drivers import open_source
from stereo_sfm.drivers.live.counters import Counters
from stereo_sfm.drivers.live.errors import (
    BootFailed,
    Busy,
    DeviceFault,
    DeviceLost,
    FirmwareMissing,
    NoPermission,
    NotFound,
    TooSlowLink,
)
from stereo_sfm.drivers.live.source import Patience
from stereo_sfm.drivers.t265 import messages as m
from stereo_sfm.drivers.t265.acquire import Access
from stereo_sfm.drivers.t265.camera import Settings
from stereo_sfm.drivers.t265.firmware import verified
from stereo_sfm.drivers.t265.messages import AntiFlicker, Id
from stereo_sfm.drivers.t265.protocol import ProtocolError
from stereo_sfm.drivers.t265.simulated.bus import SimulatedBus
from stereo_sfm.drivers.t265.simulated.camera import SimulatedCamera
from stereo_sfm.drivers.t265.simulated.faults import Faults
from stereo_sfm.drivers.t265.simulated.source import FAST, SimulatedT265Source, checked_firmware
from stereo_sfm.drivers.t265.simulated.wire import reply
from stereo_sfm.drivers.t265.source import T265Source
from stereo_sfm.drivers.t265.stream import Stream
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.types import StereoImage
from tests.drivers.t265_rig import noise_content, open_camera, take

NEVER_SEND = {
    0x09: "SET_CAMERA_INTRINSICS",
    0x0A: "SET_MOTION_INTRINSICS",
    0x0B: "SET_EXTRINSICS",
    0x10: "WRITE_EEPROM",
    0x1C: "FIRMWARE_UPDATE",
    0x21: "WRITE_CONFIGURATION",
    0x22: "RESET_CONFIGURATION",
    0x23: "LOCK_CONFIGURATION",
    0x24: "LOCK_EEPROM",
}


def assert_honest(source: SimulatedT265Source, images: list[StereoImage]) -> None:
    """Every image is that of its stamp, and every missing one is counted in its place."""
    frames = [source.frame_shown(i.stamp_ns) for i in images]
    for image, frame in zip(images, frames, strict=True):
        left, right = source.camera.content.image(frame)
        assert image.right is not None
        assert np.array_equal(image.left, left) and np.array_equal(image.right, right), frame
    gaps = [b - a - 1 for a, b in pairwise(frames)]
    assert [i.dropped_before for i in images[1:]] == gaps
    assert [i.frame_id for i in images] == list(range(len(images)))
    assert source.counters["pairs"] == len(images)
    assert source.counters["dropped"] == sum(gaps) + images[0].dropped_before


def test_boot_calibration_and_the_order_of_commands() -> None:
    with open_camera(Faults(stale_stopped=True)) as source:
        assert (source.info.firmware, source.info.serial) == ("0.2.0.951", "0000D0C0FFEE")
        assert source.rig.serial == "0000D0C0FFEE"
        truth = source.camera.content.rig
        np.testing.assert_allclose(source.rig.left_T_right, truth.left_T_right, atol=1e-7)
        assert truth.right is not None and source.rig.right is not None
        for ours, theirs in ((source.rig.left, truth.left), (source.rig.right, truth.right)):
            np.testing.assert_allclose(ours.params[:8], theirs.params[:8], rtol=1e-6)
        right_down_ahead = source.rig.body_T_left[:3, :3].T  # in the axes of robots: x forward, y left, z up
        np.testing.assert_allclose(right_down_ahead, [[0, -1, 0], [0, 0, -1], [1, 0, 0]], atol=1e-7)
        np.testing.assert_allclose(source.rig.body_T_left[:3, 3], [0, 0.032, 0], atol=1e-3)
        assert source.rig.imu is not None
        imu = source.rig.imu.left_T_imu
        np.testing.assert_allclose(imu[:3, :3], np.diag([-1, -1, 1]), atol=1e-7)
        assert imu[0, 3] == pytest.approx(0.0107, abs=2e-4)
        images = take(source, 5)
    assert_honest(source, images)
    first = [Id(i).name for i in source.camera.received]
    assert first[:3] == ["SET_LOW_POWER_MODE", "GET_DEVICE_INFO", "STOP"]
    order = [first.index(n) for n in ("GET_EXTRINSICS", "EXPOSURE_MODE_CONTROL", "RAW_STREAMS_CONTROL",
                                      "SLAM_6DOF_CONTROL", "GET_TIME", "START")]  # fmt: skip
    assert order == sorted(order)
    assert first[-1] == "STOP"
    assert set(source.camera.received) <= m.SENDABLE


def test_a_clean_stream_loses_nothing() -> None:
    with open_camera() as source:
        images = take(source, 45)
    assert_honest(source, images)
    assert source.counters["dropped"] == source.camera.overruns  # what a starved computer does not read in time
    steps = np.diff([i.stamp_ns for i in images])
    assert (steps == m.PERIOD_NS * (1 + np.array([i.dropped_before for i in images[1:]]))).all()
    imu = [i.imu for i in images if i.imu is not None]
    stamps = np.concatenate([i.stamp_ns for i in imu])
    gyro = np.concatenate([i.gyro for i in imu])
    accel = np.concatenate([i.accel for i in imu])
    assert (np.diff(stamps) >= 0).all()
    seconds = (stamps[-1] - stamps[0]) * 1e-9
    assert np.isfinite(gyro[:, 0]).sum() / seconds == pytest.approx(200, rel=0.03)
    assert np.isfinite(accel[:, 0]).sum() / seconds == pytest.approx(62.5, rel=0.05)
    assert (np.isfinite(gyro[:, 0]) ^ np.isfinite(accel[:, 0])).all()
    np.testing.assert_allclose(np.nanmean(accel, axis=0), [0, 9.80665, 0], atol=1e-4)  # IMU axes: y up
    assert all(i.imu is None or i.imu.stamp_ns[-1] <= i.stamp_ns for i in images)
    assert source.counters["imu_samples"] == len(stamps)
    assert source.counters["temperature_c"] == 41.0
    assert 0 < source.counters["clock_uncertainty_us"] < 50_000


_NAMES = ["left", "right", "both", "swapped", "skew", "too-skewed", "empty", "half", "eight-bytes"]
_NAMES += ["split", "garbage", "counters", "busy", "stale"]


@pytest.mark.parametrize(
    ("faults", "counts"),
    [
        (Faults(drop_left=frozenset({4})), {"dropped": 1, "unpaired": 1}),
        (Faults(drop_right=frozenset({4, 5, 9})), {"dropped": 3, "unpaired": 3}),
        (Faults(drop_left=frozenset({4}), drop_right=frozenset({4})), {"dropped": 1, "unpaired": 0}),
        (Faults(swapped=frozenset({2, 3, 7})), {"dropped": 0, "unpaired": 0}),
        (Faults(right_skew_ns={5: 500_000}), {"dropped": 0}),
        (Faults(right_skew_ns={5: 2_000_000}), {"dropped": 1, "unpaired": 2, "skewed": 1}),
        (Faults(empty=frozenset({5})), {"dropped": 1, "half_frames": 1}),
        (Faults(half={5: 196_608}), {"dropped": 1, "half_frames": 1}),
        (Faults(half={5: 8}), {"dropped": 1}),
        (Faults(split={5: 240_128, 9: 44}), {"dropped": 2, "half_frames": 4}),
        (Faults(garbage=frozenset(range(2, 12))), {"dropped": 0}),
        (Faults(counter_skips=frozenset({5})), {"dropped": 0, "counter_mismatch": 1}),
        (Faults(busy_replies=2), {"dropped": 0, "busy_retries": 2}),
        (Faults(stale_stopped=True), {"dropped": 0, "segments": 1}),
    ],
    ids=[
        "left",
        "right",
        "both",
        "swapped",
        "skew",
        "too-skewed",
        "empty",
        "half",
        "eight-bytes",
        "split",
        "garbage",
        "counters",
        "busy",
        "stale",
    ],
)
def test_every_lost_frame_is_counted(faults: Faults, counts: dict[str, int]) -> None:
    frames = 15
    with open_camera(replace(faults, stall_at=frames), paced=False, booted=True) as source:
        images = take(source, frames - counts["dropped"])
    assert_honest(source, images)
    assert source.frame_shown(images[-1].stamp_ns) == frames - 1
    assert {k: source.counters[k] for k in counts} == counts
    assert source.counters["segments"] == 1


def test_unplugged_in_mid_frame_and_back_as_a_new_segment(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING, "stereo_sfm"), open_camera(Faults(unplug_at=8, unplugged_s=0.4)) as source:
        images = take(source, 25)
    assert_honest(source, images)
    assert (source.counters["disconnects"], source.counters["segments"]) == (1, 2)
    assert images[8].dropped_before >= 12  # 0.4 s and the boot
    assert np.diff([i.stamp_ns for i in images]).min() > 0
    assert re.search(r"T265: 25 stereo images, dropped \d+, disconnects 1", caplog.text)
    assert "the camera was disconnected" in caplog.text and "T265 is back: segment 2" in caplog.text
    inertial = [i.imu.stamp_ns for i in images if i.imu is not None]
    assert (np.diff(np.concatenate(inertial)) >= 0).all()


def test_never_back_is_an_error_after_the_images_so_far() -> None:
    images: list[StereoImage] = []
    with open_camera(Faults(unplug_at=8, unplugged_s=-1)) as source:
        with pytest.raises(DeviceLost, match=r"did not come back within 1 s: no T265 attached.*frame 8") as caught:
            images.extend(source)
        assert "\n" not in str(caught.value)
    assert_honest(source, images)
    assert len(images) == 8


def test_a_disconnection_before_the_first_image_is_an_error() -> None:
    with (
        open_camera(Faults(unplug_at=0, unplugged_s=-1)) as source,
        pytest.raises(DeviceLost, match="no T265 attached"),
    ):
        take(source, 1)


def test_a_stall_restarts_the_stream(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING, "stereo_sfm"), open_camera(Faults(stall_at=8), booted=True) as source:
        images = take(source, 20)
    assert_honest(source, images)
    assert (source.counters["stalls"], source.counters["segments"]) == (1, 2)
    assert source.camera.generation == 0  # not reset
    assert "sent no image for 500 ms" in caplog.text


def test_a_persistent_stall_leads_to_a_reset() -> None:
    faults = Faults(stall_at=8, stall_survives_restart=True)
    with open_camera(faults, patience={"first_image_s": 0.6}) as source:
        images = take(source, 20)
    assert_honest(source, images)
    assert (source.counters["stalls"], source.counters["segments"]) == (2, 3)
    assert source.camera.generation == 3  # boot, reset, boot


def test_a_malformed_answer_ends_no_session() -> None:
    asked: list[int] = []

    def malformed() -> int:
        asked.append(1)
        if len(asked) == 3:
            stream._stopping.set()
        raise ProtocolError("T265 answered 3 bytes, less than a header")

    stream = Stream(SimpleNamespace(time_ns=malformed), Counters(), replace(FAST, clock_s=0.0), 3)
    stream._guard(stream._keep_clock)
    assert len(asked) == 3 and stream.pairs.get(0) is None  # which would raise an error of the thread


@pytest.mark.parametrize("message", [Id.GET_DEVICE_INFO, Id.GET_CAMERA_INTRINSICS])
def test_a_malformed_answer_at_the_start_closes_the_camera(message: Id, monkeypatch: pytest.MonkeyPatch) -> None:
    camera = SimulatedCamera(noise_content(1))
    camera.booted = True
    bus, answer = SimulatedBus([camera]), camera._handle
    monkeypatch.setattr(camera, "_handle", lambda got, body: reply(got, 0) if got == message else answer(got, body))
    with pytest.raises(DeviceFault, match="has 0 bytes"):
        T265Source(Access(bus, firmware=checked_firmware, timing=FAST), Settings(), Patience())
    assert not bus._claimed


def test_the_losses_of_a_slow_consumer_are_reported() -> None:
    with open_camera(queue=3, booted=True) as source:
        images: list[StereoImage] = []
        for image in source:
            images.append(image)
            if len(images) == 3:
                time.sleep(0.4)
            if len(images) == 12:
                break
    assert_honest(source, images)
    assert source.counters["dropped_by_host"] >= 5
    assert source.counters["dropped"] == source.counters["dropped_by_host"] + source.camera.overruns


def test_wheel_odometry_travels_with_the_images() -> None:
    with open_camera(booted=True) as source:
        stream = iter(source)
        first = next(stream)
        for k in range(3):
            source.push_wheel((0.5 + k, 0, 0), (0, 0, 0.1))
        images = [next(stream) for _ in range(4)]
    wheel = next(i.wheel for i in images if i.wheel is not None)
    assert first.wheel is None
    assert wheel.linear[:, 0].tolist() == [0.5, 1.5, 2.5]
    assert wheel.angular[:, 2].tolist() == [0.1] * 3
    assert (wheel.stamp_ns > first.stamp_ns).all() and (wheel.stamp_ns < images[-1].stamp_ns).all()
    assert source.counters["wheel_samples"] == 3


@pytest.mark.parametrize(
    ("faults", "error", "line"),
    [
        (Faults(speed=3), TooSlowLink, "USB 2 link.*USB 3 port.*allow_slow=1"),
        (Faults(refuse_open=13), NoPermission, "no permission.*'stereo-sfm udev'"),
        (Faults(refuse_claim=16), Busy, "another program uses it"),
        (Faults(uncalibrated=True), DeviceFault, "lost its factory calibration"),
        (Faults(firmware=(0, 0, 18, 5715)), DeviceFault, "runs firmware 0.0.18.5715.*supports 0.2.0.951"),
        (Faults(silent_commands=True), DeviceLost, "does not answer message 0x0025"),
        (Faults(returns_after_boot=False), BootFailed, "did not restart after loading its firmware"),
    ],
)
def test_impossible_options_are_one_line(faults: Faults, error: type[StereoSfmError], line: str) -> None:
    with pytest.raises(error, match=line) as caught:
        open_camera(faults, timing={"boot_s": 0.6, "command_ms": 200})
    assert "\n" not in str(caught.value)


def test_a_camera_that_stays_busy_is_named_busy() -> None:
    with (
        open_camera(Faults(busy_replies=99), booted=True, timing={"busy_wait_s": 0.01}) as source,
        pytest.raises(Busy, match="stays busy"),
    ):
        take(source, 1)


def test_usb2_may_be_allowed() -> None:
    with open_camera(Faults(speed=3), allow_slow=True, booted=True) as source:
        assert_honest(source, take(source, 3))


def test_no_camera_is_one_line_at_once() -> None:
    began = time.monotonic()
    with pytest.raises(NotFound, match="no T265 attached") as caught:
        open_source("t265", backend=SimulatedBus([]))
    assert time.monotonic() - began < 10
    assert "\n" not in str(caught.value)


def test_firmware_is_needed_and_checked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    monkeypatch.delenv("STEREO_SFM_T265_FIRMWARE", raising=False)
    camera = SimulatedCamera(noise_content())
    with pytest.raises(FirmwareMissing, match="firmware extract FILE"):
        open_source("t265", backend=SimulatedBus([camera]))
    wrong = tmp_path / "wrong.mvcmd"
    wrong.write_bytes(b"MA2x" + bytes(100))
    with pytest.raises(FirmwareMissing, match=r"is not T265 firmware 0\.2\.0\.951"):
        open_source("t265", backend=SimulatedBus([camera]), firmware=str(wrong))
    assert camera.boot_bytes == b""
    with pytest.raises(FirmwareMissing):
        verified(b"")


def test_cameras_are_chosen_by_serial() -> None:
    cameras = [SimulatedCamera(noise_content(), serial=s) for s in ("000000000AAA", "000000000BBB")]
    bus = SimulatedBus(cameras)
    with pytest.raises(DeviceFault, match="2 T265s are attached"):
        open_source("t265", backend=bus)
    access = Access(bus, "000000000bbb", checked_firmware, timing=FAST)
    with SimulatedT265Source(cameras[1], access, Settings(), Patience()) as source:
        assert source.info.serial == "000000000BBB"
        assert_honest(source, take(source, 3))
    with pytest.raises(NotFound, match=r"no T265 with serial 123.*000000000AAA, 000000000BBB"):
        open_source("t265:123", backend=bus)


def test_exposure_reaches_the_camera(monkeypatch: pytest.MonkeyPatch) -> None:
    sent: list[bytes] = []
    original = SimulatedCamera.command
    monkeypatch.setattr(SimulatedCamera, "command", lambda self, data: (sent.append(data), original(self, data))[1])
    with open_camera(settings=Settings(exposure_us=8000, gain=3.0), booted=True) as source:
        take(source, 2)
    assert bytes.fromhex("08 00 00 00 16 00 00 00") in sent
    assert any(d[4] == Id.SET_EXPOSURE and d[12:16] == (8000).to_bytes(4, "little") for d in sent)
    sent.clear()
    with open_camera(settings=Settings(anti_flicker=AntiFlicker.HZ_60, imu=False), booted=True) as source:
        images = take(source, 10)
    assert bytes.fromhex("08 00 00 00 16 00 03 02") in sent
    assert all(i.imu is None for i in images)


@pytest.mark.parametrize(
    ("options", "line"),
    [
        ({"exposure": "100"}, "exposure=100.*200 to 16000"),
        ({"gain": "99"}, "gain=99.*1 to 10"),
        ({"anti_flicker": "55"}, "anti_flicker=55.*50, 60, off"),
        ({"colour": "1"}, "no option 'colour'.*exposure"),
        ({"imu": "maybe"}, "imu=maybe"),
    ],
)
def test_bad_options_are_one_line(options: dict[str, str], line: str) -> None:
    with pytest.raises(StereoSfmError, match=line):
        open_source("t265", backend=SimulatedBus([]), **options)


# ---- what must never leave


def test_no_dangerous_message_can_be_sent() -> None:
    with open_camera(booted=True) as source:
        assert source._camera is not None
        link, before = source._camera.link, list(source.camera.received)
        for message in (i for i in range(0x10000) if i not in m.SENDABLE):
            with pytest.raises(ValueError, match="refusing to send"):
                link.command(b"\x06\0\0\0" + message.to_bytes(2, "little"))
        assert source.camera.received == before
    assert not m.SENDABLE & NEVER_SEND.keys()


def test_only_two_functions_write_to_a_camera() -> None:
    """The command function, and the one that sends checked firmware to a camera in its boot state."""
    folder = Path(stereo_sfm.drivers.t265.__file__).parent
    writers = [
        (path.name, line.strip())
        for path in sorted(folder.glob("*.py"))
        for line in path.read_text().splitlines()
        if re.search(r"\.(write|bulk_write|intr_write|ctrl_transfer)\(", line)
    ]
    assert writers == [
        ("boot.py", "if device.write(m.BOOT_OUT, chunk, timing.boot_ms) != len(chunk):"),
        ("link.py", "self.device.write(m.COMMAND_OUT, request, self._timing.command_ms)"),
        ("link.py", "self.device.ctrl_transfer(0x40, 0x10, 0, 0, 0, self._timing.command_ms)"),
    ]


def test_firmware_goes_to_unbooted_cameras_only() -> None:
    from stereo_sfm.drivers.t265.boot import boot
    from stereo_sfm.drivers.t265.usb_device import attached

    camera = SimulatedCamera(noise_content())
    camera.booted = True
    bus = SimulatedBus([camera])
    with pytest.raises(ValueError, match="boot state"):
        boot(attached(bus)[0], checked_firmware(), bus, FAST)


def test_a_program_that_crashed_left_the_camera_streaming() -> None:
    """The next one stops it, reads its last words, and streams."""
    camera = SimulatedCamera(noise_content())
    camera.booted = True
    bus = SimulatedBus([camera])
    access = Access(bus, firmware=checked_firmware, timing=FAST)
    crashed = SimulatedT265Source(camera, access, Settings(), Patience())
    take(crashed, 2)
    assert crashed._segment is not None
    crashed._segment.stop(camera_alive=False)  # threads end; nobody says STOP
    bus._claimed.clear()  # the operating system takes the interface back
    with SimulatedT265Source(camera, access, Settings(), Patience()) as source:
        assert_honest(source, take(source, 3))
        assert source.counters["busy_retries"] == 0


@pytest.mark.parametrize("product", [0x2485, 0xF63B, 0xF63C, 0xF63D, 0x2151])
def test_other_movidius_devices_are_left_alone(product: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """An OAK has the same vendor id: it must never get a T265's firmware."""
    camera = SimulatedCamera(noise_content())
    bus = SimulatedBus([camera])
    original = bus.get_device_descriptor

    def other(device: Any) -> Any:
        described = original(device)
        described.idProduct = product
        return described

    monkeypatch.setattr(bus, "get_device_descriptor", other)
    with pytest.raises(NotFound, match="no T265 attached"):
        open_source("t265", backend=bus)
    assert camera.boot_bytes == b""
