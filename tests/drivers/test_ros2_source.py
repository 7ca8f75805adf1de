"""Topics of ROS 2 as a live source, fed by a real node of rclpy."""

from __future__ import annotations

import itertools
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from stereo_sfm.drivers import open_source
from stereo_sfm.drivers.live.errors import DeviceLost
from stereo_sfm.drivers.mcap.messages import ImageMessage
from stereo_sfm.drivers.ros2.source import Ros2Source
from stereo_sfm.drivers.unreadable import Unreadable
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.pixels import BitsSoFar
from stereo_sfm.system import Tracker
from stereo_sfm.types import StereoImage
from tests.synthetic import pinhole_rig

SIMULATED = "sim:loop?size=212x200&frames=20&start=40&camera=pinhole&imu=t265"
COUNT = 90


def test_without_rclpy_it_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    import importlib.util

    found = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *a: None if name == "rclpy" else found(name, *a))
    with pytest.raises(StereoSfmError, match=r"source ROS's setup\.bash"):
        open_source("ros2:?left=/l&right=/r")
    with pytest.raises(StereoSfmError, match="cannot be a node's name"):
        open_source("ros2:/camera?left=/l")


def test_of_many_damaged_images_few_are_said_one_by_one(caplog: pytest.LogCaptureFixture) -> None:
    source: Any = object.__new__(Ros2Source)
    source.name, source._unreadable = "ros2:/l,/r", Unreadable("ros2:/l,/r", "images could not be read")
    damaged = ImageMessage(1, "left", False, b"few", 64, 48, 64, "mono8")
    assert all(source._image(0, damaged, damaged, 0) is None for _ in range(20))
    assert len(caplog.records) == 5 and "the image at 1 ns is skipped" in caplog.messages[0]
    source._unreadable.end()
    assert "20 images could not be read" in caplog.messages[-1]


def test_twelve_of_sixteen_bits_become_eight() -> None:
    rig = pinhole_rig()
    source: Any = object.__new__(Ros2Source)
    source.name, source.rig, source._bits, source._imu, source._imu_lock = "ros2", rig, BitsSoFar(), [], nullcontext()
    source._options, source._counters = SimpleNamespace(imu=False), SimpleNamespace(add=lambda *a: None)
    source._wheel = SimpleNamespace(take=lambda stamp_ns: None)
    pixels = np.resize(np.arange(4096, dtype=np.uint16), (rig.left.height, rig.left.width))
    size = rig.left.width, rig.left.height, 2 * rig.left.width
    message = ImageMessage(1, "left", False, pixels.tobytes(), *size, "mono16")
    np.testing.assert_array_equal(source._image(0, message, message, 0).left, pixels >> 4)


class Camera:
    """A node that publishes what a simulated camera sees."""

    def __init__(self, packed: bool = False, left_x_right: float | None = None) -> None:
        """Args: packed, as compressed images. left_x_right: publish this transform between the cameras, metres."""
        import rclpy
        from rclpy.qos import DurabilityPolicy, QoSProfile
        from sensor_msgs.msg import CameraInfo, CompressedImage, Image, Imu

        self.packed = packed
        self.context = rclpy.Context()
        rclpy.init(args=[], context=self.context)
        self.node = rclpy.create_node("camera", context=self.context)
        kind = CompressedImage if packed else Image
        tail = "/compressed" if packed else ""
        self.images = [self.node.create_publisher(kind, f"/cam/{s}/image_raw{tail}", 10) for s in ("left", "right")]
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.infos = [
            self.node.create_publisher(CameraInfo, f"/cam/{s}/camera_info", latched) for s in ("left", "right")
        ]
        self.imu = self.node.create_publisher(Imu, "/imu", 100)
        with open_source(SIMULATED) as source:
            self.rig, self.shots = source.rig, list(source)
        if left_x_right is not None:
            self._publish_transform(left_x_right, latched)
        self._stop = threading.Event()
        self.sent: list[int] = []
        self._thread = threading.Thread(target=self._publish)
        self._thread.start()

    def _header(self, stamp_ns: int, frame: str) -> Any:
        from builtin_interfaces.msg import Time
        from std_msgs.msg import Header

        return Header(stamp=Time(sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9), frame_id=frame)

    def _publish_transform(self, left_x_right: float, latched: Any) -> None:
        from geometry_msgs.msg import Quaternion, Transform, TransformStamped, Vector3
        from tf2_msgs.msg import TFMessage

        moved = Transform(translation=Vector3(x=left_x_right), rotation=Quaternion(w=1.0))
        row = TransformStamped(header=self._header(0, "left"), child_frame_id="right", transform=moved)
        self.transforms = self.node.create_publisher(TFMessage, "/tf_static", latched)
        self.transforms.publish(TFMessage(transforms=[row]))

    def _info(self, side: int, stamp_ns: int) -> Any:
        from sensor_msgs.msg import CameraInfo

        camera = (self.rig.left, self.rig.right)[side]
        assert camera is not None
        k = camera.matrix
        p = np.column_stack([k, [-k[0, 0] * self.rig.baseline * side, 0, 0]])
        return CameraInfo(
            header=self._header(stamp_ns, ("left", "right")[side]), width=camera.width, height=camera.height,
            distortion_model="plumb_bob", d=[0.0] * 5, k=k.ravel().tolist(), r=np.eye(3).ravel().tolist(),
            p=p.ravel().tolist(),
        )  # fmt: skip

    def _image(self, pixels: Any, stamp_ns: int, frame: str) -> Any:
        import array

        from sensor_msgs.msg import CompressedImage, Image

        header = self._header(stamp_ns, frame)
        if self.packed:
            data = array.array("B", cv2.imencode(".png", pixels)[1].tobytes())
            return CompressedImage(header=header, format="png", data=data)
        height, width = pixels.shape
        message = Image(header=header, height=height, width=width, encoding="mono8", step=width)
        message.data = array.array("B", pixels.tobytes())
        return message

    def _publish(self) -> None:
        from geometry_msgs.msg import Vector3
        from sensor_msgs.msg import Imu

        period = 1 / 30
        forth_and_back = itertools.cycle([*self.shots, *self.shots[-2:0:-1]])
        for side, publisher in enumerate(self.infos):
            publisher.publish(self._info(side, 0))
        begin = time.monotonic()
        for number in itertools.count():
            if self._stop.wait(max(0.0, begin + number * period - time.monotonic())):
                return
            stamp = 10**9 + int(number * period * 1e9)
            shot = next(forth_and_back)
            for k in range(3):
                at = self._header(stamp - 5_000_000 * (2 - k), "imu")
                self.imu.publish(
                    Imu(header=at, angular_velocity=Vector3(x=float(number)), linear_acceleration=Vector3(z=9.8))
                )
            for publisher, pixels, frame in zip(self.images, (shot.left, shot.right), ("left", "right"), strict=True):
                publisher.publish(self._image(pixels, stamp, frame))
            self.sent.append(stamp)

    def close(self) -> None:
        import rclpy

        self._stop.set()
        self._thread.join()
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)


