"""Image topics of ROS 2 as a live source, with the robot's own rclpy.

Messages are taken as they are on the wire (CDR) and read by the parsers of recorded ones
(`stereo_sfm.drivers.mcap.messages`): rclpy makes no Python objects of images.
"""

# The packages of ROS come with a robot's ROS, not from this project's environment.
# pyright: reportMissingImports=false

from __future__ import annotations

import importlib.util
import logging
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from stereo_sfm.calib.formats.camera_info import CameraInfo
from stereo_sfm.calib.imu import Imu
from stereo_sfm.calib.rig import Rig
from stereo_sfm.drivers.live.buffers import Handoff, WheelBuffer
from stereo_sfm.drivers.live.counters import Counters
from stereo_sfm.drivers.live.errors import DeviceLost, NotFound
from stereo_sfm.drivers.mcap.messages import (
    BAD_MESSAGE,
    CAMERAS,
    IMAGES,
    IMUS,
    TRANSFORMS,
    VELOCITIES,
    ImageMessage,
    ImuReading,
    Transform,
    half_of,
)
from stereo_sfm.drivers.mcap.rig import camera_of, chain, other_reading, stereo_rig
from stereo_sfm.drivers.mcap.samples import take_imu
from stereo_sfm.drivers.mcap.topics import camera_topic, is_rectified
from stereo_sfm.drivers.rig_option import chosen_rig
from stereo_sfm.drivers.ros2.this_computer import keep_here
from stereo_sfm.drivers.source import BaseSource
from stereo_sfm.drivers.unreadable import Unreadable
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.log.images import UnknownEncoding
from stereo_sfm.pixels import BitsSoFar, eight_bits
from stereo_sfm.types import StereoImage

if TYPE_CHECKING:
    from stereo_sfm.drivers.ros2 import Ros2Options

log = logging.getLogger("stereo_sfm")

WAITING_PAIRS = 8  # for the consumer: then the oldest is dropped
WAITING_IMAGES = 8  # of one camera, for the other
MAX_READINGS = 20_000
STATIC_S = 1.0  # for the fixed transforms, after everything else is there
STILLS = {kind: read for kind, read in IMAGES.items() if kind.startswith("sensor_msgs/")}  # lost messages spoil video
NEEDS = "ROS 2 needs rclpy: source ROS's setup.bash in an environment with --system-site-packages"


class _Pairs:
    """Pairs the images of two topics by their stamps; called by the executor's thread only."""

    def __init__(self, stereo: bool, tolerance_ns: int, counters: Counters) -> None:
        self.ready: Handoff[tuple[ImageMessage, ImageMessage | None]] = Handoff(WAITING_PAIRS)
        self.frames: list[str] = ["", ""]  # frame names of the newest images
        self._stereo, self._tolerance_ns, self._counters = stereo, tolerance_ns, counters
        self._waiting: tuple[deque[ImageMessage], deque[ImageMessage]] = (deque(), deque())

    def put(self, side: int, image: ImageMessage) -> None:
        """An image of the left (0) or right camera (1)."""
        self.frames[side] = image.frame
        if not self._stereo:
            self.ready.put((image, None))
            return
        self._waiting[side].append(image)
        lefts, rights = self._waiting
        while lefts and rights:
            skew = rights[0].stamp_ns - lefts[0].stamp_ns
            if abs(skew) <= self._tolerance_ns:
                self.ready.put((lefts.popleft(), rights.popleft()))
            else:
                (rights if skew < 0 else lefts).popleft()
                self._counters.add("unpaired")
        for waiting in self._waiting:
            if len(waiting) > WAITING_IMAGES:
                waiting.popleft()
                self._counters.add("unpaired")


