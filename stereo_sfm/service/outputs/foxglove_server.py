"""The topics of the log, live, on Foxglove's WebSocket, with the commands of the service.

Topics, schemas and frames are those of the log (`stereo_sfm.log.topics`), so that one layout shows both; two are
added, `/service/status` and `/service/health`.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.Odometry_pb2 import Odometry
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage

from stereo_sfm.calib.rig import Rig
from stereo_sfm.errors import require
from stereo_sfm.log import foxglove, schema, topics
from stereo_sfm.log.image_log import level_T_map
from stereo_sfm.log.run_log import PATH_COLOR, age_colors
from stereo_sfm.messages import Health
from stereo_sfm.service.messages import (
    EVERYTHING,
    Event,
    HealthReport,
    MapCloud,
    PoseUpdate,
    PreviewImage,
    ServiceMessage,
    Started,
    Status,
)
from stereo_sfm.service.outputs.access import Access, access
from stereo_sfm.service.outputs.foxglove_protocol import Channel
from stereo_sfm.service.outputs.robot_axes import RobotAxes
from stereo_sfm.service.outputs.settings import FoxgloveConfig, SecurityConfig
from stereo_sfm.service.outputs.web_server import WebServer
from stereo_sfm.service.publisher import ServiceClient
from stereo_sfm.types import LiveDepth

if TYPE_CHECKING:
    from stereo_sfm.service.config import RobotConfig
    from stereo_sfm.service.outputs.foxglove_clients import FoxgloveClients
    from stereo_sfm.service.outputs.guard import Guard

STATUS, REPORT = "/service/status", "/service/health"
JPEG_QUALITY = 80
DEPTH_TOPICS = (topics.LIVE_DEPTH, topics.LIVE_CALIBRATION, topics.OBSTACLES)  # as `foxglove.live_depth` makes them
KINDS: dict[str, Any] = {
    topics.LEFT_CALIBRATION: CameraCalibration,
    topics.RIGHT_CALIBRATION: CameraCalibration,
    topics.TF: FrameTransforms,
    topics.TF_STATIC: FrameTransforms,
    topics.ODOMETRY: Odometry,
    topics.ODOM_POSE: PoseInFrame,
    topics.MAP_POSE: PoseInFrame,
    topics.POINTS: PointCloud,
    topics.TRAJECTORY: PosesInFrame,
    topics.PATH: PointCloud,
    topics.LEFT_IMAGE: CompressedImage,
    topics.FEATURES: ImageAnnotations,
    topics.LOG: Log,
    topics.LIVE_DEPTH: RawImage,
    topics.LIVE_CALIBRATION: CameraCalibration,
    topics.OBSTACLES: PointCloud,
}


def make(config: RobotConfig) -> FoxgloveOutput:
    """The output."""
    require(("starlette", "uvicorn", "websockets"), "serve", "the Foxglove output")
    section = config.outputs.foxglove
    return FoxgloveOutput(section, access(config.security, section.address), config.security)


class FoxgloveOutput:
    """The publisher on Foxglove's WebSocket."""

    wants = EVERYTHING

    def __init__(
        self, section: FoxgloveConfig, rules: Access | None = None, security: SecurityConfig | None = None
    ) -> None:
        """Args: section, where to listen, and for whom. rules, security: for who connects."""
        self.preview_hz, self._origins = section.picture_hz, section.origins.split()
        self._web = WebServer(
            "Foxglove", section.address, section.port, rules or Access(), security or SecurityConfig()
        )
        self._clients: FoxgloveClients | None = None
        self._channels = {channel.topic: channel for channel in _channels()}
        self._rig: Rig | None = None
        self._stamp_ns = 0  # of the newest pose: for messages without a stamp of the sensor

    @property
    def port(self) -> int:
        """The port that it listens on."""
        return self._web.port

    def open(self, service: ServiceClient) -> None:
        """Listen.

        Raises:
            StereoSfmError: the port is taken, or the address is not of this computer.
        """
        from stereo_sfm.service.outputs.foxglove_clients import FoxgloveClients

        def make(guard: Guard) -> FoxgloveClients:
            self._clients = FoxgloveClients(list(self._channels.values()), service, guard)
            return self._clients

        self._web.open(make, self._origins)

    def close(self) -> None:
        """Stop listening."""
        self._web.close()

    def put(self, message: ServiceMessage) -> None:
        """Publish a message under its topics."""
        writers: dict[type, Callable[[Any], None]] = {
            Started: self._started,
            Status: self._status,
            PoseUpdate: self._pose,
            MapCloud: self._cloud,
            PreviewImage: self._image,
            HealthReport: self._health,
            Event: self._event,
            LiveDepth: self._depth,
        }
        writers[type(message)](message)

    # -- messages -----------------------------------------------------------------------------------------------------

    def _started(self, started: Started) -> None:
        self._rig = started.rig
        self._static()

    def _static(self) -> None:
        """Calibrations and fixed transforms; again with every status, for viewers that come later."""
        if self._rig is None:
            return
        rig, stamp = self._rig, self._stamp_ns
        rows = [("body", "cam0", foxglove.pose(rig.body_T_left))]
        up = RobotAxes(rig).base_T_left[2, :3]
        rows += [("level", "map", foxglove.pose(level_T_map(-up)))] if rig.imu is None else []
        self._log(topics.LEFT_CALIBRATION, foxglove.calibration(rig.left, "cam0", stamp))
        if rig.second_camera is not None:
            rows.append(("cam0", "cam1", foxglove.pose(rig.left_T_right)))
            self._log(topics.RIGHT_CALIBRATION, foxglove.calibration(rig.second_camera, "cam1", stamp))
        self._log(topics.TF_STATIC, foxglove.transforms(stamp, rows))

    def _status(self, status: Status) -> None:
        self._static()
        self._json(STATUS, asdict(status))

    def _pose(self, update: PoseUpdate) -> None:
        self._stamp_ns = stamp = update.stamp_ns
        in_map, correction, in_odom = foxglove.poses(
            np.stack([update.map_T_body, update.map_T_odom, update.odom_T_body])
        )
        self._log(topics.ODOMETRY, foxglove.odometry(stamp, in_odom, update.covariance))
        self._log(topics.ODOM_POSE, foxglove.pose_in_frame("odom", stamp, in_odom))
        self._log(topics.MAP_POSE, foxglove.pose_in_frame("map", stamp, in_map))
        rows = [("map", "odom", correction), ("odom", "body", in_odom)]
        if self._rig is not None and self._rig.imu is not None:  # the map's level may change: it comes with every pose
            rows.append(("level", "map", foxglove.pose(level_T_map(update.down))))
        self._log(topics.TF, foxglove.transforms(stamp, rows))

    def _cloud(self, cloud: MapCloud) -> None:
        stamp, positions = cloud.stamp_ns, cloud.map_T_kf[:, :3, 3]
        self._log(topics.POINTS, foxglove.point_cloud("map", stamp, cloud.points.astype(float), cloud.point_ids))
        self._log(topics.TRAJECTORY, foxglove.poses_in_frame("map", stamp, cloud.map_T_kf))
        self._log(topics.PATH, foxglove.point_cloud("map", stamp, positions, cloud.kf_ids, PATH_COLOR))

    def _image(self, preview: PreviewImage) -> None:
        if self._wanted(topics.LEFT_IMAGE):
            data = cv2.imencode(".jpg", preview.left, (cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY))[1].tobytes()
            image = foxglove.stamp(CompressedImage(frame_id="cam0", format="jpeg", data=data), preview.stamp_ns)
            self._log(topics.LEFT_IMAGE, image)
        colors = age_colors(preview.age, preview.inlier)
        self._log(topics.FEATURES, foxglove.point_annotations(preview.stamp_ns, preview.uv, colors))

    def _depth(self, live: LiveDepth) -> None:
        for topic, message in zip(DEPTH_TOPICS, foxglove.live_depth(live), strict=True):
            self._log(topic, message)

    def _health(self, report: HealthReport) -> None:
        for health in report.stages.values():
            self._publish(topics.HEALTH, schema.encode(health))
        self._json(REPORT, {name: value for name, value in asdict(report).items() if name != "stages"})

    def _event(self, event: Event) -> None:
        self._log(topics.LOG, foxglove.text(self._stamp_ns, event.level.upper(), event.text, event.stage))

    # -- channels -----------------------------------------------------------------------------------------------------

    def _log(self, topic: str, message: Any) -> None:
        """A message of Foxglove's schemas."""
        self._publish(topic, message.SerializeToString())

    def _json(self, topic: str, values: dict[str, Any]) -> None:
        plain = json.loads(json.dumps(values), parse_constant=lambda _: None)
        self._publish(topic, json.dumps(plain).encode())

    def _publish(self, topic: str, data: bytes) -> None:
        if self._clients is not None:
            self._clients.publish(self._channels[topic].id, self._stamp_ns, data)

    def _wanted(self, topic: str) -> bool:
        return self._clients is not None and self._clients.wanted(self._channels[topic].id)


def _channels() -> Iterator[Channel]:
    """Every topic, in the order of its number."""
    from mcap_protobuf.schema import build_file_descriptor_set

    for id, (topic, kind) in enumerate(KINDS.items(), 1):
        descriptors = build_file_descriptor_set(kind).SerializeToString()
        yield Channel.protobuf(id, topic, kind.DESCRIPTOR.full_name, descriptors)
    id = len(KINDS) + 1
    yield Channel.protobuf(id, topics.HEALTH, schema.full_name(Health), schema.schema_data(Health))
    for topic in (STATUS, REPORT):
        yield Channel.json(id := id + 1, topic)
