"""Golden bytes of the requests, round trips of the responses, and rejected bytes."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from stereo_sfm.drivers.t265 import messages as m
from stereo_sfm.drivers.t265 import protocol as p
from stereo_sfm.drivers.t265 import samples
from stereo_sfm.drivers.t265.messages import AntiFlicker, Id, Sensor

FISHEYES = [p.StreamProfile(camera, 848, 800, m.PIXEL_FORMAT_Y8, 848, 30, to_host=True) for camera in (0x03, 0x23)]

GOLDEN = {
    "06 00 00 00 01 00": p.request(Id.GET_DEVICE_INFO),
    "06 00 00 00 02 00": p.request(Id.GET_TIME),
    "08 00 00 00 25 00 00 00": p.low_power(False),
    "06 00 00 00 04 00": p.request(Id.GET_SUPPORTED_RAW_STREAMS),
    "07 00 00 00 06 00 03": p.camera_intrinsics(Sensor.LEFT),
    "07 00 00 00 06 00 23": p.camera_intrinsics(Sensor.RIGHT),
    "07 00 00 00 08 00 23": p.extrinsics(Sensor.RIGHT),
    "07 00 00 00 07 00 04": p.motion_intrinsics(Sensor.GYRO),
    "08 00 00 00 16 00 00 00": p.exposure_mode(False, AntiFlicker.HZ_50),
    "08 00 00 00 16 00 03 01": p.exposure_mode(True, AntiFlicker.HZ_50),
    "08 00 00 00 16 00 03 02": p.exposure_mode(True, AntiFlicker.HZ_60),
    "20 00 00 00 05 00 02 00 03 00 50 03 20 03 09 01 50 03 1e 00 23 00 50 03 20 03 09 01 50 03 1e 00": p.raw_streams(
        FISHEYES
    ),
    "08 00 00 00 06 10 00 00": p.six_dof(False),
    "08 00 00 00 06 10 01 06": p.six_dof(True),
    "20 00 00 00 17 00 02 00 03 00 00 00 10 27 00 00 00 00 00 40 23 00 00 00 10 27 00 00 00 00 00 40": p.set_exposure(
        10_000, 2.0
    ),
    "06 00 00 00 12 00": p.request(Id.START),
    "06 00 00 00 13 00": p.request(Id.STOP),
}


@pytest.mark.parametrize(("golden", "encoded"), GOLDEN.items())
def test_requests_are_the_golden_bytes(golden: str, encoded: bytes) -> None:
    assert encoded == bytes.fromhex(golden)


def test_response_header_is_checked() -> None:
    good = struct.pack("<IHHQ", 16, Id.GET_TIME, 0, 123456789)
    status, payload = p.response_payload(good, Id.GET_TIME)
    assert status == 0
    assert p.decode_time(payload) == 123456789
    for bad, why in (
        (good[:-1], "states a length of 16"),
        (good[:5], "less than a header"),
        (struct.pack("<IHHQ", 16, Id.START, 0, 1), "answered message"),
        (struct.pack("<IHHQ", 17, Id.GET_TIME, 0, 1), "states a length of 17"),
    ):
        with pytest.raises(p.ProtocolError, match=why):
            p.response_payload(bad, Id.GET_TIME)


def test_device_info() -> None:
    serial = int.from_bytes((0x153221101830 << 16).to_bytes(8, "big"), "little")
    payload = struct.pack("<8B4IQ8BI2B", 1, 2, 0, 3, 4, 0, 2, 0, 951, 7, 0, 0, serial, *[0] * 8, 0, 1, 0)
    info = p.decode_device_info(payload)
    assert (info.firmware, info.serial, info.calibrated, info.healthy) == ("0.2.0.951", "153221101830", True, True)
    assert info.product == "T265"
    uncalibrated = struct.pack("<8B4IQ8BI2B", 1, 2, 1, 3, 4, 0, 2, 0, 951, 7, 1000, 0, serial, *[0] * 8, 0, 1, 1)
    info = p.decode_device_info(uncalibrated)
    assert (info.calibrated, info.healthy, info.product) == (False, False, "T260")


def test_calibration_messages() -> None:
    camera = p.decode_camera_intrinsics(
        struct.pack("<2I4fI5f", 848, 800, 419.5, 387.0, 286.25, 287.5, 4, -0.5, 0.25, -0.125, 0.0625, 0)
    )
    assert (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy) == (
        848,
        800,
        286.25,
        287.5,
        419.5,
        387.0,
    )
    assert camera.distortion == (-0.5, 0.25, -0.125, 0.0625)
    with pytest.raises(p.ProtocolError, match="lens model 1"):
        p.decode_camera_intrinsics(struct.pack("<2I4fI5f", 848, 800, 1, 1, 1, 1, 1, 0, 0, 0, 0, 0))
    rotation = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    wire = struct.pack("<9f3fB", *rotation.T.ravel(), 1, 2, 3, Sensor.POSE)  # column-major
    body_T_sensor = p.decode_extrinsics(wire)
    np.testing.assert_allclose(body_T_sensor[:3, :3], rotation)
    np.testing.assert_allclose(body_T_sensor[:3, 3], [1, 2, 3])
    with pytest.raises(p.ProtocolError, match="not the body"):
        p.decode_extrinsics(wire[:-1] + b"\x03")
    with pytest.raises(p.ProtocolError, match="not finite"):
        p.decode_extrinsics(struct.pack("<9f3fB", *[float("nan")] * 12, Sensor.POSE))
    motion = p.decode_motion_intrinsics(struct.pack("<18f", *range(18)))
    np.testing.assert_array_equal(motion.scale, [[0, 1, 2], [4, 5, 6], [8, 9, 10]])
    np.testing.assert_array_equal(motion.bias, [3, 7, 11])


def test_counted_lists() -> None:
    offered = [p.StreamProfile(0x03, 848, 800, 9, 848, 30), p.StreamProfile(0x04, 0, 0, 0, 0, 200)]
    payload = struct.pack("<HH", 2, 0) + b"".join(s.encode() for s in offered)
    assert p.decode_streams(payload) == offered
    with pytest.raises(p.ProtocolError, match="for 2 streams"):
        p.decode_streams(payload[:-1])
    with pytest.raises(p.ProtocolError):
        p.decode_streams(b"\x01")
    assert p.decode_temperature(struct.pack("<IIff", 1, 0, 41.5, 85)) == [p.Temperature(0, 41.5, 85)]
    with pytest.raises(p.ProtocolError, match="9 entries"):
        p.decode_temperature(struct.pack("<IIff", 9, 0, 41.5, 85))


def video(sensor: int = 3, stamp: int = 5, frame_id: int = 7, exposure: int = 8000, gain: float = 1.5) -> bytearray:
    sample = struct.pack("<IHBBQQI", m.VIDEO_BYTES, 0x11, sensor, 0, stamp, 9, frame_id)
    header = sample + struct.pack("<IIfI", 8, exposure, gain, m.PIXELS)
    return bytearray(header + bytes(range(256)) * (m.PIXELS // 256))


def test_video_frame() -> None:
    sample = samples.decode_video_endpoint(video())
    assert isinstance(sample, samples.VideoSample)
    assert (sample.sensor, sample.stamp_ns, sample.frame_id, sample.exposure_us, sample.gain) == (3, 5, 7, 8000, 1.5)
    assert sample.pixels.shape == (800, 848)
    assert sample.pixels[0, :4].tolist() == [0, 1, 2, 3]


@pytest.mark.parametrize(
    ("offset", "value"),
    [
        (0, b"\x00"),  # length
        (4, b"\x12"),  # message
        (6, b"\x04"),  # sensor
        (28, b"\x09"),  # metadata length
        (32, b"\xff\xff\xff\xff"),  # exposure
        (36, b"\x00\x00\xc0\x7f"),  # gain: not a number
        (40, b"\0\0\0\0"),  # no pixels
    ],
)
def test_video_frame_with_a_wrong_header_is_refused(offset: int, value: bytes) -> None:
    frame = video()
    frame[offset : offset + len(value)] = value
    with pytest.raises(p.ProtocolError):
        samples.decode_video_endpoint(frame)


@pytest.mark.parametrize("size", [0, 1, 7, 9, 44, 196_608, 240_128, m.VIDEO_BYTES - 1, m.VIDEO_BYTES + 1])
def test_half_a_frame_is_refused(size: int) -> None:
    data = (video() + b"\0")[:size]
    with pytest.raises(p.ProtocolError):
        samples.decode_video_endpoint(data)


def motion(sensor: int = 4, stamp: int = 3, xyz: tuple[float, float, float] = (0.5, 1.0, -2.0)) -> bytes:
    return struct.pack("<IHBBQQIIfI3f", 52, 0x11, sensor, 0, stamp, 9, 2, 4, 31.5, 12, *xyz)


def test_several_events_in_one_transfer() -> None:
    status = struct.pack("<IHH", 8, Id.STATUS, m.Status.DEVICE_STOPPED)
    pose = struct.pack("<IH", 104, Id.GET_POSE) + bytes(98)
    events, damaged = samples.decode_events(motion() + status + pose + motion(sensor=5))
    assert damaged == 0
    assert [type(e) for e in events] == [samples.MotionSample, samples.StatusEvent, samples.MotionSample]
    first = events[0]
    assert isinstance(first, samples.MotionSample)
    assert (first.sensor, first.stamp_ns, first.celsius, first.xyz) == (4, 3, 31.5, (0.5, 1.0, -2.0))


def test_damaged_events_are_counted() -> None:
    assert samples.decode_events(motion() + motion()[:40])[1] == 1
    assert samples.decode_events(motion(sensor=6) + motion())[1] == 1
    assert len(samples.decode_events(motion(sensor=6) + motion())[0]) == 1
    assert samples.decode_events(motion(xyz=(float("nan"), 0, 0)))[1] == 1
    assert samples.decode_events(b"\0" * 64) == ([], 1)
    assert samples.decode_events(b"") == ([], 0)
