"""ROS 2: odometry, transforms, pose, path, map points, floor plan, diagnostics, and the commands as services."""

# The packages of ROS come with a robot's ROS, not from this project's environment.
# pyright: reportMissingImports=false

from __future__ import annotations

import importlib.util
import logging
import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from stereo_sfm.drivers.ros2.this_computer import keep_here
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.export.floor_plan import UNKNOWN
from stereo_sfm.service.messages import HealthReport, MapCloud, PoseUpdate, ServiceMessage, Started, Status
from stereo_sfm.service.outputs import dds_memory
from stereo_sfm.service.outputs.floor_grid import FloorGrids, RawPlan, aligned
from stereo_sfm.service.outputs.robot_axes import RobotAxes
from stereo_sfm.service.outputs.settings import Ros2Config
from stereo_sfm.service.publisher import COMMANDS, ServiceClient
from stereo_sfm.types import F64, U8, LiveDepth

if TYPE_CHECKING:
    from stereo_sfm.service.config import RobotConfig

log = logging.getLogger("stereo_sfm")

NODE = "stereo_sfm"
SERVICES = ("save_map", "load_map", "reset", "relocalize", "start_recording", "stop_recording", "mark")
# std_srvs/Trigger has no argument: those of a command are parameters of the node -> its uses
PARAMETERS = {
    "map_name": (("save_map", "name"), ("load_map", "name")),
    "recording_mode": (("start_recording", "mode"),),
    "mark_text": (("mark", "text"),),
}
REPLY_S = 60.0
SEEN_PX = 4  # px of the depth image between the points of `seen`: 2 cm at 2 m, less than a cell of a costmap
LEFT_FRAME, RIGHT_FRAME = "left_optical", "right_optical"
NEEDS = (
    "the ROS 2 output needs rclpy: source ROS's setup.bash in an environment with --system-site-packages, "
    "or without ROS on x86-64: pip install 'stereo-sfm[ros2]'"
)


def make(config: RobotConfig) -> Ros2Output:
    """The output.

    Raises:
        StereoSfmError: no rclpy.
    """
    if importlib.util.find_spec("rclpy") is None:
        raise StereoSfmError(NEEDS)
    return Ros2Output(config.outputs.ros2)


