"""Small recordings with everything in them, for the tests of the log."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.drivers.memory import MemorySource
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import KannalaBrandt, Pinhole
from stereo_sfm.recording.record import record
from stereo_sfm.types import ImuSamples, StereoImage, Trajectory, WheelSamples

PERIOD_NS = 33_333_333
START_NS = 1_000_000_000
EPOCH_NS = 1_700_000_000_000_000_000


def fisheye_rig(width: int = 96, height: int = 80) -> Rig:
    """Two fisheye cameras that are not parallel, numbers with every digit used."""
    left = KannalaBrandt(width, height, 31.7 / 3, 31.9 / 3, 47.123456789, 40.1, (-0.0101, 0.0423, -0.0301, 0.0061))
    right = KannalaBrandt(width, height, 31.5 / 3, 31.4 / 3, 48.3, 39.7, (-0.0102, 0.0411, -0.0299, 0.0059))
    left_T_right = se3.exp(np.array([0.0641, 0.0002, -0.0001, 0.002, -0.003, 0.001]))
    return Rig(left, right, left_T_right, se3.exp(np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6])), name="test", serial="42")


def stereo_images(count: int, rng: np.random.Generator, size: tuple[int, int] = (96, 80)) -> list[StereoImage]:
    """Textured pairs with inertial and wheel samples, a gap, and a right camera that is a little late."""
    width, height = size
    images: list[StereoImage] = []
    for i in range(count):
        stamp = START_NS + i * PERIOD_NS
        noise = rng.integers(0, 256, (2, height, width), np.uint8)
        left, right = cv2.GaussianBlur(noise[0], (5, 5), 1.5), cv2.GaussianBlur(noise[1], (5, 5), 1.5)
        imu_stamps = stamp - np.arange(6)[::-1] * 5_000_000 + 3_000_000  # the last one is newer than the frame
        gyro, accel = rng.normal(size=(2, 6, 3))
        gyro[::3] = np.nan
        wheel = WheelSamples(np.array([stamp - 20_000_000]), rng.normal(size=(1, 3)), rng.normal(size=(1, 3)))
        images.append(
            StereoImage(
                i + (i >= 3),
                stamp,
                left.astype(np.uint8),
                right.astype(np.uint8),
                right_stamp_ns=stamp + 40_000,
                exposure_us=1234.5 + i,
                gain=1.25,
                dropped_before=int(i == 3),
                imu=ImuSamples(imu_stamps, gyro, accel),
                wheel=wheel if i % 2 else None,
            )
        )
    return images


def depth_images(count: int, rng: np.random.Generator) -> tuple[Rig, list[StereoImage]]:
    """RGB-D frames with unknown depths."""
    camera = Pinhole(64, 48, 60.0, 60.0, 31.5, 23.5)
    left_T_right = np.eye(4)
    left_T_right[0, 3] = 0.08
    images: list[StereoImage] = []
    for i in range(count):
        depth = rng.uniform(0.5, 8.0, (48, 64)).astype(np.float32)
        depth[depth < 1] = np.nan
        gray = rng.integers(0, 256, (48, 64), np.uint8)
        images.append(StereoImage(i, START_NS + i * PERIOD_NS, gray, None, depth))
    return Rig(camera, camera, left_T_right, depth=True), images


def sequence_truth(count: int, rng: np.random.Generator) -> Trajectory:
    """Poses at 100 Hz around the frames of `stereo_images`."""
    stamps = START_NS - 20_000_000 + np.arange(count) * 10_000_000
    return Trajectory(stamps.astype(np.int64), se3.exp(rng.normal(size=(count, 6))))


def write_recording(path: Path, source: MemorySource, image_format: str = "png") -> None:
    """Record everything, with a wall clock that is always the same."""
    ticks = iter(range(EPOCH_NS, EPOCH_NS + 10**12, 1000))
    for _ in record(source, path, image_format, clock=lambda: next(ticks)):
        pass


def assert_same_image(a: StereoImage, b: StereoImage) -> None:
    """Every bit of two frames."""
    scalars = ("frame_id", "stamp_ns", "right_stamp_ns", "dropped_before")
    assert [getattr(a, name) for name in scalars] == [getattr(b, name) for name in scalars]
    for name in ("left", "right", "depth", "exposure_us", "gain"):
        x, y = getattr(a, name), getattr(b, name)
        assert (x is None) == (y is None), name
        if x is not None:
            np.testing.assert_array_equal(x, y, err_msg=name)
    for name, columns in (("imu", ("stamp_ns", "gyro", "accel")), ("wheel", ("stamp_ns", "linear", "angular"))):
        x, y = getattr(a, name), getattr(b, name)
        assert (x is None) == (y is None), name
        for column in columns if x is not None else ():
            np.testing.assert_array_equal(getattr(x, column), getattr(y, column), err_msg=f"{name}.{column}")
