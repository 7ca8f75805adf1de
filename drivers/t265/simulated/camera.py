"""The simulated camera: answers commands, generates frames and inertial samples by its own clock."""

from __future__ import annotations

import random
import struct
import threading
import time
from collections import deque
from dataclasses import dataclass, field

import numpy as np

from stereo_sfm.drivers.t265 import messages as m
from stereo_sfm.drivers.t265.firmware import SIZE
from stereo_sfm.drivers.t265.messages import Id, Sensor, Status
from stereo_sfm.drivers.t265.protocol import StreamProfile
from stereo_sfm.drivers.t265.simulated.content import Content
from stereo_sfm.drivers.t265.simulated.faults import Faults
from stereo_sfm.drivers.t265.simulated.wire import (
    OFFERED,
    Transfer,
    device_info,
    extrinsics,
    intrinsics,
    left_T_imu,
    motion_intrinsics,
    motion_sample,
    reply,
    status_event,
    video_transfer,
)

_QUEUE_FRAMES = 4  # buffered while the host does not read
_LATENCY_NS = 12_000_000  # from mid-exposure to the first byte
_GYRO_NS, _ACCEL_NS = 5_000_000, 16_000_000


class Disconnected(Exception):
    """The camera left the bus during an operation."""


@dataclass
class _Session:
    """One START to STOP."""

    start_ns: int  # host clock
    base: int  # number of its frame 0 since the camera first streamed
    next_frame: int = 0
    pending: deque[Transfer] = field(default_factory=deque[Transfer])
    next_gyro_ns: int = 0
    next_accel_ns: int = 0
    counter_extra: int = 0
    stop_reported: set[int] = field(default_factory=set[int])
    stopping: bool = False
    leaving: bool = False  # unplugged after what is pending


