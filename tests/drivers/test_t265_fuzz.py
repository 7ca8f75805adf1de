"""20,000 damaged messages and descriptors: no crash, no hang, no wrong frame accepted."""

from __future__ import annotations

import random
import struct
import time
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from stereo_sfm.drivers.live.counters import Counters
from stereo_sfm.drivers.live.errors import DeviceError
from stereo_sfm.drivers.live.pairing import LEFT, RIGHT, CameraImage, ContinuityFilter, Pairer
from stereo_sfm.drivers.t265 import messages as m
from stereo_sfm.drivers.t265 import protocol as p
from stereo_sfm.drivers.t265 import samples
from stereo_sfm.drivers.t265.link import Link, Timing
from stereo_sfm.drivers.t265.messages import Id, Sensor
from stereo_sfm.drivers.t265.simulated.bus import SimulatedBus
from stereo_sfm.drivers.t265.simulated.camera import SimulatedCamera
from stereo_sfm.drivers.t265.usb_device import attached
from stereo_sfm.errors import StereoSfmError
from tests.drivers.t265_rig import noise_content

COUNT = 20_000


def damage(data: bytes, rng: random.Random) -> bytes:
    """Cut, stretch, flip, overwrite, or replace."""
    out = bytearray(data)
    kind = rng.randrange(6)
    if kind == 0:
        return bytes(out[: rng.randrange(len(out) + 1)])
    if kind == 1:
        return bytes(out) + rng.randbytes(rng.randrange(1, 64))
    if kind == 2:
        for _ in range(rng.randrange(1, 5)):
            out[rng.randrange(min(len(out), 64))] ^= 1 << rng.randrange(8)
    elif kind == 3:
        at = rng.randrange(min(len(out), 64))
        extreme = rng.choice([b"\xff" * 4, b"\0" * 4, b"\0\0\xc0\x7f", b"\0\0\x80\xff", b"\xff\xff\xff\x7f"])
        out[at : at + 4] = extreme[: len(out) - at]
    elif kind == 4:
        out[:6] = struct.pack("<IH", rng.choice([0, 1, 8, len(out), len(out) + 1, 2**32 - 1]), rng.randrange(65536))
    else:
        return rng.randbytes(rng.randrange(1, 200))
    return bytes(out)


def answers() -> dict[int, bytes]:
    """A valid reply to every command of the driver."""
    camera = SimulatedCamera(noise_content(1))
    out: dict[int, bytes] = {}
    for request in (
        p.request(Id.GET_DEVICE_INFO), p.request(Id.GET_TIME), p.request(Id.GET_SUPPORTED_RAW_STREAMS),
        p.camera_intrinsics(Sensor.LEFT), p.motion_intrinsics(Sensor.GYRO), p.extrinsics(Sensor.RIGHT),
        p.request(Id.GET_TEMPERATURE),
    ):  # fmt: skip
        camera.command(request)
        out[request[4]] = camera.read_reply(0, camera.generation) or b""
    return out


DECODERS = {
    Id.GET_DEVICE_INFO: p.decode_device_info,
    Id.GET_TIME: p.decode_time,
    Id.GET_SUPPORTED_RAW_STREAMS: p.decode_streams,
    Id.GET_CAMERA_INTRINSICS: p.decode_camera_intrinsics,
    Id.GET_MOTION_INTRINSICS: p.decode_motion_intrinsics,
    Id.GET_EXTRINSICS: p.decode_extrinsics,
    Id.GET_TEMPERATURE: p.decode_temperature,
}