class Ros2Source(BaseSource):
    """Live images of one or two topics, with calibration, IMU and odometry where they are published."""

    live = True

    def __init__(self, node: str, options: Ros2Options) -> None:
        """Subscribe, and wait for what is needed to begin.

        Args:
            node: name of the node.
            options: the topics.

        Raises:
            StereoSfmError: no rclpy, no such topic, or no calibration.
        """
        if importlib.util.find_spec("rclpy") is None:
            raise StereoSfmError(NEEDS)
        self._options = options
        self.counters = self._counters = Counters()
        self._topics = [t for t in (options.left, options.right) if t]
        self.name = f"ros2:{','.join(self._topics)}"
        self._unreadable = Unreadable(self.name, "images could not be read")
        self._bits = BitsSoFar()
        self._pairs = _Pairs(bool(options.right), int(options.skew_ms * 1e6), self._counters)
        self._infos: dict[str, CameraInfo] = {}
        self._calibrations: tuple[str, str] | None = None  # topics of both cameras', where these are used
        self._transforms: list[Transform] = []
        self._imu: list[ImuReading] = []
        self._imu_lock = threading.Lock()
        self._wheel = WheelBuffer()
        self._open_node(node)
        try:
            self._subscribe_all()
            self.rig = self._with_imu(chosen_rig(options.rig, self._published_rig))
        except BaseException:
            self.close()
            raise

    # -- the node -----------------------------------------------------------------------------------------------------

    def _open_node(self, name: str) -> None:
        import rclpy
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.signals import SignalHandlerOptions

        keep_here()
        self._context: Any = rclpy.Context()
        rclpy.init(args=[], context=self._context, signal_handler_options=SignalHandlerOptions.NO)
        self._node: Any = rclpy.create_node(name, context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._thread = threading.Thread(target=self._executor.spin, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the node; may be called twice."""
        if self._node is not None:
            import rclpy

            node, self._node = self._node, None
            self._executor.shutdown(1.0)
            self._thread.join(1.0)
            node.destroy_node()
            rclpy.try_shutdown(context=self._context)
            self._pairs.ready.fail(DeviceLost(f"{self.name} is closed"))
            self._unreadable.end()

    def _subscribe_all(self) -> None:
        from rclpy.qos import qos_profile_sensor_data

        if not self._options.left:
            self._await(self._image_topics)
            raise StereoSfmError(f"ros2: name the image topics: 'ros2:?left=TOPIC&right=TOPIC' ({self._there()})")
        for side, topic in enumerate(self._topics):
            self._subscribe(topic, STILLS, lambda p, side=side: self._pairs.put(side, p), qos_profile_sensor_data)
        if self._options.imu:
            topics = self._options.imu.split(",")
            for k, topic in enumerate(topics[:2]):
                take = self._take_imu if len(topics) == 1 else lambda r, k=k: self._take_imu(half_of(r, k == 0))
                self._subscribe(topic, IMUS, take, qos_profile_sensor_data)
        if self._options.odom:
            take = lambda r: self._wheel.add(r.stamp_ns, r.linear, r.angular)  # noqa: E731
            self._subscribe(self._options.odom, VELOCITIES, take, qos_profile_sensor_data)
        if importlib.util.find_spec("tf2_msgs") is not None:
            self._subscribe_static()

    def _subscribe_static(self) -> None:
        from rclpy.qos import DurabilityPolicy, QoSProfile

        latched = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._subscribe("/tf_static", TRANSFORMS, self._transforms.extend, latched, "tf2_msgs/msg/TFMessage")

    def _subscribe(
        self, topic: str, readers: dict[str, Callable[[bytes], Any]], take: Callable[[Any], None], quality: Any,
        kind: str = "",
    ) -> None:  # fmt: skip
        """Give every message of a topic that can be read to `take`."""
        kind = kind or self._kind(topic, readers)
        read = readers[kind]
        package, _, name = kind.partition("/msg/")

        def received(data: bytes) -> None:
            try:
                take(read(data))
            except BAD_MESSAGE as error:
                self._counters.add("malformed")
                log.debug("%s: %s", topic, error)

        module = importlib.import_module(f"{package}.msg")
        self._node.create_subscription(getattr(module, name), topic, received, quality, raw=True)

    def _kind(self, topic: str, readers: dict[str, Callable[[bytes], Any]]) -> str:
        """The type of a topic, which somebody must publish.

        Raises:
            NotFound: nobody does, or something else.
        """

        def published() -> str:
            kinds: dict[str, list[str]] = dict(self._node.get_topic_names_and_types())
            return next((k for k in kinds.get(self._full(topic), []) if k in readers), "")

        found = self._await(published)
        if not found:
            known = " or ".join(k for k in readers if "/msg/" in k)
            raise NotFound(f"ros2: nobody publishes {known} on {topic} ({self._there()})")
        return found

    @staticmethod
    def _full(topic: str) -> str:
        return topic if topic.startswith("/") else f"/{topic}"

    def _there(self) -> str:
        """What images there are, and where ROS looks."""
        images = self._image_topics()
        domain = os.environ.get("ROS_DOMAIN_ID", "0")
        return f"images of ROS_DOMAIN_ID {domain}: {', '.join(images) or 'none'}"

    def _image_topics(self) -> list[str]:
        rows = self._node.get_topic_names_and_types() if self._node is not None else []
        return [topic for topic, kinds in rows if any(k in STILLS for k in kinds)]

    def _await(self, found: Callable[[], Any]) -> Any:
        """What `found` finds within the patience, else what it found last."""
        end = time.monotonic() + self._options.wait
        while not (value := found()) and time.monotonic() < end:
            time.sleep(0.02)
        return value

    # -- calibration --------------------------------------------------------------------------------------------------

    def _published_rig(self) -> Rig:
        kind = "sensor_msgs/msg/CameraInfo"
        rows = self._await(lambda: self._info_topics(kind))
        names = [camera_topic(self._full(topic), rows) for topic in self._topics]
        if not all(names) or len(set(names)) < len(names):
            raise StereoSfmError(
                f"{self.name}: nobody publishes the calibration of each camera: give one with --rig FILE"
            )
        for name in names:
            take = lambda info, name=name: self._infos.update({name: info})  # noqa: E731
            self._subscribe(name, CAMERAS, take, self._as_published(name), kind)
        if not self._await(lambda: all(name in self._infos for name in names)):
            raise StereoSfmError(f"{self.name}: no calibration came on {', '.join(names)}: give one with --rig FILE")
        infos, rectified = [self._infos[name] for name in names], is_rectified(self._topics[0])
        if len(infos) == 1:
            return Rig(camera_of(infos[0], names[0], rectified))
        self._await_transform(infos[0].frame, infos[1].frame)
        self._calibrations = names[0], names[1]
        return stereo_rig(infos[0], infos[1], self._calibrations, rectified, list(self._transforms))

    def other_reading(self) -> tuple[str, Rig] | None:
        if self._calibrations is None:
            return None
        left, right = (self._infos[name] for name in self._calibrations)
        return other_reading(left, right, self._calibrations, is_rectified(self._topics[0]), list(self._transforms))

    def _as_published(self, topic: str) -> Any:
        """Calibrations are latched by some drivers, and sent with each image by others."""
        from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

        offered = [row.qos_profile.durability for row in self._node.get_publishers_info_by_topic(topic)]
        latched = bool(offered) and all(d == DurabilityPolicy.TRANSIENT_LOCAL for d in offered)
        durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
        reliability = ReliabilityPolicy.RELIABLE if latched else ReliabilityPolicy.BEST_EFFORT
        return QoSProfile(depth=1, durability=durability, reliability=reliability)

    def _info_topics(self, kind: str) -> tuple[str, ...]:
        rows = self._node.get_topic_names_and_types()
        found = tuple(topic for topic, kinds in rows if kind in kinds)
        return found if len(found) >= len(self._topics) else ()

    def _await_transform(self, parent: str, child: str) -> None:
        end = time.monotonic() + STATIC_S
        while chain(list(self._transforms), parent, child) is None and time.monotonic() < end:
            time.sleep(0.02)

    def _with_imu(self, rig: Rig) -> Rig:
        """The rig with the IMU's pose, where an IMU is named and the transforms say where it is."""
        if rig.imu is not None or not self._options.imu:
            return rig
        self._await(lambda: self._imu and self._pairs.frames[0])
        with self._imu_lock:
            frame = self._imu[0].frame if self._imu else ""
        self._await_transform(self._pairs.frames[0], frame)
        left_T_imu = chain(list(self._transforms), self._pairs.frames[0], frame)
        if left_T_imu is None:
            log.warning("%s: no transform from the left camera to the IMU: its samples are not used", self.name)
            return rig
        return replace(rig, imu=Imu(left_T_imu))

    # -- images -------------------------------------------------------------------------------------------------------

    def _take_imu(self, reading: ImuReading) -> None:
        with self._imu_lock:
            self._imu.append(reading)
            del self._imu[:-MAX_READINGS]

    def __iter__(self) -> Iterator[StereoImage]:
        frame_id, dropped = 0, 0
        while self._pairs.ready.get(0) is not None:
            pass  # what came before somebody wanted images
        while True:
            got = self._pairs.ready.get(self._options.wait)
            if got is None:
                raise DeviceLost(f"{self.name} brings no images: none for {self._options.wait:g} s ({self._there()})")
            (left, right), lost = got
            self._counters.add("dropped_by_host", lost)
            self._counters.add("dropped", lost)
            image = self._image(frame_id, left, right, dropped + lost)
            if image is None:
                dropped += 1 + lost
                self._counters.add("implausible")
                continue
            self._counters.add("pairs")
            frame_id, dropped = frame_id + 1, 0
            yield image

    def _image(self, frame_id: int, left: ImageMessage, right: ImageMessage | None, dropped: int) -> StereoImage | None:
        """A pair decoded; None where it cannot be.

        Raises:
            StereoSfmError: it does not fit the calibration.
        """
        try:
            grey = [p.gray() for p in (left, right) if p is not None]
        except UnknownEncoding as error:
            raise StereoSfmError(f"{self.name}: {error}") from None
        except BAD_MESSAGE as error:
            self._unreadable.skip(f"the image at {left.stamp_ns} ns is skipped: {error}")
            return None
        bits = self._bits.including(grey)
        pixels = [eight_bits(image, bits) for image in grey]
        for image, camera in zip(pixels, (self.rig.left, self.rig.right), strict=False):
            if camera is not None and image.shape != (camera.height, camera.width):
                raise StereoSfmError(
                    f"{self.name}: images are {image.shape[1]}x{image.shape[0]} but the calibration is for "
                    f"{camera.width}x{camera.height}: use the calibration of these images (--rig FILE)"
                )
        with self._imu_lock:
            imu = take_imu(self._imu, left.stamp_ns) if self._options.imu else None
        self._counters.add("imu_samples", 0 if imu is None else len(imu))
        stamp = right.stamp_ns if right is not None and right.stamp_ns != left.stamp_ns else 0
        return StereoImage(
            frame_id, left.stamp_ns, pixels[0], pixels[1] if right is not None else None, right_stamp_ns=stamp,
            dropped_before=dropped, imu=imu, wheel=self._wheel.take(left.stamp_ns),
        )  # fmt: skip
