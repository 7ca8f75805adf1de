"""A source as messages: calibration, images, inertial and wheel samples, ground truth, drops."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.Pose_pb2 import Pose

from stereo_sfm.calib.formats.native import rig_to_text
from stereo_sfm.calib.rig import Rig
from stereo_sfm.geometry import se3
from stereo_sfm.log import foxglove, topics
from stereo_sfm.log.images import LoggedImage, depth_message, encode_pair, image_message
from stereo_sfm.log.samples import ImageInfo, ImuSample, WheelSample
from stereo_sfm.log.writer import LogWriter
from stereo_sfm.types import F64, I64, StereoImage, Trajectory

RIG_FILE = "calibration.yaml"
TRUTH_FILE = "ground_truth.npz"
SECOND_NS = 1_000_000_000
LOOKS_LEVEL = 0.1  # sine of the smallest angle between a camera's axis and the vertical that gives a heading
# Viewers take z as up: a parent frame of the map, aligned with the first camera (x forward, y left, z up).
LEVEL_T_MAP = np.array([[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])


def level_T_map(down: F64) -> F64:
    """(4, 4) of a map in which gravity points along `down` (3,): z up, x where the first camera looks.

    A zero vector, of a map that knows no gravity, and one along the camera's axis give LEVEL_T_MAP.
    """
    ahead = np.array([0.0, 0.0, 1.0]) - down[2] * down
    if not down.any() or np.linalg.norm(ahead) < LOOKS_LEVEL:
        return LEVEL_T_MAP
    x = ahead / np.linalg.norm(ahead)
    turn: F64 = np.array([x, np.cross(-down, x), -down], np.float64)
    return se3.from_rotation_translation(turn, np.zeros(3))


def truth_to_bytes(trajectory: Trajectory) -> bytes:
    """Stamps and poses as npz, without loss: the quaternions of the topic are rounded."""
    buffer = io.BytesIO()
    arrays: dict[str, Any] = {"stamp_ns": trajectory.stamp_ns, "poses": trajectory.poses}
    if not trajectory.oriented:
        arrays["positions_only"] = np.ones(1, bool)
    np.savez_compressed(buffer, **arrays)
    return buffer.getvalue()


class ImageLog:
    """Writes one source's images and everything around them through a `LogWriter`."""

    def __init__(
        self,
        writer: LogWriter,
        rig: Rig,
        ground_truth: Trajectory | None = None,
        image_format: str = "png",
        *,
        mapped: bool = False,
    ) -> None:
        """Begin a log.

        Args:
            writer: the open file.
            rig: calibration of the images.
            ground_truth: truth_T_cam0 where the source has it.
            image_format: one of `images.FORMATS`, or "none" for no images.
            mapped: the file gets a map with its origin at the first image: log how both are oriented.
        """
        self._writer = writer
        self._rig = rig
        self._mapped = mapped
        self._truth_row: list[tuple[str, str, Pose]] | None = None
        self._truth = ground_truth
        self._format = image_format
        self._next_static_ns: int | None = None
        self._left_out = 0
        self._totals = {"images": 0, "dropped": 0, "max_skew_ns": 0}
        writer.attach(RIG_FILE, rig_to_text(rig), "application/yaml")
        if ground_truth is not None:
            writer.attach(TRUTH_FILE, truth_to_bytes(ground_truth), "application/zip")

    def image(self, image: StereoImage | LoggedImage) -> None:
        """Everything of one frame, pixels last.

        Args:
            image: a pair, or one that `encode_pair` has encoded already.

        Raises:
            ValueError: an unencoded pair for a JPEG log: the tracker must see the decoded pixels, so encode first.
        """
        pair = image.image if isinstance(image, LoggedImage) else image
        self._static(pair.stamp_ns)
        self._ground_truth(pair.stamp_ns)
        self._count(pair)
        if self._format == "none":
            return
        if isinstance(image, StereoImage):
            if self._format == "jpeg":
                raise ValueError("JPEG is lossy: log and track what encode_pair(image, 'jpeg') gives")
            image = encode_pair(image, self._format)
        self._samples(pair)
        self._info(pair)
        self._pixels(image)

    def without_pixels(self, image: StereoImage) -> None:
        """Log an image without pixels: its info and its inertial and wheel samples."""
        self._left_out += 1
        self._static(image.stamp_ns)
        self._ground_truth(image.stamp_ns)
        if self._format != "none":
            self._samples(image)

    @property
    def totals(self) -> dict[str, str]:
        """Counts for the metadata at the end of the file."""
        left_out = {"images left out": str(self._left_out)} if self._left_out else {}
        return {name: str(value) for name, value in self._totals.items()} | left_out

    def _count(self, pair: StereoImage) -> None:
        skew = abs(pair.right_stamp_ns - pair.stamp_ns) if pair.right is not None and pair.right_stamp_ns else 0
        self._totals["images"] += 1
        self._totals["dropped"] += pair.dropped_before
        self._totals["max_skew_ns"] = max(self._totals["max_skew_ns"], skew)

    def _info(self, pair: StereoImage) -> None:
        info = ImageInfo(
            pair.frame_id,
            pair.stamp_ns,
            pair.right_stamp_ns,
            pair.exposure_us,
            pair.gain,
            pair.dropped_before,
            pair.right is not None,
            pair.depth is not None,
            -1 if pair.imu is None else len(pair.imu.stamp_ns),
            -1 if pair.wheel is None else len(pair.wheel.stamp_ns),
        )
        self._writer.write(topics.IMAGE_INFO, info, pair.stamp_ns, pair.frame_id)

    def _pixels(self, logged: LoggedImage) -> None:
        pair = logged.image
        channels = (
            (topics.LEFT_IMAGE, "cam0", pair.left, logged.left),
            (topics.RIGHT_IMAGE, "cam1", pair.right, logged.right),
        )
        for topic, frame, pixels, data in channels:
            if pixels is None or data is None:
                continue
            message = image_message(data, (pixels.shape[1], pixels.shape[0]), logged.format, frame)
            self._writer.write(topic, foxglove.stamp(message, pair.stamp_ns), pair.stamp_ns, pair.frame_id)
        if pair.depth is not None:
            depth = foxglove.stamp(depth_message(pair.depth, "cam0"), pair.stamp_ns)
            self._writer.write(topics.DEPTH_IMAGE, depth, pair.stamp_ns, pair.frame_id)

    def _samples(self, pair: StereoImage) -> None:
        if pair.imu is not None:
            for stamp_ns, row in _rows(pair.imu.stamp_ns, pair.imu.gyro, pair.imu.accel):
                self._writer.write(topics.IMU, ImuSample(stamp_ns, *row), stamp_ns, pair.frame_id)
        if pair.wheel is not None:
            rows = _rows(pair.wheel.stamp_ns, pair.wheel.linear, pair.wheel.angular)
            speeds = pair.wheel.speeds if len(pair.wheel.speeds) else np.zeros((len(rows), 0))
            for (stamp_ns, row), speed in zip(rows, speeds, strict=True):
                self._writer.write(topics.WHEEL, WheelSample(stamp_ns, *row, speeds=speed), stamp_ns, pair.frame_id)

    def _static(self, stamp_ns: int) -> None:
        """Calibration and transforms of the rig, at the start and every second: players need them after seeking."""
        if self._next_static_ns is not None and stamp_ns < self._next_static_ns:
            return
        self._next_static_ns = stamp_ns + SECOND_NS
        rig = self._rig
        rows = [*self._above_body(stamp_ns), ("body", "cam0", foxglove.pose(rig.body_T_left))]
        left = foxglove.calibration(rig.left, "cam0", stamp_ns)
        self._writer.write(topics.LEFT_CALIBRATION, left, stamp_ns)
        if (second := rig.second_camera) is not None:
            tx = -second.fx * rig.baseline if np.allclose(rig.left_T_right[:3, :3], np.eye(3), atol=1e-9) else 0.0
            right = foxglove.calibration(second, "cam1", stamp_ns, tx)
            self._writer.write(topics.RIGHT_CALIBRATION, right, stamp_ns)
            rows.append(("cam0", "cam1", foxglove.pose(rig.left_T_right)))
        self._writer.write(topics.TF_STATIC, foxglove.transforms(stamp_ns, rows), stamp_ns)

    def _above_body(self, stamp_ns: int) -> list[tuple[str, str, Pose]]:
        """The orientation of the map, and the ground truth in the map: they share the first image's pose."""
        if not self._mapped:
            return []
        if self._truth_row is None:
            self._truth_row = []
            if self._truth is not None and len(self._truth):
                map_T_truth = se3.inverse(self._truth.poses[self._first_truth(self._truth, stamp_ns)])
                self._truth_row.append(("map", "truth", foxglove.pose(map_T_truth)))
        fixed = [("level", "map", foxglove.pose(LEVEL_T_MAP))] if self._rig.imu is None else []
        return fixed + self._truth_row

    @staticmethod
    def _first_truth(truth: Trajectory, stamp_ns: int) -> int:
        return max(int(np.searchsorted(truth.stamp_ns, stamp_ns, side="right")) - 1, 0)

    def _ground_truth(self, stamp_ns: int) -> None:
        """All poses from the first image on, in chunks of their own: a reader gets them without reading the images."""
        if self._truth is None:
            return
        first = self._first_truth(self._truth, stamp_ns)
        self._writer.flush()
        poses = foxglove.poses(self._truth.poses[first:])
        for pose_stamp, truth_T_cam in zip(self._truth.stamp_ns[first:].tolist(), poses, strict=True):
            message = foxglove.pose_in_frame("truth", pose_stamp, truth_T_cam)
            self._writer.write(topics.GROUND_TRUTH, message, pose_stamp)
        self._writer.flush()
        self._truth = None


def _rows(stamp_ns: I64, first: F64, second: F64) -> list[tuple[int, list[float]]]:
    """(stamp, six numbers) per sample of two vectors (N, 3)."""
    return list(zip(stamp_ns.tolist(), np.hstack([first, second]).tolist(), strict=True))
