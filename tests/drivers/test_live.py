"""What both live cameras share: pairing, clocks, hand-over."""

from __future__ import annotations

from itertools import pairwise
from weakref import WeakSet

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereo_sfm.drivers.live.buffers import Handoff, MotionBuffer, WheelBuffer
from stereo_sfm.drivers.live.clock import ClockMap, TimeLine
from stereo_sfm.drivers.live.counters import COUNTERS, Counters
from stereo_sfm.drivers.live.errors import DeviceLost
from stereo_sfm.drivers.live.pairing import LEFT, RIGHT, CameraImage, ContinuityFilter, Pair, Pairer
from stereo_sfm.drivers.live.source import LiveSource, Patience, Segment

PERIOD = 33_333_333
PIXELS = np.zeros((1, 1), np.uint8)


def camera_image(frame: int, shift_ns: int = 0, counter: int | None = None) -> CameraImage:
    return CameraImage(
        1_000_000_000 + frame * PERIOD + shift_ns, frame if counter is None else counter, PIXELS, 1000, 1
    )


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_any_losses_and_any_interleaving_are_accounted_for(data: st.DataObject) -> None:
    """Images of each camera in order, both cameras interleaved within three frames, any of them lost."""
    frames = 30
    arrivals: list[tuple[float, int, int]] = []
    alive: list[set[int]] = []
    for side in (LEFT, RIGHT):
        lost = data.draw(st.sets(st.integers(0, frames - 1), max_size=10))
        late = data.draw(st.floats(0, 2.9))
        alive.append(set(range(frames)) - lost)
        arrivals += [(k + (late if side else 0), side, k) for k in sorted(alive[side])]
    counters = Counters()
    pairer = Pairer(counters, PERIOD)
    pairs: list[Pair] = []
    for _, side, frame in sorted(arrivals):
        pair = pairer.push(side, camera_image(frame, shift_ns=300_000 * side))
        if pair is not None:
            pairs.append(pair)
    expected = sorted(alive[LEFT] & alive[RIGHT])
    assert [p.left.counter for p in pairs] == expected
    assert [p.right.counter for p in pairs] == expected
    assert [p.dropped_before for p in pairs[1:]] == [b - a - 1 for a, b in pairwise(expected)]


def test_without_a_known_rate_losses_are_counted_by_the_counter() -> None:
    counters = Counters()
    pairer = Pairer(counters, 0)
    pairs = [p for k in (0, 1, 5) for side in (LEFT, RIGHT) if (p := pairer.push(side, camera_image(k * 3, counter=k)))]
    assert [p.dropped_before for p in pairs] == [0, 0, 3]


def test_a_camera_that_sends_one_side_is_reported() -> None:
    counters = Counters()
    pairer = Pairer(counters, PERIOD)
    assert not any(pairer.push(LEFT, camera_image(k)) for k in range(40))
    assert counters["unpaired"] == 10


def test_stamps_from_before_the_start_are_refused() -> None:
    pairer = Pairer(counters := Counters(), PERIOD, now_ns=60_000_000_000)
    assert not any(pairer.push(side, camera_image(0)) for side in (LEFT, RIGHT))
    assert counters["implausible"] == 2


def test_refused_images_are_not_kept() -> None:
    """A clock that goes back is refused for good; three images at most wait for being believed."""
    lock, kept = ContinuityFilter(PERIOD, None), WeakSet[CameraImage]()
    assert lock.accept(camera_image(100))
    for k in range(20):
        kept.add(image := camera_image(k))
        assert not lock.accept(image)
    del image
    assert len(kept) == 3


def test_clock_keeps_the_best_reading_until_there_is_a_good_one() -> None:
    clock = ClockMap()
    assert not clock.known
    assert not clock.add(1_000_000, 500, 3_000_000)  # half a round trip of 1 ms
    assert clock.to_host(500) == 2_000_000
    assert not clock.add(1_000_000, 500, 5_000_000)  # worse: not taken
    assert clock.to_host(500) == 2_000_000
    assert clock.add(9_000_000, 500, 9_100_000)
    assert clock.to_host(500) == 9_050_000
    assert clock.to_camera(9_050_000) == 500
    assert clock.uncertainty_ns == 50_000


def test_one_time_line_over_two_segments() -> None:
    line, first, second = TimeLine(), ClockMap(), ClockMap()
    first.add(10_000, 0, 10_000)
    line.begin_segment(first)
    assert line.frame_stamp(700) == 700
    second.add(50_000, 0, 50_000)  # the camera's clock began again 40 us later
    line.begin_segment(second)
    assert line.stamp(100) == 40_100
    assert line.frame_stamp(-39_500) == 701  # never backwards
    assert line.last == 701


