"""The project's types as Foxglove messages: calibration, poses, transforms, points, annotations, lines, text."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.Odometry_pb2 import Odometry
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.PointsAnnotation_pb2 import PointsAnnotation
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

from stereo_sfm.errors import printable
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Camera, Pinhole
from stereo_sfm.types import F32, F64, I64, LiveDepth

OBSTACLE_COLOR = (255, 90, 60, 255)
FEW = 8  # poses that are converted one by one in less time than together
LEVELS = {"DEBUG": 1, "INFO": 2, "WARNING": 3, "ERROR": 4, "CRITICAL": 5}


def stamp(message: Any, stamp_ns: int) -> Any:
    """Set `message.timestamp` and return the message."""
    message.timestamp.seconds, message.timestamp.nanos = divmod(stamp_ns, 1_000_000_000)
    return message


def stamp_of(message: Any) -> int:
    """Nanoseconds of `message.timestamp`."""
    return message.timestamp.seconds * 1_000_000_000 + message.timestamp.nanos


def poses(a_T_b: F64) -> list[Pose]:
    """(N, 4, 4) -> positions and quaternions."""
    if len(a_T_b) <= FEW:
        return [pose(one) for one in a_T_b]
    quaternions = se3.quaternion_from_rotation(a_T_b[:, :3, :3]).tolist()
    return [_pose(t, q) for t, q in zip(a_T_b[:, :3, 3].tolist(), quaternions, strict=True)]


def pose(a_T_b: F64) -> Pose:
    """(4, 4) -> position and quaternion."""
    return _pose(a_T_b[:3, 3].tolist(), se3.quaternion_from_rotation(a_T_b[:3, :3]).tolist())


def _pose(position: list[float], quaternion: list[float]) -> Pose:
    out = Pose()
    out.position.x, out.position.y, out.position.z = position
    out.orientation.x, out.orientation.y, out.orientation.z, out.orientation.w = quaternion
    return out


def matrix(position: Any, orientation: Any) -> F64:
    """Position and quaternion of a message -> (4, 4); an all-zero quaternion is no rotation."""
    q = np.array([orientation.x, orientation.y, orientation.z, orientation.w])
    rotation = se3.rotation_from_quaternion(q) if q.any() else np.eye(3)
    return se3.from_rotation_translation(rotation, np.array([position.x, position.y, position.z]))


def pose_in_frame(frame: str, stamp_ns: int, pose: Pose) -> PoseInFrame:
    """Pose of something in `frame`."""
    return stamp(PoseInFrame(frame_id=frame, pose=pose), stamp_ns)


def poses_in_frame(frame: str, stamp_ns: int, a_T_b: F64) -> PosesInFrame:
    """(N, 4, 4) -> a trajectory."""
    return stamp(PosesInFrame(frame_id=frame, poses=poses(a_T_b)), stamp_ns)


def transforms(stamp_ns: int, rows: Iterable[tuple[str, str, Pose]]) -> FrameTransforms:
    """Rows of (parent, child, parent_T_child)."""
    out = FrameTransforms()
    for parent, child, parent_T_child in rows:
        t = stamp(out.transforms.add(parent_frame_id=parent, child_frame_id=child), stamp_ns)
        t.translation.CopyFrom(parent_T_child.position)
        t.rotation.CopyFrom(parent_T_child.orientation)
    return out


def odometry(stamp_ns: int, odom_T_body: Pose, covariance: F64) -> Odometry:
    """Pose with its 6x6 covariance (x y z, then rotation about x y z), row by row."""
    out = Odometry(frame_id="odom", body_frame_id="body", pose=odom_T_body)
    out.pose_covariance.extend(covariance.ravel().tolist())
    return stamp(out, stamp_ns)


def calibration(camera: Camera, frame: str, stamp_ns: int, projection_tx: float = 0.0) -> CameraCalibration:
    """One camera. A model unknown to Foxglove is published as uncalibrated (K[0] is 0), as its schema specifies."""
    out = CameraCalibration(frame_id=frame, width=camera.width, height=camera.height)
    names = {"pinhole": ("plumb_bob", 5), "radtan": ("plumb_bob", 5), "kannala_brandt": ("kannala_brandt", 4)}
    name, count = names.get(camera.model, ("", len(camera.distortion)))
    if len(camera.distortion) > count:
        name, count = "rational_polynomial", 8
    k = camera.matrix if name else np.zeros((3, 3))
    out.distortion_model = name
    out.D.extend([*camera.distortion, *[0.0] * (count - len(camera.distortion))])
    out.K.extend(k.ravel())
    out.R.extend(np.eye(3).ravel())
    out.P.extend(np.column_stack([k, [projection_tx, 0.0, 0.0]]).ravel())
    return stamp(out, stamp_ns)


def live_depth(live: LiveDepth) -> tuple[RawImage, CameraCalibration, PointCloud]:
    """The depth image, its camera, and the obstacles, all in the left camera's frame."""
    height, width = live.depth_mm.shape
    pixels = live.depth_mm.astype("<u2").tobytes()
    image = RawImage(frame_id="cam0", width=width, height=height, encoding="16UC1", step=2 * width, data=pixels)
    camera = calibration(Pinhole(width, height, *live.pinhole.tolist()), "cam0", live.stamp_ns)
    ids = np.arange(len(live.obstacles))
    return (
        stamp(image, live.stamp_ns),
        camera,
        point_cloud("cam0", live.stamp_ns, live.obstacles.astype(float), ids, OBSTACLE_COLOR),
    )


