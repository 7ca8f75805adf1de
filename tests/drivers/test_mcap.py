"""MCAP files that others wrote: topics, calibrations and extrinsics are found, and bad files are one line."""

from __future__ import annotations

import itertools
import logging
import os
import struct
from collections.abc import Callable, Sequence
from contextlib import suppress
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.CompressedVideo_pb2 import CompressedVideo
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from mcap.writer import Writer
from mcap_protobuf.writer import Writer as ProtobufWriter

from stereo_sfm.calib.rig import Rig
from stereo_sfm.cli import main
from stereo_sfm.drivers import open_source
from stereo_sfm.drivers.choice import SourceChoice
from stereo_sfm.drivers.mcap.foreign import ForeignSource
from stereo_sfm.drivers.mcap.messages import IMAGES, ImageMessage
from stereo_sfm.drivers.mcap.topics import choose_topics
from stereo_sfm.drivers.memory import MemorySource
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Camera, KannalaBrandt, Pinhole, RadTan
from stereo_sfm.log import foxglove, topics
from stereo_sfm.log.images import UnknownEncoding
from stereo_sfm.log.reader import LogReader, TopicInfo
from stereo_sfm.types import U8
from tests.log.recordings import fisheye_rig, stereo_images, write_recording

PERIOD_NS = 50_000_000
W, H = 64, 48
RADTAN = RadTan(W, H, 50.0, 51.0, 31.0, 23.0, (-0.2, 0.05, 0.001, -0.002))
LEFT_T_RIGHT = se3.exp(np.array([0.12, 0.001, -0.002, 0.01, 0.02, -0.015]))


def _pixels(i: int, side: int) -> U8:
    return np.random.default_rng(2 * i + side).integers(0, 256, (H, W), np.uint8)


def _raw(i: int, side: int, frame: str) -> RawImage:
    return RawImage(frame_id=frame, width=W, height=H, encoding="mono8", step=W, data=_pixels(i, side).tobytes())


def _write(
    path: Path,
    names: Sequence[str] = ("/stereo/left/image_raw", "/stereo/right/image_raw"),
    calibrations: Sequence[str] = ("/stereo/left/camera_info", "/stereo/right/camera_info"),
    frames: Sequence[str] = ("left_optical", "right_optical"),
    cameras: Sequence[Camera] = (RADTAN, RADTAN),
    image: Callable[[int, int, str], Any] = _raw,
    transforms: Sequence[tuple[str, str, Any]] = (("left_optical", "right_optical", LEFT_T_RIGHT),),
    edit: Callable[[int, CameraCalibration], None] = lambda side, message: None,
    count: int = 6,
    skew_ns: int = 0,
    skip: Sequence[tuple[int, int]] = (),
    extra: Callable[[ProtobufWriter], None] = lambda writer: None,
    clocks: Callable[[int, int], tuple[int, int]] | None = None,
) -> Path:
    """A stereo recording as by another program.

    `clocks`: header stamp and log time of an image and side.
    """
    with path.open("wb") as stream, ProtobufWriter(stream) as writer:
        for side, topic in enumerate(calibrations):
            message = foxglove.calibration(cameras[side], frames[side], 10**9)
            edit(side, message)
            writer.write_message(topic, message, 10**9, 10**9)
        if transforms:
            rows = [(parent, child, foxglove.pose(matrix)) for parent, child, matrix in transforms]
            writer.write_message("/tf", foxglove.transforms(10**9, rows), 10**9, 10**9)
        for i in range(count):
            for side, topic in enumerate(names):
                if (i, side) in skip:
                    continue
                stamp = 10**9 + i * PERIOD_NS + side * skew_ns
                stamp, logged = (stamp, stamp + 7_000_000) if clocks is None else clocks(i, side)  # logged later
                writer.write_message(topic, foxglove.stamp(image(i, side, frames[side]), stamp), logged, stamp)
        extra(writer)
    return path


def test_foxglove_file_with_transforms(tmp_path: Path) -> None:
    path = _write(tmp_path / "a.mcap", skew_ns=300_000)
    with open_source(path) as source:
        assert isinstance(source.rig.left, RadTan)
        assert source.rig.left.distortion == RADTAN.distortion  # the zero that pads it is gone
        np.testing.assert_allclose(source.rig.left_T_right, LEFT_T_RIGHT, atol=1e-12)
        images = list(source)
    assert [image.frame_id for image in images] == list(range(6)) and source.frame_count == 6
    for i, image in enumerate(images):
        assert image.stamp_ns == 10**9 + i * PERIOD_NS
        assert image.right_stamp_ns == image.stamp_ns + 300_000
        assert image.right is not None
        np.testing.assert_array_equal(image.left, _pixels(i, 0))
        np.testing.assert_array_equal(image.right, _pixels(i, 1))


def test_a_chain_of_transforms_through_the_body(tmp_path: Path) -> None:
    body_T_left = se3.exp(np.array([0.5, 0.1, 0.2, 1.0, -1.2, 0.7]))
    rows = (
        ("map", "body", se3.exp(np.ones(6))),
        ("body", "left_optical", body_T_left),
        ("body", "right_mount", body_T_left @ LEFT_T_RIGHT @ se3.exp(-np.ones(6))),
        ("right_mount", "right_optical", se3.exp(np.ones(6))),
    )
    with open_source(_write(tmp_path / "a.mcap", transforms=rows)) as source:
        np.testing.assert_allclose(source.rig.left_T_right, LEFT_T_RIGHT, atol=1e-12)