def test_stamps_go_on_after_a_day_in_which_the_clocks_drifted() -> None:
    """The camera's clock is 30 ppm fast: 2.6 s. It restarts a second after its last image."""
    line, first, second, third = TimeLine(), ClockMap(), ClockMap(), ClockMap()
    host, day = 10**12, 86_400 * 10**9
    first.add(host, 0, host)
    line.begin_segment(first)
    assert line.frame_stamp(0) == 0
    camera = day + 30 * day // 10**6
    first.add(host + day, camera, host + day)
    assert line.frame_stamp(camera) == camera
    for number, clock in enumerate((second, third), 1):
        at = host + day + number * 10**9
        clock.add(at, 500, at)
        line.begin_segment(clock)
        assert line.frame_stamp(500) == camera + number * 10**9


def test_arrivals_tell_the_clock() -> None:
    """Images come 20 ms late, some more; the camera's clock is 50 ppm fast, then slow."""
    for ppm in (50, -50):
        clock, rng = ClockMap(), np.random.default_rng(1)
        for k in range(3000):
            host = k * PERIOD
            late = 20_000_000 + int(rng.integers(0, 200_000_000)) * (k % 10 > 0)
            clock.add_arrival(host + late, host + host * ppm // 10**6)
        assert clock.to_host(host + host * ppm // 10**6) == pytest.approx(host + 20_000_000, abs=100_000)


def test_handoff_drops_the_oldest_and_returns_its_weight() -> None:
    queue: Handoff[str] = Handoff(2)
    assert queue.get(0.001) is None
    for name, weight in (("a", 1), ("b", 3), ("c", 1), ("d", 1)):
        queue.put(name, weight)
    assert queue.get(0) == ("c", 4)
    queue.fail(DeviceLost("gone"))
    queue.fail(DeviceLost("again"))
    assert queue.get(0) == ("d", 0)
    with pytest.raises(DeviceLost, match="gone"):
        queue.get(0)


def test_samples_wait_for_their_image() -> None:
    motion, wheel = MotionBuffer(), WheelBuffer()
    for stamp, is_gyro in ((30, True), (10, False), (20, True)):
        motion.add(stamp, is_gyro, (stamp, 0, 0))
    taken = motion.take(20)
    assert taken is not None
    assert taken.stamp_ns.tolist() == [10, 20]
    np.testing.assert_array_equal(taken.accel[:, 0], [10, np.nan])
    np.testing.assert_array_equal(taken.gyro[:, 0], [np.nan, 20])
    assert motion.take(20) is None
    wheel.add(5, (1, 0, 0), (0, 0, 2))
    rolled = wheel.take(5)
    assert rolled is not None and rolled.linear.tolist() == [[1, 0, 0]] and rolled.angular.tolist() == [[0, 0, 2]]
    assert wheel.take(9) is None


class Waits(Handoff[Pair]):
    """Never has a pair; keeps how long each was waited for."""

    def __init__(self) -> None:
        super().__init__(1)
        self.waits: list[float] = []

    def get(self, timeout_s: float) -> tuple[Pair, int] | None:
        self.waits.append(timeout_s)
        raise KeyboardInterrupt


class Silent(LiveSource):
    """A camera that starts, and sends nothing."""

    def __init__(self, rate_hz: float) -> None:
        super().__init__("silent", "silent camera", round(1e9 / rate_hz), Patience(first_image_s=3.0))
        self.pairs, self.motion, self.clock = Waits(), MotionBuffer(), ClockMap()

    def _start(self) -> Segment:
        return self

    def _release(self) -> None: ...

    def stop(self, camera_alive: bool = True) -> None: ...


@pytest.mark.parametrize(
    ("rate_hz", "first_s", "later_s"), [(30, 3.0, 0.5), (8, 3.0, 0.5), (2, 3.0, 2.0), (1, 4.0, 4.0)]
)
def test_a_stall_is_several_periods_of_the_camera(rate_hz: float, first_s: float, later_s: float) -> None:
    source = Silent(rate_hz)
    for frames in (0, 1):
        images = iter(source)
        source._begin()
        source._segment_frames = frames
        with pytest.raises(KeyboardInterrupt):
            next(images)
    assert source.pairs.waits == [first_s, later_s]


def test_counters_have_every_documented_name() -> None:
    counters = Counters()
    assert dict(counters) == dict.fromkeys(COUNTERS, 0)
    counters.add("dropped", 2)
    assert counters["dropped"] == 2
    with pytest.raises(KeyError):
        counters.add("colour")
