"""The topics of the log, live, on Foxglove's WebSocket, with the commands of the service.

Topics, schemas and frames are those of the log (`stereo_sfm.log.topics`), so that one layout shows both; two are
added, `/service/status` and `/service/health`. The protocol has no client authentication: it is served to this computer
alone.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
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

from stereo_sfm.calib.rig import Rig
from stereo_sfm.errors import StereoSfmError, require
from stereo_sfm.log import foxglove, schema, topics
from stereo_sfm.log.image_log import LEVEL_T_MAP, level_T_map
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
from stereo_sfm.service.outputs.access import is_loopback
from stereo_sfm.service.publisher import COMMANDS, ServiceClient

if TYPE_CHECKING:
    from stereo_sfm.service.config import RobotConfig

log = logging.getLogger("stereo_sfm")

STATUS, REPORT = "/service/status", "/service/health"
SERVICES = ("status", "save_map", "load_map", "reset", "relocalize", "start_recording", "stop_recording", "mark")
JPEG_QUALITY = 80
REQUEST_BYTES = 1 << 14
REPLY_S = 30.0
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
}
BACKLOG = 256  # messages that wait for one client; the oldest is dropped


def make(config: RobotConfig) -> FoxgloveOutput:
    """The output."""
    require(("foxglove",), "serve", "the Foxglove output")
    section = config.outputs.foxglove
    return FoxgloveOutput(section.address, section.port, section.picture_hz)


class FoxgloveOutput:
    """The publisher on Foxglove's WebSocket."""

    wants = EVERYTHING

    def __init__(self, address: str, port: int, preview_hz: float) -> None:
        """Args: address and port, where to listen. preview_hz: images a second.

        Raises:
            StereoSfmError: the address is not of this computer alone.
        """
        if not is_loopback(address):
            raise StereoSfmError(
                f"Foxglove's protocol has no token: listen on 127.0.0.1, not {address}, and put a proxy in front"
            )
        self._address, self._port, self.preview_hz = address, port, preview_hz
        self._server: Any = None
        self._channels: dict[str, Any] = {}
        self._rig: Rig | None = None
        self._stamp_ns = 0  # of the newest pose: for messages without a stamp of the sensor

    @property
    def port(self) -> int:
        """The port that it listens on."""
        return 0 if self._server is None else self._server.port

    def open(self, service: ServiceClient) -> None:
        """Listen."""
        import foxglove as sdk
        from foxglove.websocket import Capability

        self._context = sdk.Context()
        self._advertise()
        try:
            self._server = sdk.start_server(
                name="stereo-sfm",
                host=self._address,
                port=self._port,
                capabilities=[Capability.Services, Capability.Parameters],
                supported_encodings=["json"],
                services=[_service(name, service) for name in SERVICES],
                server_listener=_settings(service),
                context=self._context,
                message_backlog_size=BACKLOG,
            )
        except Exception as error:  # the library has no exception of its own for a port that is taken
            raise StereoSfmError(f"Foxglove: cannot listen on {self._address}:{self._port}: {error}") from None

    def close(self) -> None:
        """Stop listening."""
        if self._server is not None:
            self._server.stop()

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
        rows += [("level", "map", foxglove.pose(LEVEL_T_MAP))] if rig.imu is None else []
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
        data = cv2.imencode(".jpg", preview.left, (cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY))[1].tobytes()
        image = foxglove.stamp(CompressedImage(frame_id="cam0", format="jpeg", data=data), preview.stamp_ns)
        self._log(topics.LEFT_IMAGE, image)
        colors = age_colors(preview.age, preview.inlier)
        self._log(topics.FEATURES, foxglove.point_annotations(preview.stamp_ns, preview.uv, colors))

    def _health(self, report: HealthReport) -> None:
        for health in report.stages.values():
            self._channels[topics.HEALTH].log(schema.encode(health), log_time=self._stamp_ns)
        self._json(REPORT, {name: value for name, value in asdict(report).items() if name != "stages"})

    def _event(self, event: Event) -> None:
        self._log(topics.LOG, foxglove.text(self._stamp_ns, event.level.upper(), event.text, event.stage))

    # -- channels -----------------------------------------------------------------------------------------------------

    def _advertise(self) -> None:
        """Every topic, before there is a client: one that subscribes at once is refused a topic that is just new."""
        from foxglove import Channel
        from mcap_protobuf.schema import build_file_descriptor_set

        for topic, kind in KINDS.items():
            data = build_file_descriptor_set(kind).SerializeToString()
            self._channels[topic] = self._channel(topic, kind.DESCRIPTOR.full_name, data)
        self._channels[topics.HEALTH] = self._channel(
            topics.HEALTH, schema.full_name(Health), schema.schema_data(Health)
        )
        for topic in (STATUS, REPORT):
            kind = {"type": "object", "title": topic}
            self._channels[topic] = Channel(topic, schema=kind, context=self._context)

    def _log(self, topic: str, message: Any) -> None:
        """A message of Foxglove's schemas."""
        self._channels[topic].log(message.SerializeToString(), log_time=self._stamp_ns)

    def _json(self, topic: str, values: dict[str, Any]) -> None:
        plain = json.loads(json.dumps(values), parse_constant=lambda _: None)
        self._channels[topic].log(plain, log_time=self._stamp_ns)

    def _channel(self, topic: str, name: str, data: bytes) -> Any:
        from foxglove import Channel, Schema

        kind = Schema(name=name, encoding="protobuf", data=data)
        return Channel(topic, schema=kind, message_encoding="protobuf", context=self._context)