def test_baseline_from_the_projection_matrices(tmp_path: Path) -> None:
    """Against OpenCV: a pair that stereoRectify rectified, described as ROS and Foxglove do, gives the pair back."""
    right_T_left = se3.inverse(LEFT_T_RIGHT)
    k, d = RADTAN.matrix, np.array(RADTAN.distortion)
    out = cv2.stereoRectify(
        k, d, k, d, (W, H), right_T_left[:3, :3], right_T_left[:3, 3], flags=cv2.CALIB_ZERO_DISPARITY
    )

    def edit(side: int, message: CameraCalibration) -> None:
        message.R[:] = out[side].ravel()
        message.P[:] = out[2 + side].ravel()

    with open_source(_write(tmp_path / "a.mcap", transforms=(), edit=edit)) as source:
        np.testing.assert_allclose(source.rig.left_T_right, LEFT_T_RIGHT, atol=1e-9)
    names = ("/left/image_rect", "/right/image_rect")
    infos = ("/left/camera_info", "/right/camera_info")
    with open_source(_write(tmp_path / "b.mcap", names, infos, transforms=(), edit=edit)) as source:
        rig = source.rig
        assert type(rig.left) is Pinhole and rig.left.fx == out[2][0, 0] and rig.left.cx == out[2][0, 2]
        np.testing.assert_allclose(rig.left_T_right[:3, :3], np.eye(3), atol=1e-12)
        np.testing.assert_allclose(rig.baseline, np.linalg.norm(LEFT_T_RIGHT[:3, 3]), rtol=1e-9)
        assert rig.left_T_right[0, 3] > 0


@pytest.mark.parametrize(
    ("names", "left", "right"),
    [
        (["/cam0/image", "/cam1/image"], "/cam0/image", "/cam1/image"),
        (["/b/right/x", "/b/left/x", "/rgb/image"], "/b/left/x", "/b/right/x"),
        (["/camera/infra1/image_rect_raw", "/camera/infra2/image_rect_raw"], *["/camera/infra%d/image_rect_raw"] * 2),
        (["/camera/fisheye1/image_raw", "/camera/fisheye2/image_raw"], *["/camera/fisheye%d/image_raw"] * 2),
        (["/left/rect", "/left/raw", "/right/raw", "/right/rect"], "/left/raw", "/right/raw"),
        (["/image"], "/image", ""),
        (["/a", "/b"], "/a", "/b"),
    ],
)  # fmt: skip
def test_the_cameras_are_found_by_name(tmp_path: Path, names: list[str], left: str, right: str) -> None:
    path = _write(
        tmp_path / "a.mcap", names, [], ["f"] * len(names), transforms=(), image=lambda i, e, f: _raw(i, e, f), count=1
    )
    with LogReader(path) as reader:
        chosen = choose_topics(reader)
    assert (chosen.left, chosen.right) == (left % 1 if "%d" in left else left, right % 2 if "%d" in right else right)


def test_three_ambiguous_images_are_an_error(tmp_path: Path) -> None:
    path = _write(
        tmp_path / "a.mcap", ["/x", "/y", "/z"], ["/y/info", "/z/info"], ["f", "left_optical", "right_optical"]
    )
    with pytest.raises(StereoSfmError, match="left=TOPIC&right=TOPIC"):
        open_source(path)
    rig = Rig(RADTAN, RADTAN, LEFT_T_RIGHT.copy())
    with open_source(f"mcap:{path}?left=/y&right=/z", rig=rig) as source:
        image = next(iter(source))
        np.testing.assert_array_equal(image.left, _pixels(0, 1))
    with pytest.raises(StereoSfmError, match="no image topic /w"):
        open_source(f"mcap:{path}?left=/w&right=/z")
    with pytest.raises(StereoSfmError, match="bogus"):
        open_source(f"mcap:{path}?bogus=1")


def test_missing_partners_count_as_dropped(tmp_path: Path) -> None:
    path = _write(tmp_path / "a.mcap", count=8, skip=[(2, 1), (3, 1), (6, 0)])
    with open_source(path) as source:
        images = list(source)
    assert [image.frame_id for image in images] == [0, 1, 4, 5, 6]
    assert [image.dropped_before for image in images] == [0, 0, 2, 0, 0]
    assert all(image.right is not None for image in images)


def test_compressed_images_and_fisheye_lenses(tmp_path: Path) -> None:
    lens = KannalaBrandt(W, H, 20.0, 20.5, 31.0, 23.0, (0.01, -0.02, 0.003, -0.0004))

    def image(i: int, side: int, frame: str) -> CompressedImage:
        data = cv2.imencode(".png", _pixels(i, side))[1].tobytes()
        return CompressedImage(frame_id=frame, format="png", data=b"broken" if (i, side) == (3, 0) else data)

    path = _write(tmp_path / "a.mcap", cameras=(lens, lens), image=image)
    with open_source(path) as source:
        assert isinstance(source.rig.left, KannalaBrandt) and source.rig.left.distortion == lens.distortion
        images = list(source)
    assert [image.frame_id for image in images] == [0, 1, 2, 4, 5] and images[3].dropped_before == 1
    np.testing.assert_array_equal(images[4].left, _pixels(5, 0))