class Ros2Output:
    """A node of ROS 2 as a publisher."""

    wants: frozenset[type[ServiceMessage]] = frozenset({Started, Status, PoseUpdate, MapCloud, HealthReport, LiveDepth})
    preview_hz = 0.0

    def __init__(self, config: Ros2Config) -> None:
        """Args: config, the names of frames and topics."""
        self._config = config
        self._axes: RobotAxes | None = None
        self._health: HealthReport | None = None
        self._stamp_ns = 0  # of the newest pose
        self._clock_ns = 0  # wall clock minus the camera's
        self._plans = FloorGrids(self._take_plan)
        self._plan: RawPlan | None = None  # the newest
        self._in_saved_map = self._plan_sent = False
        self._session = 0
        self._topics: dict[str, Any] = {}
        self._node: Any = None
        self._lock = threading.Lock()

    def open(self, service: ServiceClient) -> None:
        """Start the node.

        Raises:
            StereoSfmError: a name that ROS does not take.
        """
        import rclpy
        from rclpy.executors import MultiThreadedExecutor
        from rclpy.signals import SignalHandlerOptions

        keep_here()
        dds_memory.sweep()  # a service before this one may have been killed
        try:
            if not rclpy.ok():
                rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
            self._node = rclpy.create_node(NODE, namespace=self._config.namespace or None)
            self._declare()
            self._advertise()
            self._serve(service)
        except Exception as error:  # rclpy has many kinds, most of them RuntimeError's
            raise StereoSfmError(f"ROS 2: {' '.join(str(error).split())}") from None
        self._executor = MultiThreadedExecutor(2)
        self._executor.add_node(self._node)
        threading.Thread(target=self._executor.spin, daemon=True).start()

    def close(self) -> None:
        """End the node."""
        import rclpy

        if self._node is not None:
            self._executor.shutdown(0.2)
            self._node.destroy_node()
            rclpy.try_shutdown()

    def put(self, message: ServiceMessage) -> None:
        """Publish a message."""
        takers: dict[type, Callable[[Any], None]] = {
            Started: self._started,
            PoseUpdate: self._pose,
            MapCloud: self._cloud,
            Status: self._status,
            HealthReport: self._take_health,
            LiveDepth: self._depth,
        }
        with self._lock:
            takers[type(message)](message)

    # -- the node -----------------------------------------------------------------------------------------------------

    def _declare(self) -> None:
        for name, uses in PARAMETERS.items():
            command, argument = uses[0]
            self._node.declare_parameter(name, COMMANDS[command].arguments[argument])

    def _advertise(self) -> None:
        from geometry_msgs.msg import PoseWithCovarianceStamped
        from nav_msgs.msg import OccupancyGrid, Odometry, Path
        from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
        from sensor_msgs.msg import CameraInfo, Image, PointCloud2

        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        kinds: list[tuple[str, Any, Any]] = [
            ("odom", Odometry, 10),
            ("pose", PoseWithCovarianceStamped, 10),
            ("path", Path, latched),
            ("map_points", PointCloud2, latched),
            ("floor_plan", OccupancyGrid, latched),
            ("depth", Image, qos_profile_sensor_data),
            ("camera_info", CameraInfo, qos_profile_sensor_data),
            ("obstacles", PointCloud2, qos_profile_sensor_data),
            ("seen", PointCloud2, qos_profile_sensor_data),
        ]
        if self._has("diagnostic_msgs", "diagnostics"):
            from diagnostic_msgs.msg import DiagnosticArray

            kinds.append(("/diagnostics", DiagnosticArray, 10))
        if self._config.tf and self._has("tf2_msgs", "transforms"):
            from tf2_msgs.msg import TFMessage

            kinds += [("/tf", TFMessage, 100), ("/tf_static", TFMessage, latched)]
        self._topics = {name: self._node.create_publisher(kind, name, quality) for name, kind, quality in kinds}

    @staticmethod
    def _has(package: str, what: str) -> bool:
        there = importlib.util.find_spec(package) is not None
        if not there:
            log.warning("ROS 2: %s are not published: the package %s is not installed", what, package)
        return there

    def _serve(self, service: ServiceClient) -> None:
        from rclpy.callback_groups import ReentrantCallbackGroup
        from std_srvs.srv import Trigger

        group = ReentrantCallbackGroup()
        for name in SERVICES:

            def handle(_: Any, response: Any, name: str = name) -> Any:
                reply = service.call(name, REPLY_S, **self._arguments(name))
                response.success, response.message = reply.ok, reply.text
                return response

            self._node.create_service(Trigger, f"~/{name}", handle, callback_group=group)

    def _arguments(self, command: str) -> dict[str, Any]:
        """Of a command, from the node's parameters."""
        return {
            argument: self._node.get_parameter(parameter).value
            for parameter, uses in PARAMETERS.items()
            for of, argument in uses
            if of == command
        }

    # -- messages -----------------------------------------------------------------------------------------------------

    def _started(self, started: Started) -> None:
        self._axes = RobotAxes(started.rig)
        self._in_saved_map &= started.session == self._session  # else its frame is its own until the map is recognised
        self._session = started.session
        self._publish_plan()
        if "/tf_static" not in self._topics:
            return
        from tf2_msgs.msg import TFMessage

        from stereo_sfm.service.outputs import ros2_messages as ros

        now, base = time.time_ns(), self._config.base_frame
        rows = [ros.transform(now, base, LEFT_FRAME, self._axes.base_T_left)]
        if started.rig.second_camera is not None:
            rows.append(ros.transform(now, LEFT_FRAME, RIGHT_FRAME, started.rig.left_T_right))
        self._topics["/tf_static"].publish(TFMessage(transforms=rows))

    def _pose(self, update: PoseUpdate) -> None:
        from stereo_sfm.service.outputs import ros2_messages as ros

        if self._axes is None:
            return
        c = self._config
        stamp = self._stamp_ns = update.stamp_ns if c.use_sim_time else update.unix_ns
        self._clock_ns = update.unix_ns - update.stamp_ns
        at = self._axes.pose(update)
        self._topics["odom"].publish(ros.odometry(stamp, c.odom_frame, c.base_frame, at))
        if "/tf" in self._topics:
            from tf2_msgs.msg import TFMessage

            rows = [
                ros.transform(stamp, c.map_frame, c.odom_frame, at.map_T_odom),
                ros.transform(stamp, c.odom_frame, c.base_frame, at.odom_T_base),
            ]
            self._topics["/tf"].publish(TFMessage(transforms=rows))
        self._topics["pose"].publish(ros.pose_in_map(stamp, c.map_frame, at))

    def _cloud(self, cloud: MapCloud) -> None:
        from stereo_sfm.service.outputs import ros2_messages as ros

        if self._axes is None:
            return
        stamp, frame = self._now(), self._config.map_frame
        self._topics["map_points"].publish(ros.cloud(stamp, frame, self._axes.points(cloud.points.astype(float))))
        self._topics["path"].publish(ros.path(stamp, frame, self._axes.cameras(cloud.map_T_kf)))

    def _depth(self, live: LiveDepth) -> None:
        """Depth in the left camera; obstacles, and all that is seen, which clears them, in the robot's frame."""
        from stereo_sfm.service.outputs import ros2_messages as ros

        if self._axes is None:
            return
        stamp = live.stamp_ns if self._config.use_sim_time else live.stamp_ns + self._clock_ns
        self._topics["depth"].publish(ros.depth_image(stamp, LEFT_FRAME, live.depth_mm))
        self._topics["camera_info"].publish(ros.camera_info(stamp, LEFT_FRAME, live))
        for topic, points in (("obstacles", live.obstacles.astype(float)), ("seen", live.points(SEEN_PX))):
            there = self._axes.points(points)
            self._topics[topic].publish(ros.cloud(stamp, self._config.base_frame, there))

    def _take_health(self, health: HealthReport) -> None:
        self._health = health

    def _status(self, status: Status) -> None:
        from stereo_sfm.service.outputs import ros2_messages as ros

        self._plans.follow(status)
        if status.session == self._session and status.in_saved_map != self._in_saved_map:
            self._in_saved_map = status.in_saved_map
            self._publish_plan()
        if "/diagnostics" in self._topics:
            self._topics["/diagnostics"].publish(ros.diagnostics(self._now(), status, self._health))

    def _take_plan(self, image: U8, resolution: float, origin: tuple[float, float], map_T_floor: F64) -> None:
        """A new floor plan, from another thread."""
        with self._lock:
            self._plan = image, resolution, origin, map_T_floor
            self._publish_plan()

    def _publish_plan(self) -> None:
        """The floor plan in the axes of the poses, once both are known; unknown floor where they have another frame."""
        from stereo_sfm.service.outputs import ros2_messages as ros

        if self._axes is None or self._plan is None or not (self._in_saved_map or self._plan_sent):
            return
        image, resolution, origin, map_T_floor = self._plan
        image = image if self._in_saved_map else np.full_like(image, UNKNOWN)
        self._plan_sent = self._in_saved_map
        plan = aligned(image, resolution, origin, self._axes.in_map(map_T_floor))
        self._topics["floor_plan"].publish(ros.grid(self._now(), self._config.map_frame, plan))

    def _now(self) -> int:
        """The newest pose's stamp, or the wall clock before there is one."""
        return self._stamp_ns or (0 if self._config.use_sim_time else time.time_ns())
