"""The service's messages as messages of ROS 2. Needs its Python packages, which a robot's ROS has."""

# The packages of ROS come with a robot's ROS, not from this project's environment.
# pyright: reportMissingImports=false

from __future__ import annotations

from typing import Any

import numpy as np

from stereo_sfm.geometry import se3
from stereo_sfm.service.messages import HealthReport, ServiceState, Status
from stereo_sfm.service.outputs.floor_grid import FloorGrid
from stereo_sfm.service.outputs.robot_axes import RobotPose
from stereo_sfm.types import F64, U16, LiveDepth

UNKNOWN_VARIANCE = 1e6  # of a velocity that is not known
LATE_MS = 100.0  # latency that causes a warning


def time_of(stamp_ns: int) -> Any:
    """builtin_interfaces/Time."""
    from builtin_interfaces.msg import Time

    return Time(sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)


def header(stamp_ns: int, frame: str) -> Any:
    """std_msgs/Header."""
    from std_msgs.msg import Header

    return Header(stamp=time_of(stamp_ns), frame_id=frame)


def pose(a_T_b: F64) -> Any:
    """(4, 4) -> geometry_msgs/Pose."""
    from geometry_msgs.msg import Point, Pose, Quaternion

    x, y, z, w = se3.quaternion_from_rotation(a_T_b[:3, :3]).tolist()
    place = Point(**dict(zip("xyz", a_T_b[:3, 3].tolist(), strict=True)))
    return Pose(position=place, orientation=Quaternion(x=x, y=y, z=z, w=w))


def transform(stamp_ns: int, parent: str, child: str, parent_T_child: F64) -> Any:
    """geometry_msgs/TransformStamped."""
    from geometry_msgs.msg import Transform, TransformStamped, Vector3

    p = pose(parent_T_child)
    moved = Transform(translation=Vector3(x=p.position.x, y=p.position.y, z=p.position.z), rotation=p.orientation)
    return TransformStamped(header=header(stamp_ns, parent), child_frame_id=child, transform=moved)


def odometry(stamp_ns: int, odom: str, base: str, at: RobotPose) -> Any:
    """nav_msgs/Odometry: pose in `odom`, twist in `base`; an unknown twist is 0 with a very large variance."""
    from geometry_msgs.msg import PoseWithCovariance, Twist, TwistWithCovariance, Vector3
    from nav_msgs.msg import Odometry

    known = bool(np.isfinite(at.twist).all() and np.isfinite(at.twist_covariance).all())
    values = at.twist.tolist() if known else [0.0] * 6
    variance = at.twist_covariance if known else np.eye(6) * UNKNOWN_VARIANCE
    linear, angular = (Vector3(**dict(zip("xyz", v, strict=True))) for v in (values[:3], values[3:]))
    return Odometry(
        header=header(stamp_ns, odom),
        child_frame_id=base,
        pose=PoseWithCovariance(pose=pose(at.odom_T_base), covariance=at.covariance.ravel().tolist()),
        twist=TwistWithCovariance(twist=Twist(linear=linear, angular=angular), covariance=variance.ravel().tolist()),
    )


def pose_in_map(stamp_ns: int, frame: str, at: RobotPose) -> Any:
    """geometry_msgs/PoseWithCovarianceStamped; the covariance is that of the pose in odom, in the map's axes."""
    from geometry_msgs.msg import PoseWithCovariance, PoseWithCovarianceStamped

    turn = np.kron(np.eye(2), at.map_T_odom[:3, :3])
    covariance = (turn @ at.covariance @ turn.T).ravel().tolist()
    return PoseWithCovarianceStamped(
        header=header(stamp_ns, frame), pose=PoseWithCovariance(pose=pose(at.map_T_base), covariance=covariance)
    )


def path(stamp_ns: int, frame: str, poses: F64) -> Any:
    """(N, 4, 4) -> nav_msgs/Path."""
    from geometry_msgs.msg import PoseStamped
    from nav_msgs.msg import Path

    head = header(stamp_ns, frame)
    return Path(header=head, poses=[PoseStamped(header=head, pose=pose(p)) for p in poses])


