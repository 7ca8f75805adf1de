"""The ROS 2 output, received and called by real nodes of rclpy."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

from stereo_sfm.geometry import se3
from stereo_sfm.service.config import RobotConfig
from stereo_sfm.service.link import OutputProcess
from stereo_sfm.service.messages import ServiceState, Status
from stereo_sfm.service.outputs import dds_memory, ros2
from stereo_sfm.service.outputs.robot_axes import RobotAxes
from stereo_sfm.service.outputs.ros2 import SERVICES, Ros2Output
from stereo_sfm.service.outputs.settings import Ros2Config
from stereo_sfm.service.publisher import Reply
from tests.service.service_messages import NAN6, FakeService, cloud, health, live_depth, pose_update, started, status
from tests.service.test_service import wait_for
from tests.synthetic import pinhole_rig

rclpy = pytest.importorskip("rclpy")
pytest.importorskip("rclpy.executors")


class Listener:
    """A node of somebody else."""

    def __init__(self) -> None:
        from rclpy.executors import SingleThreadedExecutor

        self.context = rclpy.Context()
        rclpy.init(args=[], context=self.context)
        self.node = rclpy.create_node("listener", context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.got: dict[str, list[Any]] = {}

    def listen(self, topic: str, kind: Any, latched: bool = False) -> None:
        from rclpy.qos import DurabilityPolicy, QoSProfile

        quality = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL) if latched else 10
        self.got[topic] = []
        self.node.create_subscription(kind, topic, self.got[topic].append, quality)

    def until(self, true: Callable[[], Any], seconds: float = 20) -> None:
        end = time.monotonic() + seconds
        while not true():
            assert time.monotonic() < end, {topic: len(got) for topic, got in self.got.items()}
            self.executor.spin_once(timeout_sec=0.05)

    def close(self) -> None:
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)


@contextmanager
def _talking(service: FakeService | None = None, **config: Any) -> Iterator[tuple[Ros2Output, Listener]]:
    output, listener = Ros2Output(Ros2Config(True, **config)), Listener()
    output.open(service or FakeService())
    output.put(started())
    try:
        yield output, listener
    finally:
        output.close()
        listener.close()


def _kinds() -> dict[str, tuple[Any, bool]]:
    from geometry_msgs.msg import PoseWithCovarianceStamped
    from nav_msgs.msg import OccupancyGrid, Odometry, Path
    from sensor_msgs.msg import PointCloud2

    return {
        "odom": (Odometry, False),
        "pose": (PoseWithCovarianceStamped, False),
        "path": (Path, True),
        "map_points": (PointCloud2, True),
        "floor_plan": (OccupancyGrid, True),
    }


def test_nodes_receive_poses_cloud_path_and_plan() -> None:
    update = pose_update(
        3, se3.exp(np.array([0.1, 0, 2.0, 0, 0.3, 0])), map_T_odom=se3.exp(np.array([0, 0, 1.0, 0, 0.1, 0]))
    )
    with _talking() as (output, listener):
        for topic, (kind, latched) in _kinds().items():
            listener.listen(topic, kind, latched)
        output.put(cloud(300, 4))
        plan = np.full((20, 30), 254, np.uint8)
        output._take_plan(plan, 0.1, (0.0, 0.0), np.diag([1.0, -1, -1, 1]))  # pyright: ignore[reportPrivateUsage]
        output.put(Status(ServiceState.RUNNING, localized=True, session=started().session))

        def received() -> bool:
            output.put(update)
            return all(listener.got.values())

        listener.until(received)
    axes = RobotAxes(pinhole_rig())
    at, odom, pose = axes.pose(update), listener.got["odom"][0], listener.got["pose"][0]
    assert (odom.header.frame_id, odom.child_frame_id) == ("odom", "base_link")
    assert odom.header.stamp.sec * 10**9 + odom.header.stamp.nanosec == update.unix_ns
    position = odom.pose.pose.position
    np.testing.assert_allclose([position.x, position.y, position.z], at.odom_T_base[:3, 3])
    np.testing.assert_allclose(odom.pose.covariance, at.covariance.ravel())
    assert odom.twist.twist.linear.x == pytest.approx(0.5) and odom.twist.twist.angular.z == pytest.approx(0.1)
    assert pose.header.frame_id == "map" and pose.pose.pose.position.x == pytest.approx(at.map_T_base[0, 3])
    points = np.frombuffer(listener.got["map_points"][0].data, "<f4").reshape(-1, 3)
    np.testing.assert_allclose(points, axes.points(cloud(300, 4).points.astype(float)), atol=1e-5)
    assert len(listener.got["path"][0].poses) == 4 and listener.got["path"][0].poses[
        3
    ].pose.position.x == pytest.approx(3)
    grid = listener.got["floor_plan"][0]
    assert (grid.info.width, grid.info.height) and set(grid.data) <= {-1, 0, 100} and 0 in grid.data


def test_a_floor_plan_that_is_ready_before_the_camera_is_published_with_it() -> None:
    from nav_msgs.msg import OccupancyGrid

    output, listener = Ros2Output(Ros2Config(True)), Listener()
    try:
        output.open(FakeService())
        listener.listen("floor_plan", OccupancyGrid, True)
        plan = np.full((20, 30), 254, np.uint8)
        output._take_plan(plan, 0.1, (0.0, 0.0), np.diag([1.0, -1, -1, 1]))  # pyright: ignore[reportPrivateUsage]
        output.put(started())
        output.put(Status(ServiceState.RUNNING, map_is_new=True, session=started().session))
        listener.until(lambda: bool(listener.got["floor_plan"]))
    finally:
        output.close()
        listener.close()


def test_nodes_receive_depth_and_obstacles() -> None:
    """As Nav2's layers do: the obstacles are in the robot's frame."""
    from rclpy.qos import qos_profile_sensor_data
    from sensor_msgs.msg import CameraInfo, Image, PointCloud2

    sent = live_depth(3)
    with _talking() as (output, listener):
        kinds = {"depth": Image, "camera_info": CameraInfo, "obstacles": PointCloud2, "seen": PointCloud2}
        for topic, kind in kinds.items():
            listener.got[topic] = []
            listener.node.create_subscription(kind, topic, listener.got[topic].append, qos_profile_sensor_data)
        output.put(pose_update(2))

        def received() -> bool:
            output.put(sent)
            return all(listener.got.values())

        listener.until(received)
    depth, camera, cloud_ = (listener.got[name][0] for name in ("depth", "camera_info", "obstacles"))
    assert (depth.encoding, depth.width, depth.height, depth.step) == ("16UC1", 6, 4, 12)
    np.testing.assert_array_equal(np.frombuffer(depth.data, "<u2").reshape(4, 6), sent.depth_mm)
    assert (camera.width, camera.height, camera.k[0], camera.p[2]) == (6, 4, 5.0, 2.5)
    assert depth.header == camera.header and depth.header.frame_id == ros2.LEFT_FRAME
    stamp = pose_update(3).unix_ns
    assert cloud_.header.stamp.sec * 10**9 + cloud_.header.stamp.nanosec == stamp
    assert cloud_.header.frame_id == "base_link"
    points = np.frombuffer(cloud_.data, "<f4").reshape(-1, 3)
    expected = [[p[2], -p[0], -p[1]] for p in sent.obstacles]  # the camera looks ahead
    np.testing.assert_allclose(points, expected, atol=1e-6)
    seen = np.frombuffer(listener.got["seen"][0].data, "<f4").reshape(-1, 3)
    np.testing.assert_allclose(seen, [[p[2], -p[0], -p[1]] for p in sent.points(ros2.SEEN_PX)], atol=1e-6)


def test_an_unknown_velocity_is_zero_with_a_large_variance_and_the_camera_clock_is_simulated_time() -> None:
    with _talking(use_sim_time=True, namespace="robot1", odom_frame="vo") as (output, listener):
        listener.listen("/robot1/odom", _kinds()["odom"][0])

        def received() -> bool:
            output.put(pose_update(5, twist=NAN6, state="LOST", tracked=False))
            return bool(listener.got["/robot1/odom"])

        listener.until(received)
    odom = listener.got["/robot1/odom"][0]
    assert odom.header.frame_id == "vo" and odom.header.stamp.sec == 1  # the camera's clock begins at 1 s
    assert odom.twist.twist.linear.x == 0 and odom.twist.covariance[0] >= 1e6


def test_every_command_is_a_service() -> None:
    from rclpy.parameter import Parameter
    from std_srvs.srv import Trigger

    service = FakeService({"save_map": Reply(False, "the disk is full")})
    with _talking(service) as (output, listener):
        output._node.set_parameters([Parameter("map_name", value="monday")])  # pyright: ignore[reportPrivateUsage]
        for name in SERVICES:
            client = listener.node.create_client(Trigger, f"/stereo_sfm/{name}")
            listener.until(client.service_is_ready)
            future = client.call_async(Trigger.Request())
            listener.until(future.done)
            answer = future.result()
            expected = (False, "the disk is full") if name == "save_map" else (True, f"{name} done")
            assert (answer.success, answer.message) == expected
    assert [name for name, _ in service.calls] == list(SERVICES)
    assert dict(service.calls)["load_map"] == {"name": "monday"} and dict(service.calls)["start_recording"] == {
        "mode": "full"
    }


def test_diagnostics_tell_what_is_wrong() -> None:
    message = pytest.importorskip("diagnostic_msgs.msg")
    with _talking() as (output, listener):
        listener.listen("/diagnostics", message.DiagnosticArray)
        output.put(health())

        def received() -> bool:
            output.put(status(ServiceState.CAMERA_GONE, reason="The camera is gone."))
            return bool(listener.got["/diagnostics"])

        listener.until(received)
    row = listener.got["/diagnostics"][0].status[0]
    assert row.level == message.DiagnosticStatus.ERROR and row.message == "The camera is gone."
    assert {v.key: v.value for v in row.values}["dropped_ring"] == "3"


def test_transforms_lead_from_the_map_to_the_robot_and_its_cameras() -> None:
    message = pytest.importorskip("tf2_msgs.msg")
    with _talking() as (output, listener):
        listener.listen("/tf", message.TFMessage)
        listener.listen("/tf_static", message.TFMessage, True)

        def received() -> bool:
            output.put(pose_update(1))
            return bool(listener.got["/tf"] and listener.got["/tf_static"])

        listener.until(received)
    rows = [*listener.got["/tf"][0].transforms, *listener.got["/tf_static"][0].transforms]
    assert [(r.header.frame_id, r.child_frame_id) for r in rows] == [
        ("map", "odom"),
        ("odom", "base_link"),
        ("base_link", ros2.LEFT_FRAME),
        (ros2.LEFT_FRAME, ros2.RIGHT_FRAME),
    ]


@pytest.mark.slow
@pytest.mark.usefixtures("beside")
def test_nothing_is_left_in_shared_memory() -> None:
    """Whether the output is killed, or ends with the service beside busy loops."""
    dds_memory.sweep()
    before = set(dds_memory.SHARED.glob("*fast*"))
    output = OutputProcess("ros2", RobotConfig(), lambda *_: Reply(True, ""))
    output.start()

    def started(times: int) -> bool:
        return bool(output.wants and output.starts == times and set(dds_memory.SHARED.glob("*fast*")) - before)

    wait_for(lambda: started(1) and output.pid is not None)
    os.kill(output.pid or 0, signal.SIGKILL)
    wait_for(lambda: started(2))
    output.close()
    assert set(dds_memory.SHARED.glob("*fast*")) <= before