class SimulatedCamera:
    """A T265 between power-up and unplugging, any number of times.

    Args:
        content: the scene.
        faults: simulated faults.
        paced: frames come at 30 Hz by the clock; else as fast as the host reads.
        serial: 12 hexadecimal digits.
    """

    def __init__(
        self, content: Content, faults: Faults | None = None, paced: bool = True, serial: str = "0000D0C0FFEE"
    ) -> None:
        self.content, self.faults, self.paced, self.serial = content, faults or Faults(), paced, serial
        self.booted = False
        self.generation = 0  # changes whenever the camera leaves the bus
        self.absent_until_ns = 0  # host clock; -1: forever
        self.received: list[int] = []  # ids of commands, for tests
        self.boot_bytes = b""
        self.sent_frames = 0  # pairs due so far, read or not
        self.overruns = 0  # frames lost because the host did not read
        self._first_ns = 0  # host clock at the first START
        self._boot_ns = time.monotonic_ns()
        self._session: _Session | None = None
        self._replies: deque[bytes] = deque()
        self._busy_remaining = self.faults.busy_replies
        self._stall_done = self._unplug_done = False
        self._streams: set[int] = set()
        self._changed = threading.Condition()
        self._left_T_imu = left_T_imu(content.rig)
        self._noise = random.Random(1)

    # ---- called by the bus

    @property
    def present(self) -> bool:
        """Whether it is on the bus."""
        return 0 <= self.absent_until_ns <= time.monotonic_ns()

    def leave(self, seconds: float) -> None:
        """Off the bus for a time (forever if negative)."""
        with self._changed:
            self.generation += 1
            self.absent_until_ns = -1 if seconds < 0 else time.monotonic_ns() + round(seconds * 1e9)
            self._session = None
            self._replies.clear()
            self._changed.notify_all()

    def unplug(self, seconds: float) -> None:
        """Power loss: it comes back without firmware."""
        self.booted = False
        self.leave(seconds)

    def reset(self) -> None:
        """The vendor request: back to the boot state."""
        self._stall_done = True
        self.unplug(0.2)

    def take_firmware(self, data: bytes) -> int:
        """Bulk OUT in the boot state. The camera reappears a moment after the last byte."""
        self.boot_bytes += data
        if len(self.boot_bytes) >= SIZE:
            good, self.boot_bytes = len(self.boot_bytes) == SIZE, b""
            self.booted = good
            self._boot_ns = time.monotonic_ns()
            self.leave(0.15 if self.faults.returns_after_boot else -1)
        return len(data)

    # ---- commands

    def command(self, data: bytes) -> None:
        """One request on endpoint 0x02; its answer waits on 0x82."""
        length, message = struct.unpack_from("<IH", data) if len(data) >= 6 else (0, 0)
        with self._changed:
            self.received.append(message)
            if self.faults.silent_commands:
                return
            if length != len(data):
                self._replies.append(reply(message, Status.INVALID_REQUEST_LEN))
            else:
                self._replies.append(self._handle(message, data[6:]))
            self._changed.notify_all()

    def _handle(self, message: int, body: bytes) -> bytes:
        rig = self.content.rig
        if message == Id.GET_DEVICE_INFO:
            return reply(message, 0, device_info(self.faults, self.serial))
        if message == Id.GET_TIME:
            return reply(message, 0, struct.pack("<Q", self.clock_ns(time.monotonic_ns())))
        if message == Id.GET_SUPPORTED_RAW_STREAMS:
            return reply(message, 0, struct.pack("<HH", len(OFFERED), 0) + b"".join(p.encode() for p in OFFERED))
        if message == Id.GET_CAMERA_INTRINSICS:
            return reply(message, 0, intrinsics(rig, body[0]))
        if message == Id.GET_MOTION_INTRINSICS:
            return reply(message, 0, motion_intrinsics(body[0]))
        if message == Id.GET_EXTRINSICS:
            return reply(message, 0, extrinsics(rig, body[0]))
        if message == Id.GET_TEMPERATURE:
            return reply(message, 0, struct.pack("<IIffIff", 2, 0, 41.0, 85.0, 1, 38.0, 85.0))
        if message in (Id.SET_LOW_POWER_MODE, Id.SLAM_6DOF_CONTROL, Id.SET_EXPOSURE):
            return reply(message, Status.SUCCESS)
        if message == Id.EXPOSURE_MODE_CONTROL:
            return reply(message, Status.DEVICE_BUSY if self._session else Status.SUCCESS)
        if message == Id.RAW_STREAMS_CONTROL:
            return reply(message, self._choose(body))
        if message in (Id.START, Id.STOP):
            return reply(message, self._start() if message == Id.START else self._stop())
        return reply(message, Status.UNKNOWN_MESSAGE_ID)

    def _choose(self, body: bytes) -> Status:
        if self._session or self._busy_remaining > 0:
            self._busy_remaining -= 1
            return Status.DEVICE_BUSY
        (count,) = struct.unpack_from("<H", body)
        profiles = [StreamProfile.decode(body, 2 + 12 * i) for i in range(count)]
        sensors = [p.sensor for p in profiles]
        if len(set(sensors)) != count or (Sensor.LEFT in sensors) != (Sensor.RIGHT in sensors):
            return Status.INVALID_PARAMETER
        self._streams = set(sensors)
        return Status.SUCCESS

    def _start(self) -> Status:
        if self._session:
            return Status.DEVICE_BUSY
        now = time.monotonic_ns()
        if self.paced:
            self._first_ns = self._first_ns or now
            base = -((self._first_ns - now) // m.PERIOD_NS)
        else:
            base = self.sent_frames
            self._first_ns = now - base * m.PERIOD_NS
        start = self._first_ns + base * m.PERIOD_NS  # exposures stay on one grid of time over restarts
        self._session = _Session(start, base, next_gyro_ns=start + _GYRO_NS, next_accel_ns=start + _ACCEL_NS)
        if self.faults.stale_stopped:
            self._session.pending.append([status_event(Status.DEVICE_STOPPED)])
        return Status.SUCCESS

    def _stop(self) -> Status:
        if not self._session:
            return Status.DEVICE_STOPPED
        self._session.stopping = True
        if not self.faults.stall_survives_restart:
            self._stall_done = self._stall_done or self.stalled
        return Status.SUCCESS

    def clock_ns(self, host_ns: int) -> int:
        """The camera's clock."""
        return host_ns - self._boot_ns

    @property
    def stalled(self) -> bool:
        """Whether it has stopped sending images by fault."""
        f, s = self.faults, self._session
        return bool(s and f.stall_at >= 0 and not self._stall_done and s.base + s.next_frame >= f.stall_at)

    # ---- endpoints the host reads

    def read_reply(self, timeout_s: float, generation: int) -> bytes | None:
        """Endpoint 0x82; None on timeout."""
        with self._changed:
            self._changed.wait_for(lambda: self._replies or self.generation != generation, timeout_s)
            self._check(generation)
            return self._replies.popleft() if self._replies else None

    def read_video(self, timeout_s: float, generation: int) -> Transfer | None:
        """Endpoint 0x81: the next transfer as chunks of bytes."""
        deadline = time.monotonic() + timeout_s
        with self._changed:
            while True:
                self._check(generation)
                now = time.monotonic_ns()
                transfer = self._next_video(now)
                if transfer is not None:
                    return transfer
                wait = min(deadline - time.monotonic(), self._until_video_s(now))
                if time.monotonic() >= deadline:
                    return None
                self._changed.wait(max(wait, 1e-4))

    def read_events(self, timeout_s: float, generation: int, size: int) -> bytes | None:
        """Endpoint 0x83: all messages that are due and fit."""
        deadline = time.monotonic() + timeout_s
        with self._changed:
            while True:
                self._check(generation)
                data = self._due_events(time.monotonic_ns(), size)
                if data:
                    return data
                left = deadline - time.monotonic()
                if left <= 0:
                    return None
                self._changed.wait(min(left, 0.005))

    def _check(self, generation: int) -> None:
        if self.generation != generation or not self.present:
            raise Disconnected

    def _until_video_s(self, now: int) -> float:
        s = self._session
        if s is None or not self._streams or self.stalled:
            return 1.0
        return (s.start_ns + (s.next_frame + 1) * m.PERIOD_NS + _LATENCY_NS - now) * 1e-9

    def _next_video(self, now: int) -> Transfer | None:
        s = self._session
        if s is None:
            return None
        if s.stopping:
            return self._report_stopped(s, m.VIDEO_IN)
        if not s.pending and s.leaving:
            self.unplug(self.faults.unplugged_s)
            raise Disconnected
        if not s.pending and Sensor.LEFT in self._streams and not self.stalled:
            self._expose(s, now)
        return s.pending.popleft() if s.pending else None

    def _report_stopped(self, s: _Session, endpoint: int) -> Transfer | None:
        if endpoint in s.stop_reported:
            return None
        s.stop_reported.add(endpoint)
        if len(s.stop_reported) == 2:
            self._session = None
        return [status_event(Status.DEVICE_STOPPED)]

    def _expose(self, s: _Session, now: int) -> None:
        """Generate the transfers of the next due frame."""
        if self.paced:
            due = (now - s.start_ns - _LATENCY_NS) // m.PERIOD_NS - 1
            if due < s.next_frame:
                return
            if due - s.next_frame >= _QUEUE_FRAMES:
                self.overruns += due - s.next_frame - _QUEUE_FRAMES + 1
                s.next_frame = due - _QUEUE_FRAMES + 1
        index, stamp = s.base + s.next_frame, s.start_ns + (s.next_frame + 1) * m.PERIOD_NS
        counter = s.next_frame
        s.next_frame += 1
        self.sent_frames = index + 1
        f = self.faults
        if index >= f.unplug_at >= 0 and not self._unplug_done:
            s.pending.append(video_transfer(Sensor.LEFT, self.clock_ns(stamp), counter, self.content.image(index)[0]))
            self._unplug_done = s.leaving = True
            return
        if index in f.counter_skips:
            s.counter_extra += 1
        self._send_pair(s, index, counter, self.clock_ns(stamp))

    def _send_pair(self, s: _Session, index: int, counter: int, stamp: int) -> None:
        f = self.faults
        images = self.content.image(index)
        left = video_transfer(Sensor.LEFT, stamp, counter + s.counter_extra, images[0])
        skew = f.right_skew_ns.get(index, 0)
        right = video_transfer(Sensor.RIGHT, stamp + skew, counter, images[1])
        lefts: list[Transfer] = [left]
        if index in f.empty:
            lefts = [video_transfer(Sensor.LEFT, stamp, counter, images[0][:0])]
        if index in f.half:
            lefts = [[b"".join(left)[: f.half[index]]]]
        if index in f.split:
            whole = b"".join(left)
            lefts = [[whole[: f.split[index]]], [whole[f.split[index] :]]]
        if index in f.drop_left:
            lefts = []
        rights = [] if index in f.drop_right else [right]
        if index in f.garbage:
            s.pending.append([self._noise.randbytes(self._noise.choice((3, 512, 5000, m.VIDEO_BYTES)))])
        s.pending.extend(rights + lefts if index in f.swapped else lefts + rights)

    def _due_events(self, now: int, size: int) -> bytes:
        s = self._session
        if s is None:
            return b""
        if s.stopping:
            event = self._report_stopped(s, m.EVENT_IN)
            return b"".join(event) if event else b""
        due: list[tuple[int, int]] = []
        room = size // 52
        while len(due) < room:
            gyro_next = s.next_gyro_ns <= s.next_accel_ns
            stamp = s.next_gyro_ns if gyro_next else s.next_accel_ns
            if stamp + 1_000_000 > now:
                break
            due.append((stamp, Sensor.GYRO if gyro_next else Sensor.ACCEL))
            if gyro_next:
                s.next_gyro_ns += _GYRO_NS
            else:
                s.next_accel_ns += _ACCEL_NS
        due = [d for d in due if d[1] in self._streams]
        if not due:
            return b""
        seconds = np.array([(stamp - self._first_ns - m.PERIOD_NS) * 1e-9 for stamp, _ in due])
        gyro, force = self.content.inertial(seconds, self._left_T_imu)
        return b"".join(
            motion_sample(sensor, self.clock_ns(stamp), i, gyro[i] if sensor == Sensor.GYRO else force[i])
            for i, (stamp, sensor) in enumerate(due)
        )

    def seconds_of(self, camera_ns: int) -> float:
        """Seconds in the content's time of a stamp of the camera's present clock (for the truth)."""
        return (camera_ns + self._boot_ns - self._first_ns - m.PERIOD_NS) * 1e-9