@contextmanager
def _camera(packed: bool = False, left_x_right: float | None = None) -> Iterator[Camera]:
    pytest.importorskip("rclpy")
    camera = Camera(packed, left_x_right)
    try:
        yield camera
    finally:
        camera.close()


@pytest.mark.slow
@pytest.mark.parametrize("packed", [False, True])
def test_two_topics_at_30_hz_are_tracked_without_loss(packed: bool) -> None:
    tail = "/compressed" if packed else ""
    with _camera(packed) as camera:
        spec = f"ros2:?left=/cam/left/image_raw{tail}&right=/cam/right/image_raw{tail}&imu=/imu"
        warm = Tracker(camera.rig)
        for shot in camera.shots:  # so that its kernels are loaded
            warm.step(shot.left, shot.right, shot.stamp_ns)
        with open_source(spec) as source:
            assert source.live and abs(source.rig.baseline - camera.rig.baseline) < 1e-9
            np.testing.assert_allclose(source.rig.left.params[:4], camera.rig.left.params[:4])
            tracker, images, states = Tracker(source.rig), list[StereoImage](), list[str]()
            for image in itertools.islice(source, COUNT):
                images.append(image)
                states.append(tracker.step(image.left, image.right, image.stamp_ns).state.name)
            counters = dict(source.counters)
    stamps = np.array([i.stamp_ns for i in images])
    missing = np.diff(stamps).sum() / (1e9 / 30) + 1 - COUNT
    assert missing <= 0.01 * COUNT + 0.5, missing
    assert counters["malformed"] == counters["dropped_by_host"] == 0
    assert states.count("OK") >= COUNT - 2
    seen = {s.left.tobytes() for s in camera.shots}
    assert all(i.left.tobytes() in seen for i in images)
    samples = np.concatenate([i.imu.stamp_ns for i in images[5:] if i.imu is not None])
    assert len(samples) > 2.9 * (COUNT - 5) and (np.diff(samples) > 0).all()


@pytest.mark.slow
def test_the_cameras_are_where_tf_static_says() -> None:
    pytest.importorskip("tf2_msgs.msg")
    spec = "ros2:?left=/cam/left/image_raw&right=/cam/right/image_raw"
    with _camera(left_x_right=0.25) as camera, open_source(spec) as source:
        assert abs(source.rig.baseline - 0.25) < 1e-9 and abs(camera.rig.baseline - 0.25) > 0.01
        assert next(iter(source)).right is not None


@pytest.mark.slow
def test_what_is_missing_is_named() -> None:
    with _camera() as camera:
        for spec, why in (
            ("ros2:?wait=3", r"name the image topics.*/cam/left/image_raw"),
            ("ros2:?left=/nothing&wait=0.5", r"nobody publishes .*Image.* on /nothing"),
            ("ros2:?left=/cam/left/image_raw&right=/cam/right/camera_info&wait=0.5", "nobody publishes"),
        ):
            with pytest.raises(StereoSfmError, match=why) as caught:
                open_source(spec)
            assert "\n" not in str(caught.value)
        assert camera.rig.right is not None
        small = replace(
            camera.rig, left=replace(camera.rig.left, width=100), right=replace(camera.rig.right, width=100)
        )
        spec = "ros2:?left=/cam/left/image_raw&right=/cam/right/image_raw&wait=5"
        with open_source(spec, rig=small) as source, pytest.raises(StereoSfmError, match="the calibration is for 100x"):
            next(iter(source))


@pytest.mark.slow
def test_a_camera_that_ends_is_lost() -> None:
    with _camera() as camera, open_source("ros2:?left=/cam/left/image_raw&wait=6") as source:
        images = iter(source)
        assert next(images).right is None
        camera._stop.set()  # pyright: ignore[reportPrivateUsage]
        with pytest.raises(DeviceLost, match="brings no images: none for 6 s"):
            list(images)
    assert "rclpy" in sys.modules