def point_cloud(
    frame: str, stamp_ns: int, points: F64, ids: I64, color: tuple[int, int, int, int] | None = None
) -> PointCloud:
    """(N, 3) metres and (N,) ids; color, of all of them, 0 to 255."""
    layout = np.dtype([("xyz", "<f4", 3), ("id", "<u4"), *([("rgba", "u1", 4)] if color is not None else [])])
    rows = np.empty(len(points), layout)
    rows["xyz"], rows["id"] = points, ids & 0xFFFFFFFF
    if color is not None:
        rows["rgba"] = color
    out = PointCloud(frame_id=frame, point_stride=layout.itemsize, data=rows.tobytes())
    out.pose.orientation.w = 1.0
    out.fields.extend(
        PackedElementField(name=n, offset=4 * i, type=PackedElementField.FLOAT32) for i, n in enumerate("xyz")
    )
    out.fields.append(PackedElementField(name="id", offset=12, type=PackedElementField.UINT32))
    if color is not None:
        channels = enumerate(("red", "green", "blue", "alpha"))
        out.fields.extend(PackedElementField(name=n, offset=16 + i, type=PackedElementField.UINT8) for i, n in channels)
    return stamp(out, stamp_ns)


def _packed(field: int, rows: F64) -> bytes:
    """Repeated sub-messages of doubles numbered 1, 2, ... (Point2, Point3, Color) as wire bytes, without a Python loop.

    Each row is: tag of the repeated field, length, then tag and value of every double (protobuf encoding guide).
    """
    count = rows.shape[1]
    layout = np.dtype([("head", "u1", 2), ("items", [("tag", "u1"), ("value", "<f8")], count)])
    out = np.empty(len(rows), layout)
    out["head"] = field << 3 | 2, 9 * count
    out["items"]["tag"] = np.arange(1, count + 1) << 3 | 1
    out["items"]["value"] = rows
    return out.tobytes()


def point_annotations(stamp_ns: int, uv: F64, colors: F32, thickness: float = 3.0) -> ImageAnnotations:
    """(N, 2) px and (N, 4) red green blue alpha in [0, 1] -> dots on an image."""
    dots = PointsAnnotation(type=PointsAnnotation.POINTS, thickness=thickness)
    dots.MergeFromString(_packed(PointsAnnotation.POINTS_FIELD_NUMBER, uv))
    dots.MergeFromString(_packed(PointsAnnotation.OUTLINE_COLORS_FIELD_NUMBER, np.asarray(colors, float)))
    stamp(dots, stamp_ns)
    return stamp(ImageAnnotations(points=[dots]), stamp_ns)


def line_list(points: F64, color: Sequence[float], thickness: float = 2.0) -> LinePrimitive:
    """(2N, 3) metres: N segments of a colour (red, green, blue, alpha), thickness in pixels."""
    out = LinePrimitive(type=LinePrimitive.LINE_LIST, thickness=thickness, scale_invariant=True)
    out.pose.orientation.w = 1.0
    out.MergeFromString(_packed(LinePrimitive.POINTS_FIELD_NUMBER, points))
    out.color.r, out.color.g, out.color.b, out.color.a = color
    return out


def scene(frame: str, stamp_ns: int, entities: Iterable[tuple[str, LinePrimitive]]) -> SceneUpdate:
    """Named sets of lines; a name replaces what it showed before."""
    out = SceneUpdate()
    for name, lines in entities:
        stamp(out.entities.add(frame_id=frame, id=name, lines=[lines]), stamp_ns)
    return out


def text(stamp_ns: int, level: str, message: str, name: str = "stereo_sfm") -> Log:
    """A human-readable line; `level` is a name of `logging`."""
    return stamp(Log(level=LEVELS.get(level, 2), message=printable(message), name=name), stamp_ns)  # pyright: ignore[reportArgumentType]