def _service(name: str, service: ServiceClient) -> Any:
    """A command as a service whose request and response are JSON objects."""
    from foxglove import Schema
    from foxglove.websocket import MessageSchema, Service, ServiceSchema

    arguments = {
        key: {"type": "string" if isinstance(value, str) else "number", "default": value}
        for key, value in COMMANDS[name].arguments.items()
    }

    def described(what: str, properties: dict[str, Any]) -> MessageSchema:
        data = json.dumps({"type": "object", "title": f"{name} {what}", "properties": properties}).encode()
        return MessageSchema(encoding="json", schema=Schema(name=f"{name}_{what}", encoding="jsonschema", data=data))

    reply = {"ok": {"type": "boolean"}, "text": {"type": "string"}, "data": {"type": "object"}}
    kind = ServiceSchema(name=name, request=described("request", arguments), response=described("response", reply))
    return Service(name=f"/{name}", schema=kind, handler=lambda request: _reply(name, service, request.payload))


def _reply(name: str, service: ServiceClient, payload: bytes) -> bytes:
    """The reply to a request, which may be anything."""
    try:
        arguments = json.loads(payload) if payload.strip() and len(payload) <= REQUEST_BYTES else {}
    except ValueError:
        arguments = None
    if not isinstance(arguments, dict) or len(payload) > REQUEST_BYTES:
        return json.dumps({"ok": False, "text": f"{name} takes a small JSON object", "data": {}}).encode()
    try:
        reply = service.call(name, REPLY_S, **{str(key): value for key, value in arguments.items()})
    except StereoSfmError as error:
        return json.dumps({"ok": False, "text": str(error), "data": {}}).encode()
    return json.dumps({"ok": reply.ok, "text": reply.text, "data": reply.data}, default=str).encode()


def _settings(service: ServiceClient) -> Any:
    """The settings that may change while running, as parameters."""
    from foxglove.websocket import Parameter, ServerListener

    def known(names: list[str]) -> list[Parameter]:
        settings: dict[str, Any] = service.call("status").data.get("settings", {})
        return [Parameter(name, value=value) for name, value in settings.items() if not names or name in names]

    class Listener(ServerListener):
        def on_get_parameters(self, client: Any, param_names: list[str], request_id: str | None = None) -> list[Any]:
            return known(param_names)

        def on_set_parameters(self, client: Any, parameters: list[Any], request_id: str | None = None) -> list[Any]:
            for parameter in parameters:
                reply = service.call("set_setting", name=parameter.name, value=str(parameter.get_value()))
                if not reply.ok:
                    log.warning("%s is not set: %s", parameter.name, reply.text)
            return known([parameter.name for parameter in parameters])

    return Listener()