def test_damaged_replies() -> None:
    rng, good = random.Random(1), answers()
    refused = 0
    for k in range(COUNT // 4):
        message = list(DECODERS)[k % len(DECODERS)]
        try:
            _, payload = p.response_payload(damage(good[message], rng), message)
            DECODERS[message](payload)
        except p.ProtocolError:
            refused += 1
    assert refused > COUNT // 8


def test_damaged_events() -> None:
    rng = random.Random(2)
    sample = struct.pack("<IHBBQQIIfI3f", 52, 0x11, 4, 0, 3, 9, 2, 4, 31.5, 12, 1, 2, 3)
    status = struct.pack("<IHH", 8, Id.STATUS, 0x0C)
    for _ in range(COUNT // 4):
        transfer = b"".join(damage(rng.choice([sample, status]), rng) for _ in range(rng.randrange(1, 5)))
        events, damaged = samples.decode_events(transfer)
        assert damaged >= 0
        for event in events:
            if isinstance(event, samples.MotionSample):
                assert event.sensor in (4, 5)
                assert all(abs(v) <= 1000 for v in event.xyz)


def video(side: int, stamp: int, counter: int) -> bytes:
    sensor = Sensor.LEFT if side == LEFT else Sensor.RIGHT
    header = struct.pack("<IHBBQQI", m.VIDEO_BYTES, 0x11, sensor, 0, stamp, stamp, counter)
    return header + struct.pack("<IIfI", 8, 5000, 1.0, m.PIXELS)


def test_no_wrong_frame_among_damaged_transfers() -> None:
    """A stream of transfers, a third of them damaged in the header: every pair that comes out is a true one.

    A header can be damaged into another one that is well-formed; then the counter and the time must betray it.
    """
    rng, counters = random.Random(3), Counters()
    start = 77_000_000_000
    pairer = Pairer(counters, m.PERIOD_NS, now_ns=start)
    pixels = bytes(m.PIXELS)
    right_of_one_moment = pairs = 0
    for k in range(COUNT // 4):
        stamp = start + k * m.PERIOD_NS
        for side in (LEFT, RIGHT):
            data = video(side, stamp, k)
            spoiled = rng.random() < 1 / 3
            header = damage(data, rng) if spoiled else data
            if len(header) != len(data):
                with pytest.raises(p.ProtocolError):
                    samples.decode_video_endpoint(header)
                continue
            try:
                sample = samples.decode_video_endpoint(header + pixels)
            except p.ProtocolError:
                continue
            assert isinstance(sample, samples.VideoSample)
            image = CameraImage(sample.stamp_ns, sample.frame_id, sample.pixels, sample.exposure_us, sample.gain)
            pair = pairer.push(LEFT if sample.sensor == Sensor.LEFT else RIGHT, image)
            if pair is not None:
                pairs += 1
                # bits of the stamp below half a period cannot be told from jitter; the pair must be of this moment
                assert abs(pair.left.stamp_ns - stamp) < 1.5 * m.PERIOD_NS
                right_of_one_moment += abs(pair.left.stamp_ns - pair.right.stamp_ns) < 1_000_000
    assert right_of_one_moment == pairs > COUNT // 16
    assert counters["implausible"] > 10


def test_damaged_descriptors(monkeypatch: pytest.MonkeyPatch) -> None:
    """A device that describes itself wrongly is refused with our error, whatever pyusb makes of it."""
    camera = SimulatedCamera(noise_content(1))
    camera.booted = True
    bus = SimulatedBus([camera])
    device = attached(bus)[0]
    rng = random.Random(4)
    names = ("get_configuration_descriptor", "get_interface_descriptor", "get_endpoint_descriptor")
    values = [0, 1, 2, 7, 255, 0x81, -1, None]
    fields = ("bNumInterfaces", "bConfigurationValue", "bInterfaceNumber", "bAlternateSetting", "bNumEndpoints",
              "bEndpointAddress", "bmAttributes", "wMaxPacketSize", "extra_descriptors")  # fmt: skip
    original = {name: getattr(bus, name) for name in names}

    def spoil(name: str) -> Any:
        spoiled_name, field, value = (
            rng.choice(names),
            rng.choice(fields),
            rng.choice(values),
        )

        def spoiled(*args: Any) -> Any:
            out = original[name](*args)
            if name == spoiled_name and hasattr(out, field):
                out = SimpleNamespace(**{**out.__dict__, field: value})
                if value is None:
                    delattr(out, field)
            return out

        return spoiled

    opened = 0
    for _ in range(COUNT // 10):
        for name in names:
            monkeypatch.setattr(bus, name, spoil(name))
        device = attached(bus)[0]
        bus._claimed.clear()
        try:
            link = Link(device, Timing(command_ms=50))
            link.command(p.request(Id.GET_TIME))
            link.close()
            opened += 1
        except StereoSfmError:
            pass
    assert opened > 100


def test_damaged_replies_through_the_link(monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands to a camera with invalid replies: an error each time, and never a hang."""
    camera = SimulatedCamera(noise_content(1))
    camera.booted = True
    bus, rng = SimulatedBus([camera]), random.Random(5)
    link = Link(attached(bus)[0], Timing(command_ms=1))
    good = answers()
    original = camera.read_reply

    def damaged(wait: float, generation: int) -> bytes:
        return damage(original(wait, generation) or good[1], rng)[: m.COMMAND_BUFFER]

    monkeypatch.setattr(camera, "read_reply", damaged)
    began, fine = time.monotonic(), 0
    for _ in range(COUNT // 20):
        try:
            status, payload = link.command(p.request(Id.GET_TIME))
            fine += status == 0 and len(payload) == 8
        except (DeviceError, p.ProtocolError):
            pass
        camera._replies.clear()
    assert time.monotonic() - began < 20
    assert fine < COUNT // 40
    link.close()


def test_lock_follows_a_camera_whose_counter_really_changed() -> None:
    lock = ContinuityFilter(m.PERIOD_NS, None)
    none = np.zeros((1, 1), np.uint8)

    def camera_image(counter: int, periods: float) -> CameraImage:
        return CameraImage(round(periods * m.PERIOD_NS), counter, none, 1, 1)

    assert all(lock.accept(camera_image(k, k)) for k in range(3))
    assert not lock.accept(camera_image(2, 2))  # a repeated one
    assert not lock.accept(camera_image(900, 2.2))
    assert lock.accept(camera_image(5, 5))  # two lost
    assert lock.accept(camera_image(90, 6))  # the next in time, whatever its counter says
    assert [lock.accept(camera_image(k, 500.3 + k)) for k in range(3)] == [
        False,
        False,
        True,
    ]  # another clock, consistently
