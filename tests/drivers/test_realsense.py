"""RealSense cameras and files of their recorder, with a stand-in for their library."""

from __future__ import annotations

import sys
import time
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from stereo_sfm.drivers.live.counters import Counters
from stereo_sfm.drivers.live.errors import DeviceFault, DeviceLost, NotFound
from stereo_sfm.drivers.live.pairing import Pair
from stereo_sfm.drivers.realsense import DRIVER, RealSenseOptions
from stereo_sfm.drivers.realsense.frames import Frames
from stereo_sfm.drivers.realsense.source import RealSenseStream
from stereo_sfm.errors import StereoSfmError
from tests.drivers.realsense_library import LEFT, PERIOD_MS, RIGHT, H, Library, W, frames

SIZE = (W, H)


def use(library: Library, monkeypatch: pytest.MonkeyPatch) -> Library:
    for module in ("source", "recording"):
        monkeypatch.setattr(f"stereo_sfm.drivers.realsense.{module}.load", lambda: library)
    return library


def live(**options: object) -> RealSenseOptions:
    return RealSenseOptions(**{"size": SIZE, "fps": 100, "reconnect": 2.0, **options})  # pyright: ignore


def test_a_live_pair_with_its_calibration_and_samples(monkeypatch: pytest.MonkeyPatch) -> None:
    library = use(Library(frames(20)), monkeypatch)
    with DRIVER.open("", live()) as source:
        assert source.rig.baseline == pytest.approx(0.05) and source.rig.left.size == SIZE
        assert source.rig.imu is not None and source.rig.imu.left_T_imu[0, 3] == pytest.approx(0.01)
        images = list(islice(source, 20))
    assert [image.dropped_before for image in images] == [0] * 20
    assert set(np.diff([image.stamp_ns for image in images])) == {round(1e6 * PERIOD_MS)}
    left, right = images[3].left, images[3].right
    assert right is not None and (left == 13).all() and (right == 23).all()
    assert images[5].imu is not None and len(images[5].imu.stamp_ns) == 2
    assert images[0].exposure_us == 4000 and images[0].gain == 2
    assert library.sensors[0].options["emitter_enabled"] == 0 and library.sensors[0].options["global_time_enabled"] == 0


def test_images_with_dots_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    library = use(Library(frames(20, alternate=True)), monkeypatch)
    with DRIVER.open("123", live(emitter="alternate")) as source:
        images = list(islice(source, 10))
    assert library.sensors[0].options["emitter_on_off"] == 1
    assert [int(image.left[0, 0]) for image in images] == [10, 12, 14, 16, 18] * 2
    assert not any(image.dropped_before for image in images)


def test_a_lost_camera_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    library = use(Library(frames(5)), monkeypatch)
    with DRIVER.open("", live()) as source:
        images = iter(source)
        first = list(islice(images, 5))
        library.sent += frames(5, first=300)
        again = list(islice(images, 5))
        assert again[0].frame_id == 5 and again[0].stamp_ns > first[-1].stamp_ns
        library.attached = False
        with pytest.raises(DeviceLost, match="did not come back"):
            next(images)


def test_imu_on_another_clock_is_left_out_once(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    use(Library(frames(6, imu_clock="system")), monkeypatch)
    with DRIVER.open("", live()) as source:
        assert all(image.imu is None for image in islice(source, 6))
    assert caplog.text.count("different clocks") == 1


def test_the_hardware_clock_begins_again() -> None:
    """After 2**32 microseconds: images, samples and middles of exposures go on, in whichever order they come."""
    library, wrap_ms = Library([]), 2**32 / 1e3
    taken, pairs = Frames(library, SIZE, counters := Counters(), round(1e6 * PERIOD_MS)), list[Pair]()
    for frame in frames(200):
        at = frame.stamp_ms - 1985.0 + wrap_ms  # of 2 s
        told = {"frame_timestamp": 1e3 * at % 2**32, "sensor_timestamp": 1e3 * (at - 4.0) % 2**32}
        pairs += taken.take(replace(frame, stamp_ms=at % wrap_ms, metadata=told))
    stamps = np.array([pair.left.stamp_ns for pair in pairs])
    assert len(pairs) == 200 and not counters["implausible"]
    assert set(np.diff(stamps)) == {round(1e6 * PERIOD_MS)}
    assert stamps[0] == pytest.approx(1e6 * (wrap_ms - 989.0), abs=1)
    samples = taken.motion.take(int(stamps[-1]) + 10_000_000)
    assert samples is not None and samples.stamp_ns[-1] - stamps[-1] == pytest.approx(1e6, abs=2)
    left, right = frames(1)[2:]
    system = [replace(left, clock="system", stamp_ms=left.stamp_ms + wrap_ms), replace(right, clock="system")]
    other = Frames(library, SIZE, counters, 0)
    assert not any(other.take(frame) for frame in system)  # another clock has no such end


def test_the_clock_is_read_with_each_pair() -> None:
    """The camera sends 0.2 s of images at once: its clock is ahead of what the first image told."""
    library = Library(frames(20))
    stream = RealSenseStream(library, library, Frames(library, SIZE, Counters(), 0), 30)
    pairs = [got[0] for _ in range(20) if (got := stream.pairs.get(5.0)) is not None]
    stream.stop()
    assert len(pairs) == 20 and stream.clock.to_host(pairs[-1].left.stamp_ns) <= time.monotonic_ns()


def test_a_camera_that_appears_between_two_searches(monkeypatch: pytest.MonkeyPatch) -> None:
    library = use(Library(frames(5)), monkeypatch)
    there = iter((True, False))  # when the source is made and when it starts
    monkeypatch.setattr(library, "query_devices", lambda: [library] if next(there, True) else [])
    with pytest.raises(NotFound, match="no RealSense attached"):
        DRIVER.open("", live())


def test_no_camera_another_camera_no_library(monkeypatch: pytest.MonkeyPatch) -> None:
    library = use(Library([]), monkeypatch)
    with pytest.raises(NotFound, match="no RealSense '7' attached"):
        DRIVER.open("7", live())
    library.attached = False
    with pytest.raises(NotFound, match="no RealSense attached"):
        DRIVER.open("", live())
    monkeypatch.undo()
    monkeypatch.setitem(sys.modules, "pyrealsense2", None)
    with pytest.raises(DeviceFault, match=r"pip install 'stereo-sfm\[realsense\]'"):
        DRIVER.open("", live())


def test_a_recording_is_read_without_losses(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    path = tmp_path / "drive.bag"
    use(Library([]), monkeypatch)
    with pytest.raises(StereoSfmError, match="no recording"):
        DRIVER.open(str(path), live())
    path.touch()
    use(Library(frames(100)), monkeypatch)
    with DRIVER.open(str(path), live()) as source:
        for _ in range(2):  # twice the same
            images = list(source)
            assert len(images) == 100 and not source.live
            assert images[1].imu is not None and sum(len(i.imu.stamp_ns) for i in images if i.imu) >= 198
        assert len(list(islice(source, 3))) == 3  # left early
    use(Library([], (LEFT,)), monkeypatch)
    with pytest.raises(StereoSfmError, match="no infrared pair"):
        DRIVER.open(str(path), live())
    assert RIGHT.index == 2