@pytest.mark.parametrize("compressed", [False, True])
def test_twelve_of_sixteen_bits_become_eight(
    compressed: bool, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    def deep(i: int, side: int, frame: str) -> Any:
        pixels = _pixels(i, side).astype(np.uint16) * 16 + 5
        if compressed:
            return CompressedImage(frame_id=frame, format="png", data=cv2.imencode(".png", pixels)[1].tobytes())
        return RawImage(frame_id=frame, width=W, height=H, encoding="mono16", step=2 * W, data=pixels.tobytes())

    with open_source(_write(tmp_path / "a.mcap", image=deep)) as source:
        images = list(source)
    for i, image in enumerate(images):
        np.testing.assert_array_equal(image.left, _pixels(i, 0))
        assert image.right is not None
        np.testing.assert_array_equal(image.right, _pixels(i, 1))
    assert "its sixteen-bit images use 12 bits" in caplog.text


def test_depth_beside_an_image_makes_an_rgbd_source(tmp_path: Path) -> None:
    def image(i: int, side: int, frame: str) -> RawImage:
        if not side:
            return _raw(i, 0, frame)
        depth = np.full((H, W), 2000 + i, np.uint16)
        depth[0] = 0
        return RawImage(frame_id=frame, width=W, height=H, encoding="16UC1", step=2 * W, data=depth.tobytes())

    path = _write(tmp_path / "a.mcap", ["/rgb/image", "/depth/image"], ["/rgb/info"], image=image, transforms=())
    with open_source(path) as source:
        assert source.rig.depth and source.rig.stereo
        images = list(source)
    assert images[3].depth is not None and images[3].right is None
    assert np.isnan(images[3].depth[0]).all() and (images[3].depth[1:] == np.float32(2.003)).all()


def test_depth_of_the_same_camera_goes_first(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    def image(i: int, side: int, frame: str) -> RawImage:
        depth = np.full((H, W), 1000 * (side + 1), np.uint16)
        raw = RawImage(frame_id=frame, width=W, height=H, encoding="16UC1", step=2 * W, data=depth.tobytes())
        return raw if side else _raw(i, 0, frame)

    topics = ["/camera/rgb/image", "/camera/depth/image", "/camera/depth_registered/image"]
    frames = ["rgb", "infrared", "rgb"]
    path = _write(tmp_path / "a.mcap", topics, ["/camera/rgb/info"], frames, image=image, transforms=())
    with open_source(path) as source:
        depth = next(iter(source)).depth
    assert depth is not None and (depth == 3).all() and not caplog.text
    with open_source(f"mcap:{path}?depth=/camera/depth/image") as source:
        depth = next(iter(source)).depth
    assert depth is not None and (depth == 2).all()
    assert "/camera/depth/image is the depth of infrared, not of rgb" in caplog.text


def _compressed(encoding: str, data: bytes) -> ImageMessage:
    """Of ROS, by its parser."""
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    t, kind = store.types, "sensor_msgs/msg/CompressedImage"
    header = t["std_msgs/msg/Header"](t["builtin_interfaces/msg/Time"](0, 0), "left")
    message = t[kind](header, encoding, np.frombuffer(data, np.uint8))
    return IMAGES[kind](bytes(store.serialize_cdr(message, kind)))


def test_compressed_depth_in_floats_is_inverse(tmp_path: Path) -> None:
    """As ROS's compressed_depth_image_transport writes it: a / metres + b behind a header with a and b."""
    metres, a, b = np.array([[0.0, 0.5, 1.0, 4.0, 8.0]]), 1e4, -50.0
    pixels = np.where(metres > 0, a / np.maximum(metres, 0.1) + b, 0).astype(np.uint16)
    png = cv2.imencode(".png", pixels)[1].tobytes()
    depth = _compressed("32FC1; compressedDepth png", struct.pack("<iff", 0, a, b) + png).depth()
    assert np.isnan(depth[0, 0])
    np.testing.assert_allclose(depth[0, 1:], metres[0, 1:], rtol=1e-3)
    whole = _compressed("16UC1; compressedDepth", struct.pack("<iff", 0, a, b) + png).depth()
    np.testing.assert_allclose(whole[0, 1:], pixels[0, 1:] / 1000, rtol=1e-6)


def test_what_a_colour_filter_let_through_is_no_image() -> None:
    """The camera's mosaic compressed as it is; where the format says that colours were made first, it is an image."""
    mosaic = np.tile(np.array([[200, 100], [100, 40]], np.uint8), (8, 8))
    png = cv2.imencode(".png", mosaic)[1].tobytes()
    assert np.ptp(_compressed("bayer_rggb8; png compressed ", png).gray()[2:-2, 2:-2]) == 0
    assert np.ptp(_compressed("bayer_rggb8; png compressed bayer_rggb8", png).gray()[2:-2, 2:-2]) == 0
    for encoding in ("bayer_rggb8; png compressed mono8", "mono8; png compressed ", "png"):
        np.testing.assert_array_equal(_compressed(encoding, png).gray(), mosaic)


def test_the_truth_is_no_wheel_odometry() -> None:
    odometry = "nav_msgs/msg/Odometry"
    rows = [("/left", "sensor_msgs/msg/Image"), ("/right", "sensor_msgs/msg/Image"), ("/ground_truth/odom", odometry)]
    for more, wheel in (([], ""), ([("/base/odom", odometry)], "/base/odom")):
        topics = [TopicInfo(name, kind, "cdr", 1) for name, kind in [*rows, *more]]
        chosen = choose_topics(SimpleNamespace(topics=topics, path=Path("a.mcap")))  # type: ignore[arg-type]
        assert (chosen.truth, chosen.wheel) == ("/ground_truth/odom", wheel)


def test_ground_truth_by_its_name(tmp_path: Path) -> None:
    poses = se3.exp(np.random.default_rng(0).normal(size=(4, 6)))

    def extra(writer: ProtobufWriter) -> None:
        for i in (2, 0, 1, 3):  # not in order
            message: PoseInFrame = foxglove.pose_in_frame("world", 10**9 + i, foxglove.pose(poses[i]))
            writer.write_message("/vicon/ground_truth", message, 10**9 + i, 0)

    with open_source(_write(tmp_path / "a.mcap", extra=extra)) as source:
        assert source.ground_truth is not None
        assert source.ground_truth.stamp_ns.tolist() == [10**9 + i for i in range(4)]
        np.testing.assert_allclose(source.ground_truth.poses, poses, atol=1e-12)


def test_ros_2_file(tmp_path: Path) -> None:
    """Written with the rosbags library as the oracle of CDR."""
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    t = store.types
    path = tmp_path / "ros.mcap"

    def header(stamp: int, frame: str) -> Any:
        seconds, nanos = divmod(stamp, 10**9)
        return t["std_msgs/msg/Header"](t["builtin_interfaces/msg/Time"](seconds, nanos), frame)

    def quaternion(q: Sequence[float]) -> Any:
        return t["geometry_msgs/msg/Quaternion"](*map(float, q))

    def vector(v: Sequence[float]) -> Any:
        return t["geometry_msgs/msg/Vector3"](*map(float, v))

    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2")
        channels: dict[str, int] = {}

        def put(topic: str, kind: str, message: Any, stamp: int) -> None:
            if topic not in channels:
                schema_id = writer.register_schema(kind, "ros2msg", store.generate_msgdef(kind)[0].encode())
                channels[topic] = writer.register_channel(topic, "cdr", schema_id)
            writer.add_message(channels[topic], stamp, bytes(store.serialize_cdr(message, kind)), stamp)

        roi = t["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
        zeros, identity = np.zeros(9), np.eye(3).ravel()
        for side in ("left", "right"):
            info = t["sensor_msgs/msg/CameraInfo"](
                header(10**9, f"{side}_frame"), H, W, "plumb_bob", np.array([*RADTAN.distortion, 0.0]),
                RADTAN.matrix.ravel(), identity, np.zeros(12), 0, 0, roi,
            )  # fmt: skip
            put(f"/{side}/camera_info", "sensor_msgs/msg/CameraInfo", info, 10**9)
        q = se3.quaternion_from_rotation(LEFT_T_RIGHT[:3, :3])
        moved = t["geometry_msgs/msg/Transform"](vector(LEFT_T_RIGHT[:3, 3]), quaternion(q))
        row = t["geometry_msgs/msg/TransformStamped"](header(10**9, "left_frame"), "right_frame", moved)
        put("/tf_static", "tf2_msgs/msg/TFMessage", t["tf2_msgs/msg/TFMessage"]([row]), 10**9)
        for i in range(5):
            stamp = 10**9 + i * PERIOD_NS
            for j in range(3):
                at = stamp - (2 - j) * 10_000_000
                imu = t["sensor_msgs/msg/Imu"](
                    header(at, "imu"),
                    quaternion((0, 0, 0, 1)),
                    zeros,
                    vector((i, j, 1)),
                    zeros,
                    vector((0, 9.8, j)),
                    zeros,
                )
                put("/imu/data", "sensor_msgs/msg/Imu", imu, at)
            image = t["sensor_msgs/msg/Image"](header(stamp, "left_frame"), H, W, "mono8", 0, W, _pixels(i, 0).ravel())
            put("/left/image_raw", "sensor_msgs/msg/Image", image, stamp)
            data = cv2.imencode(".png", _pixels(i, 1))[1].ravel()
            packed = t["sensor_msgs/msg/CompressedImage"](header(stamp, "right_frame"), "png", data)
            put("/right/image_raw", "sensor_msgs/msg/CompressedImage", packed, stamp)
            point = t["geometry_msgs/msg/Point"](float(i), 2.0, 3.0)
            pose = t["geometry_msgs/msg/Pose"](point, quaternion((0, 0, 0, 1)))
            stamped = t["geometry_msgs/msg/PoseStamped"](header(stamp, "world"), pose)
            put("/ground_truth/pose", "geometry_msgs/msg/PoseStamped", stamped, stamp)
        writer.finish()

    with open_source(path) as source:
        np.testing.assert_allclose(source.rig.left.params[:8], RADTAN.params[:8])
        np.testing.assert_allclose(source.rig.left_T_right, LEFT_T_RIGHT, atol=1e-12)
        assert source.ground_truth is not None
        np.testing.assert_array_equal(source.ground_truth.positions[:, 0], np.arange(5.0))
        for i, image in enumerate(source):
            assert image.right is not None and image.imu is not None
            np.testing.assert_array_equal(image.left, _pixels(i, 0))
            np.testing.assert_array_equal(image.right, _pixels(i, 1))
            np.testing.assert_array_equal(image.imu.gyro, [[i, j, 1] for j in range(3)])
            np.testing.assert_array_equal(image.imu.accel, [[0, 9.8, j] for j in range(3)])
            assert image.imu.stamp_ns[-1] == image.stamp_ns


def _error(path: Path | str, capsys: pytest.CaptureFixture[str]) -> str:
    """The error of `info` or `record`: one line, exit code 2."""
    out = Path(str(path)).with_name("never.mcap")
    assert main(["record", str(path), "-o", str(out)]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert not out.exists()
    return lines[-1]


def test_bad_files_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "no such file" in _error(tmp_path / "missing.mcap", capsys)
    (tmp_path / "empty.mcap").write_bytes(b"")
    assert "is empty" in _error(tmp_path / "empty.mcap", capsys)
    (tmp_path / "text.mcap").write_text("hello")
    assert "not an MCAP file" in _error(tmp_path / "text.mcap", capsys)
    no_images = _write(tmp_path / "none.mcap", [])
    assert "contains no images (its topics: " in _error(no_images, capsys)
    nothing = _write(tmp_path / "nothing.mcap", [], [], transforms=())
    assert "no messages at all" in _error(nothing, capsys)


def test_bad_calibrations_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def uncalibrated(side: int, message: CameraCalibration) -> None:
        message.K[0] = 0.0

    def strange(side: int, message: CameraCalibration) -> None:
        message.distortion_model = "fisheye62"

    def small(side: int, message: CameraCalibration) -> None:
        message.width = 32

    missing = _write(tmp_path / "a.mcap", calibrations=())
    assert "has no calibration of its images: give one with --rig FILE" in _error(missing, capsys)
    assert "not calibrated" in _error(_write(tmp_path / "b.mcap", edit=uncalibrated), capsys)
    assert "distortion model 'fisheye62' is not supported" in _error(_write(tmp_path / "c.mcap", edit=strange), capsys)
    assert "no transform from 'left_optical' to 'right_optical'" in _error(
        _write(tmp_path / "d.mcap", transforms=()), capsys
    )
    assert "64x48 but the calibration is for 32x48" in _error(_write(tmp_path / "e.mcap", edit=small), capsys)


def test_a_given_rig_replaces_a_missing_calibration(tmp_path: Path) -> None:
    from stereo_sfm.calib import save_rig

    path = _write(tmp_path / "a.mcap", calibrations=(), transforms=())
    save_rig(Rig(RADTAN, RADTAN, LEFT_T_RIGHT.copy()), tmp_path / "rig.yaml")
    with open_source(path, rig=tmp_path / "rig.yaml") as source:
        assert len(list(source)) == 6
    assert main(["record", str(path), "--rig", str(tmp_path / "rig.yaml"), "-o", str(tmp_path / "b.mcap"), "-q"]) == 0
    with open_source(tmp_path / "b.mcap") as source:
        np.testing.assert_allclose(source.rig.left_T_right, LEFT_T_RIGHT, atol=1e-12)


def test_our_own_file_with_a_rig_of_another_size(tmp_path: Path) -> None:
    path = tmp_path / "own.mcap"
    write_recording(path, MemorySource(fisheye_rig(), stereo_images(2, np.random.default_rng(0))))
    with open_source(path, rig=fisheye_rig(32, 32)) as source, pytest.raises(StereoSfmError, match="96x80 but the cal"):
        list(source)


def test_a_truncated_file_of_others_is_read_up_to_its_end(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = _write(tmp_path / "a.mcap", count=400)
    path.write_bytes(path.read_bytes()[:-20_000])
    with caplog.at_level(logging.WARNING, "stereo_sfm"), open_source(path) as source:
        images = list(source)
    assert 100 < len(images) < 400 and "truncated" in caplog.text


def test_info_speaks_of_gaps_skew_and_topics(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = _write(tmp_path / "a.mcap", count=40, skew_ns=3_000_000, skip=[(i, e) for i in (9, 10) for e in (0, 1)])
    assert main(["info", str(path)]) == 0
    text = capsys.readouterr().out
    assert "images: 38 at 20.00 Hz, jitter 0.00 ms, 1 gaps up to 0.150 s" in text
    assert "problem: 1 gaps between images (longest 0.150 s, about 2 frames missing)" in text
    assert "problem: the cameras are up to 3.00 ms apart" in text
    assert "/stereo/left/image_raw" in text and "foxglove.RawImage" in text and "radtan 64x48" in text
    assert main(["info", str(path), "--json"]) == 0
    import json

    found = json.loads(capsys.readouterr().out)
    assert found["images"]["missing"] == 2 and found["skew_ms"] == 3.0


def test_info_of_our_own_file_and_of_a_cut_off_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "own.mcap"
    write_recording(path, MemorySource(fisheye_rig(), stereo_images(40, np.random.default_rng(0))))
    assert main(["info", str(path)]) == 0
    text = capsys.readouterr().out
    assert "40 at 30.00 Hz" in text and "1 dropped, left and right at most 0.040 ms apart" in text
    assert "closed properly" in text and "baseline 64.10 mm" in text
    path.write_bytes(path.read_bytes()[:-1500])
    assert main(["info", str(path)]) == 0
    assert "problem: truncated, " in capsys.readouterr().out
    assert main(["info", str(tmp_path / "x")]) == 2


def test_info_of_a_dataset_folder(data_root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", str(data_root / "euroc_mh01")]) == 0
    text = capsys.readouterr().out
    assert "images: 180 at 20.00 Hz" in text and "ground truth: 1830 poses" in text and "baseline 110.08 mm" in text


def test_our_own_file_without_right_images_is_an_error(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    images = stereo_images(40, np.random.default_rng(0))
    whole, without, some = (tmp_path / name for name in ("whole.mcap", "without.mcap", "some.mcap"))
    write_recording(whole, MemorySource(fisheye_rig(), images))
    for path, kept in ((without, -1), (some, 30)):
        _copy(whole, path, _without_right_images(kept))
    with pytest.raises(StereoSfmError, match="no right images, but its calibration"):
        open_source(without)
    with caplog.at_level(logging.WARNING, "stereo_sfm"), open_source(some) as source:
        assert len(list(source)) == 30
    assert caplog.text.count("is incomplete and skipped") == 5
    assert "10 frames were incomplete" in caplog.text


def test_info_counts_the_images_that_are_missing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    whole, some = tmp_path / "whole.mcap", tmp_path / "some.mcap"
    write_recording(whole, MemorySource(fisheye_rig(), stereo_images(40, np.random.default_rng(0))))
    _copy(whole, some, _without_right_images(30))
    assert main(["info", str(some)]) == 0
    assert "problem: 10 of 40 images of /cam1/image are missing" in capsys.readouterr().out


def _copy(source: Path, path: Path, changed: Callable[[str, int, bytes], bytes | None]) -> None:
    """The same file with other messages: `changed` takes topic, sequence number and data; None leaves one out."""
    from mcap.reader import make_reader
    from mcap.writer import Writer

    with source.open("rb") as stream, path.open("wb") as out:
        reader, writer = make_reader(stream), Writer(out)
        writer.start()
        schemas: dict[int, int] = {}
        channels: dict[int, int] = {}
        for schema, channel, message in reader.iter_messages():
            data = changed(channel.topic, message.sequence, message.data)
            if data is None:
                continue
            if schema is not None and schema.id not in schemas:
                schemas[schema.id] = writer.register_schema(schema.name, schema.encoding, schema.data)
            if channel.id not in channels:
                kind = schemas[schema.id] if schema is not None else 0
                channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, kind)
            writer.add_message(channels[channel.id], message.log_time, data, message.publish_time, message.sequence)
        for attachment in reader.iter_attachments():
            writer.add_attachment(
                attachment.create_time, attachment.log_time, attachment.name, attachment.media_type, attachment.data
            )
        for entry in reader.iter_metadata():
            writer.add_metadata(entry.name, entry.metadata)
        writer.finish()


def _without_right_images(kept: int) -> Callable[[str, int, bytes], bytes | None]:
    """As if the right camera had failed after some images."""
    return lambda topic, sequence, data: None if topic == topics.RIGHT_IMAGE and sequence >= kept + 1 else data


def test_many_damaged_messages_do_not_flood_the_terminal(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    damaged = itertools.count()

    def cut(topic: str, sequence: int, data: bytes) -> bytes:
        return data if topic != "/stereo/right/image_raw" or next(damaged) < 2 else b"\xff"

    path = tmp_path / "a.mcap"
    _copy(_write(tmp_path / "whole.mcap", count=60), path, cut)
    with caplog.at_level(logging.WARNING, "stereo_sfm"), open_source(path) as source:
        assert len(list(source)) == 2
    assert caplog.text.count("a message of /stereo/right/image_raw cannot be read") <= 10
    assert "58 images could not be read" in caplog.text


def test_many_damaged_transforms_do_not_flood_the_terminal(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    def transforms(writer: ProtobufWriter) -> None:
        rows = [("left_optical", "right_optical", foxglove.pose(LEFT_T_RIGHT))]
        for k in range(60):
            writer.write_message("/tf", foxglove.transforms(10**9 + k, rows), 10**9 + k, 10**9 + k)

    path, whole = tmp_path / "a.mcap", _write(tmp_path / "whole.mcap", extra=transforms)
    _copy(whole, path, lambda topic, sequence, data: b"\xff" if topic == "/tf" else data)
    with caplog.at_level(logging.WARNING, "stereo_sfm"), suppress(StereoSfmError), open_source(path):
        pass
    readings = caplog.text.count("61 transforms could not be read")
    assert readings and caplog.text.count("a transform on /tf cannot be read") == 5 * readings


def test_a_clock_that_runs_backwards_is_reported(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    def again(writer: ProtobufWriter) -> None:
        for i in range(3):
            for side, topic in enumerate(("/stereo/left/image_raw", "/stereo/right/image_raw")):
                stamp = 10**9 + i * PERIOD_NS + PERIOD_NS // 2
                writer.write_message(topic, foxglove.stamp(_raw(i, side, "x"), stamp), stamp, stamp)

    path = _write(tmp_path / "a.mcap", count=10, extra=again)
    with caplog.at_level(logging.WARNING, "stereo_sfm"), open_source(path):
        pass
    assert "the clock goes back by 0.4 s" in caplog.text
    caplog.clear()
    with caplog.at_level(logging.WARNING, "stereo_sfm"), open_source(_write(tmp_path / "b.mcap", count=10)):
        pass
    assert "clock" not in caplog.text


def _taken(i: int) -> int:
    return 10**9 + i * PERIOD_NS


@pytest.mark.parametrize(
    "logged",
    [
        lambda i, side: 10**9,
        lambda i, side: 0,
        lambda i, side: 10**9 + 12_000 * (2 * i + side),  # bursts
        lambda i, side: 10**9 + 12_000 * i + side * 10**8,  # all of one camera, then all of the other
    ],
)
def test_log_times_say_nothing_where_headers_do(logged: Callable[[int, int], int], tmp_path: Path) -> None:
    path = _write(tmp_path / "a.mcap", count=40, clocks=lambda i, side: (_taken(i) + 300_000 * side, logged(i, side)))
    with open_source(path) as source:
        images = list(source)
    assert [image.stamp_ns for image in images] == [_taken(i) for i in range(40)]


def test_one_clock_where_a_camera_has_no_header_stamps(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """The other camera's stamps are of another clock than the times of logging, two frames away."""
    late = 2 * PERIOD_NS

    def clocks(i: int, side: int) -> tuple[int, int]:
        return (0 if side else _taken(i)), _taken(i) + late + 1_000_000 * side

    with (
        caplog.at_level(logging.WARNING, "stereo_sfm"),
        open_source(_write(tmp_path / "a.mcap", clocks=clocks)) as source,
    ):
        images = list(source)
    assert "/stereo/right/image_raw are all the same" in caplog.text
    for i, image in enumerate(images):
        assert image.right is not None and image.stamp_ns == _taken(i) + late
        np.testing.assert_array_equal(image.right, _pixels(i, 1))  # of the same moment


@pytest.mark.parametrize("apart_ns", [1000 * 10**9, -(10**9) + 20_000_000])
def test_two_header_clocks_are_not_mixed(apart_ns: int, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = _write(tmp_path / "a.mcap", clocks=lambda i, side: (_taken(i) + side * apart_ns, _taken(i) + 1_000 * side))
    with caplog.at_level(logging.WARNING, "stereo_sfm"), open_source(path) as source:
        images = list(source)
    assert "are of two clocks" in caplog.text and "Trigger" not in caplog.text
    assert [image.stamp_ns for image in images] == [_taken(i) for i in range(6)]


def test_a_camera_that_begins_later_has_the_same_clock(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = _write(tmp_path / "a.mcap", count=100, skip=[(i, 1) for i in range(90)])
    with caplog.at_level(logging.WARNING, "stereo_sfm"), open_source(path) as source:
        assert [image.stamp_ns for image in source] == [_taken(i) for i in range(90, 100)]
    assert not caplog.text


def test_cameras_that_were_recorded_one_after_the_other(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = _write(tmp_path / "a.mcap", count=20, skip=[(i, i >= 10) for i in range(20)])
    assert "no image of /stereo/left/image_raw has a partner on /stereo/right/image_raw" in _error(path, capsys)


def test_no_clock_at_all(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "nothing tells when" in _error(_write(tmp_path / "a.mcap", clocks=lambda i, side: (0, 10**9)), capsys)


def test_cameras_that_are_not_triggered_together_are_named(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING, "stereo_sfm"), open_source(_write(tmp_path / "a.mcap", skew_ns=18_000_000)):
        pass
    assert "stamps of left and right images differ by 18.0 ms" in caplog.text


def test_headers_that_are_set_back_keep_their_pairs(tmp_path: Path) -> None:
    def clocks(i: int, side: int) -> tuple[int, int]:
        return _taken(i) - (i >= 5) * 2 * 10**9 + 10**10, _taken(i) + 1_000 * side

    with SourceChoice(str(_write(tmp_path / "a.mcap", count=12, clocks=clocks)))() as source:
        images = list(source)
    assert [image.stamp_ns for image in images] == [_taken(i) + 10**10 for i in range(12)]


def test_an_encoding_that_cannot_be_read_is_refused_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def image(i: int, side: int, frame: str) -> RawImage:
        message = _raw(i, side, frame)
        message.encoding = "yuv_of_the_future"
        return message

    assert "'yuv_of_the_future' is not supported" in _error(_write(tmp_path / "a.mcap", image=image), capsys)


def test_images_that_are_too_short_are_refused_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def image(i: int, side: int, frame: str) -> RawImage:
        message = _raw(i, side, frame)
        message.encoding, message.step = "bayer_rggb16", 2 * W
        return message

    path = _write(tmp_path / "a.mcap", image=image)
    assert f"its images cannot be read: an image of {W}x{H} bayer_rggb16 has only" in _error(path, capsys)
    assert main(["info", str(path)]) == 0
    assert capsys.readouterr().out.count("bayer_rggb16") == 1


def _video(codec: str, side: int, count: int = 10) -> list[bytes]:
    """A message of each image of a film, every fourth a keyframe."""
    av: Any = pytest.importorskip("av")
    encoder = av.CodecContext.create(codec, "w")
    encoder.width, encoder.height, encoder.pix_fmt, encoder.time_base = W, H, "yuv420p", Fraction(1, 20)
    encoder.options = {"tune": "zerolatency", "g": "4", "crf": "1", "x265-params": "keyint=4:log-level=none"}
    frames = [av.VideoFrame.from_ndarray(np.pad(_scene(i, side), ((0, H // 2), (0, 0)), constant_values=128), "yuv420p")
              for i in range(count)]  # fmt: skip
    packets = [bytes(packet) for frame in [*frames, None] for packet in encoder.encode(frame)]
    assert len(packets) == count
    return packets


def _scene(i: int, side: int) -> U8:
    y, x = np.mgrid[:H, :W]
    return (120 + 60 * np.sin((x + 3 * i + 9 * side) / 6) * np.cos(y / 5)).astype(np.uint8)


@pytest.mark.parametrize(
    ("codec", "message", "name"),
    [
        ("libx264", CompressedVideo, "h264"),
        ("libx265", CompressedVideo, "h265"),
        ("libx264", CompressedImage, "h264"),
    ],
)
def test_topics_of_video_are_decoded(codec: str, message: type[Any], name: str, tmp_path: Path) -> None:
    """From any start on, also between two keyframes, the same pixels."""
    films = [_video(codec, side) for side in (0, 1)]

    def image(i: int, side: int, frame: str) -> Any:
        return message(frame_id=frame, format=name, data=films[side][i])

    with open_source(_write(tmp_path / "a.mcap", image=image, count=10)) as source:
        whole = list(source)
        assert isinstance(source, ForeignSource)
        part = list(source.frames(start_ns=10**9 + 6 * PERIOD_NS))
    assert [image.stamp_ns for image in whole] == [10**9 + i * PERIOD_NS for i in range(10)]
    for i, found in enumerate(whole):
        assert found.right is not None
        for side, pixels in enumerate((found.left, found.right)):
            assert np.abs(pixels.astype(int) - _scene(i, side)).mean() < 2
    assert [image.stamp_ns for image in part] == [image.stamp_ns for image in whole[6:]]
    for a, b in zip(part, whole[6:], strict=True):
        np.testing.assert_array_equal(a.left, b.left)


def test_a_video_that_begins_between_keyframes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Its images are those from the first keyframe on; without one it is refused."""
    films = [_video("libx264", side) for side in (0, 1)]

    def image(i: int, side: int, frame: str) -> CompressedVideo:
        return CompressedVideo(frame_id=frame, format="h264", data=films[side][i + 1])

    with open_source(_write(tmp_path / "a.mcap", image=image, count=9)) as source:
        assert [image.stamp_ns for image in source] == [10**9 + i * PERIOD_NS for i in range(3, 9)]
    path = _write(tmp_path / "b.mcap", image=image, count=3)
    assert "its images cannot be read: 'h264' video without a keyframe" in _error(path, capsys)
    assert main(["info", str(path)]) == 0
    assert capsys.readouterr().out.count("video without a keyframe") == 1


def test_video_needs_its_extra(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def image(i: int, side: int, frame: str) -> CompressedVideo:
        return CompressedVideo(frame_id=frame, format="h264", data=b"x")

    def without(name: str) -> None:
        """No library is found."""

    monkeypatch.setattr("importlib.util.find_spec", without)
    assert "needs av: pip install 'stereo-sfm[video]'" in _error(_write(tmp_path / "a.mcap", image=image), capsys)


def test_video_messages_of_ros() -> None:
    """Laid out as CDR by hand: header, then the fields of either definition."""
    header = b"\0\1\0\0" + struct.pack("<iII", 3, 7, 4) + b"cam\0"
    video = header + struct.pack("<I4sI5s", 4, b"data", 5, b"h265\0")
    packet = header + struct.pack("<iiI8sxxxxQBBxxI4s", 64, 48, 8, b"libx264\0", 9, 1, 0, 4, b"data")
    for kind, data, decoder in (
        ("foxglove_msgs/msg/CompressedVideo", video, "hevc"),
        ("ffmpeg_image_transport_msgs/msg/FFMPEGPacket", packet, "h264"),
    ):
        message = IMAGES[kind](data)
        assert (message.stamp_ns, message.frame, message.data) == (3 * 10**9 + 7, "cam", b"data")
        assert message.video == decoder
        with pytest.raises(UnknownEncoding, match="is video, which is read from recordings only"):
            message.gray()


@pytest.mark.parametrize(("encoding", "height", "depth"), [("nv12", 3 * H // 2, 1), ("bayer_rggb16", H, 2)])
def test_brightness_of_video_and_deep_bayer_images(encoding: str, height: int, depth: int, tmp_path: Path) -> None:
    """Of 16 bits these images use 14, which are scaled to eight."""

    def image(i: int, side: int, frame: str) -> RawImage:
        even = np.full((height, W), 60 * 256 ** (depth - 1) + i, np.uint8 if depth == 1 else "<u2")
        return RawImage(frame_id=frame, width=W, height=H, encoding=encoding, step=W * depth, data=even.tobytes())

    with open_source(_write(tmp_path / "a.mcap", image=image)) as source:
        first = next(iter(source)).left
    assert first.shape == (H, W) and np.abs(first.astype(int) - 60 * 4 ** (depth - 1)).max() <= 1


def test_a_pipe_is_not_a_recording(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "a.mcap")
    with pytest.raises(StereoSfmError, match="it is not a file"):
        LogReader(tmp_path / "a.mcap")