def cloud(stamp_ns: int, frame: str, points: F64) -> Any:
    """(N, 3) -> sensor_msgs/PointCloud2 of float32 x y z."""
    from sensor_msgs.msg import PointCloud2, PointField

    fields = [PointField(name=n, offset=4 * i, datatype=PointField.FLOAT32, count=1) for i, n in enumerate("xyz")]
    out = PointCloud2(
        header=header(stamp_ns, frame), height=1, width=len(points), fields=fields, is_bigendian=False,
        point_step=12, row_step=12 * len(points), is_dense=True,
    )  # fmt: skip
    out.data = _bytes(np.ascontiguousarray(points, "<f4").tobytes(), "B")
    return out


def depth_image(stamp_ns: int, frame: str, depth_mm: U16) -> Any:
    """(H, W) -> sensor_msgs/Image of 16 bit millimetres (REP 118)."""
    from sensor_msgs.msg import Image

    height, width = depth_mm.shape
    out = Image(
        header=header(stamp_ns, frame), height=height, width=width, encoding="16UC1", is_bigendian=0, step=2 * width
    )
    out.data = _bytes(depth_mm.astype("<u2").tobytes(), "B")
    return out


def camera_info(stamp_ns: int, frame: str, live: LiveDepth) -> Any:
    """sensor_msgs/CameraInfo of a depth image, which has no distortion."""
    from sensor_msgs.msg import CameraInfo

    height, width = live.depth_mm.shape
    fx, fy, cx, cy = live.pinhole.tolist()
    return CameraInfo(
        header=header(stamp_ns, frame), height=height, width=width, distortion_model="plumb_bob", d=[0.0] * 5,
        k=[fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0], r=np.eye(3).ravel().tolist(),
        p=[fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
    )  # fmt: skip


def grid(stamp_ns: int, frame: str, plan: FloorGrid) -> Any:
    """nav_msgs/OccupancyGrid."""
    from nav_msgs.msg import MapMetaData, OccupancyGrid

    corner = se3.from_rotation_translation(np.eye(3), plan.origin)
    height, width = plan.cells.shape
    info = MapMetaData(
        map_load_time=time_of(stamp_ns), resolution=plan.resolution, width=width, height=height, origin=pose(corner)
    )
    out = OccupancyGrid(header=header(stamp_ns, frame), info=info)
    out.data = _bytes(plan.cells.tobytes(), "b")
    return out


def _bytes(data: bytes, kind: str) -> Any:
    """As the array type that rclpy takes without checking each item."""
    import array

    return array.array(kind, data)


def diagnostics(stamp_ns: int, status: Status, health: HealthReport | None) -> Any:
    """diagnostic_msgs/DiagnosticArray of the service's state and health."""
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

    level, text = DiagnosticStatus.OK, status.reason or str(status.state)
    if status.state in (ServiceState.LOST, ServiceState.CAMERA_GONE):
        level = DiagnosticStatus.ERROR
    elif status.state != ServiceState.RUNNING or status.recording_problem or _late(health):
        level, text = DiagnosticStatus.WARN, status.recording_problem or text
    values: dict[str, object] = {"state": str(status.state), "remedy": status.remedy, "recording": status.recording}
    if health is not None:
        p50, p95 = health.latency_ms
        values |= {"rate_hz": health.rate_hz, "latency_ms_p50": p50, "latency_ms_p95": p95, "restarts": health.restarts}
        values |= {f"dropped_{where}": count for where, count in health.dropped.items()}
        values |= {"disk_free": health.disk_free, "row_error_px": health.row_error_px, **health.counters}
    rows = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
    one = DiagnosticStatus(level=level, name="stereo_sfm", message=text, hardware_id="", values=rows)
    return DiagnosticArray(header=header(stamp_ns, ""), status=[one])


def _late(health: HealthReport | None) -> bool:
    return health is not None and health.latency_ms[1] > LATE_MS
