"""Runs every compiled kernel once before a run begins: no live frame waits for code, and the first run of all compiles
the stages side by side."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np

from stereo_sfm.calib.imu import Imu
from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import Config
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Camera
from stereo_sfm.geometry.dominant_direction import MIN_POINTS, dominant_direction
from stereo_sfm.geometry.preintegration import GRAVITY
from stereo_sfm.mapping.mapper import Job, Mapper
from stereo_sfm.pipeline.stages import make_closer
from stereo_sfm.timing import NoSpans
from stereo_sfm.tracking.factory import make_tracker
from stereo_sfm.tracking.flow.coarse_rotation import CoarseRotation
from stereo_sfm.tracking.flow.frame_pose import FramePoseSolver, no_pose
from stereo_sfm.tracking.flow.klt import build_pyramid
from stereo_sfm.tracking.flow.reappearance import find_deformed
from stereo_sfm.tracking.flow.rolling_shutter import RollingShutter
from stereo_sfm.tracking.flow.stereo_cameras import StereoCameras
from stereo_sfm.tracking.flow.tracks import Tracks
from stereo_sfm.tracking.flow.windows import FLAT_SIZE
from stereo_sfm.tracking.inertial.inertial_filter import MIN_S
from stereo_sfm.tracking.inertial.inertial_motion import NODE_NS, InertialMotion
from stereo_sfm.types import F32, F64, RIG_TERMS, U8, Corners, ImuSamples, Keyframe, StereoImage

FRAMES, POINTS = 8, 300
WALL = 2.0  # metres ahead
TEXTURE_PX, SQUARE_PX = 512, 8  # of its texture
MOVED_PX = 12.0  # of the left half of the wall in the last image


def images(rig: Rig, count: int = FRAMES) -> list[StereoImage]:
    """A stereo pair passing a wall of grey squares: enough for points, matches and keyframes in any camera.

    The first `count`. In the last of all half of the wall has moved: a second motion.
    """
    texture = squares(TEXTURE_PX, TEXTURE_PX)
    left_rays = _rays(rig.left)
    right_rays = None if rig.second_camera is None else _rays(rig.second_camera)
    out: list[StereoImage] = []
    for k in range(count):
        world_T_left = se3.exp(np.array([0.03 * k, 0.0, 0.02 * k, 0.0, 0.002 * k, 0.0]))
        moved = (k == FRAMES - 1) * MOVED_PX * WALL / rig.left.fx
        left = _wall(left_rays, world_T_left, texture, moved)
        right, depth = None, None
        if rig.depth:
            depth = np.full(left.shape, WALL, np.float32)
        elif right_rays is not None:
            right = _wall(right_rays, world_T_left @ rig.left_T_right, texture, moved)
        out.append(StereoImage(k, 1 + k * 33_000_000, left, right, depth))
    return out


def squares(height: int, width: int) -> U8:
    """(H, W) an image of grey squares."""
    grey = np.random.default_rng(0).integers(20, 230, (-(-height // SQUARE_PX), -(-width // SQUARE_PX)))
    return np.kron(grey, np.ones((SQUARE_PX, SQUARE_PX)))[:height, :width].astype(np.uint8)


def _rays(camera: Camera) -> F32:
    """(H, W, 3) the bearing of each pixel: some camera models take a second for an image."""
    grid = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), -1).reshape(-1, 2)
    return camera.unproject(grid.astype(float)).reshape(camera.height, camera.width, 3).astype(np.float32)


def _wall(rays: F32, world_T_cam: F64, texture: U8, moved: float = 0.0) -> U8:
    """Image of the plane z = WALL covered by `texture` with one centimetre per pixel, its left half `moved` upwards."""
    at = world_T_cam[:3, 3].tolist()
    x, y, z = (np.ascontiguousarray(c) for c in np.moveaxis(rays @ world_T_cam[:3, :3].T.astype(np.float32), -1, 0))
    with np.errstate(invalid="ignore", divide="ignore"):
        u, v = (np.where(z > 0.05, a + c * ((WALL - at[2]) / z), 0) for a, c in zip(at, (x, y), strict=False))
        v += np.float32(moved) * (u < 0)
    return np.asarray(cv2.remap(texture, u * 100, v * 100, cv2.INTER_NEAREST, borderMode=cv2.BORDER_WRAP), np.uint8)


def keyframes(rig: Rig) -> list[Keyframe]:
    """Keyframes of synthetic points for the mapper and the loop closer. Halfway all points are revisited: a loop."""
    rng = np.random.default_rng(0)
    margin = min(40.0, rig.left.width / 4, rig.left.height / 4)
    uv = rng.uniform([margin, margin], [rig.left.width - margin, rig.left.height - margin], (POINTS, 2))
    bearing = rig.left.unproject(uv)
    bearing = bearing[np.nan_to_num(bearing[:, 2]) > 0.3]
    points = bearing * rng.uniform(1, 6, (len(bearing), 1))
    descriptors = rng.integers(0, 256, (len(points), 32)).astype(np.uint8)
    out: list[Keyframe] = []
    for k in range(FRAMES):
        odom_T_cam = se3.exp(np.array([0.02 * k, 0.0, 0.01 * k, 0.0, 0.002 * k, 0.0]))
        points_cam = se3.transform(se3.inverse(odom_T_cam), points)
        right = np.full((len(points), 2), np.nan)
        if rig.right is not None:
            right = rig.project_right(points_cam)
        ids = np.arange(len(points)) + (k % 2) * 20 + (k >= FRAMES // 2) * 10_000
        uv_left = rig.left.project(points_cam)
        small = [a.astype(np.float32) for a in (uv_left, right, points_cam)]
        corners = Corners(small[0], small[1], small[2], descriptors)
        stamp_ns = k * 100_000_000
        out.append(Keyframe(k, k, stamp_ns, odom_T_cam, ids, uv_left, right, points_cam, descriptors, corners=corners))
    return out


def warm_up_fast_motion(config: Config, rig: Rig, image: U8) -> None:
    """What the default tracker does where a prediction fails, it is lost or somebody is near, with an IMU, and when it
    learns that rows are read one after the other."""
    if config.odometry.method != "flow":
        return
    pyramid = build_pyramid(image, config.tracker.pyramid_levels)
    CoarseRotation(rig.left, config.tracker.pyramid_levels).align(pyramid, pyramid, np.eye(3))
    uv, warps, patches = np.zeros((1, 2)), np.tile(np.eye(2), (1, 1, 1, 1)), np.zeros((1, FLAT_SIZE), np.float32)
    find_deformed(pyramid[1], uv, warps, np.zeros(1, np.int64), patches, 1, 1, uv.copy(), warps[0].copy())
    shutter = RollingShutter(rig)
    solver = FramePoseSolver(config.tracker, StereoCameras.of(rig), shutter)
    shutter.use(0.01)  # that the rig's is wrong may turn out in the run
    shutter.project(np.eye(4), np.zeros(6), np.ones((1, 3)), uv)
    solution, none = no_pose(0, ""), np.zeros(0, bool)
    solver.shift_chi2(Tracks(), none, solution, np.zeros(6))
    solver.influence(Tracks(), solution)
    if rig.imu is not None and config.tracker.inertial:
        _warm_up_inertial(rig.imu)


def _warm_up_inertial(imu: Imu) -> None:
    """At rest until the window is long enough for an estimate."""
    motion, times = InertialMotion(imu), np.arange(1, 11) * (NODE_NS // 10)
    motion.begin(0, np.eye(4))
    for at in range(0, round(MIN_S * 1e9) + NODE_NS, NODE_NS):
        resting = np.tile([0.0, -GRAVITY, 0.0], (len(times), 1))
        motion.feed(ImuSamples(at + times, np.zeros((len(times), 3)), resting))
        motion.accept(at + NODE_NS, np.eye(4))


def scratch_job(config: Config, rig: Rig) -> Job | None:
    """A small full bundle adjustment with the solver of large ones, which loads that code; None without a mapper."""
    if not (rig.stereo and config.mapper.enabled):
        return None
    eager = dataclasses.replace(config.mapper, full_ba_growth=0.0, full_ba_lag_keyframes=1)
    mapper = Mapper(eager, rig, NoSpans(), config.loop)
    for keyframe in keyframes(rig):
        mapper.step(keyframe)
    job = mapper.pending_job()
    return job and dataclasses.replace(job, config=dataclasses.replace(job.config, dense=False))


def warm_up_stage(stage: str, config: Config, rig: Rig, patient: bool = False) -> None:
    """Load (the first time ever: compile) what `stage` calls, on a scratch instance of it.

    Args: patient, images may wait for code: only that of the first one is loaded, the rest when it is called.
    """
    from stereo_sfm.calibration.rig_window import SeenPoints, solve_window
    from stereo_sfm.calibration.self_calibration import SelfCalibration

    if stage == "tracker":
        tracker = make_tracker(config, rig)
        seen = images(rig, 1 if patient else FRAMES)
        for image in seen:
            keyframe = tracker.step(image)[1]
            if keyframe is not None:
                tracker.describe(keyframe)
        if not patient:
            dominant_direction(np.eye(MIN_POINTS, 2))  # of shelves, which the wall may be too far away to be
            warm_up_fast_motion(config, rig, seen[-1].left)
    elif stage == "mapper" and rig.stereo:
        mapper = Mapper(config.mapper, rig, NoSpans(), config.loop)
        for keyframe in keyframes(rig):
            mapper.step(keyframe)
        mapper.finish([])
        if SelfCalibration.from_config(config, rig) is not None:
            solve_window(rig, [SeenPoints.of(k) for k in keyframes(rig)[:: FRAMES // 4]], np.zeros(RIG_TERMS))
    elif stage == "loop":
        eager = dataclasses.replace(config.loop, min_gap=1, min_score=0.0, pause=0)
        closer = make_closer(dataclasses.replace(config, loop=eager), rig)
        if closer is not None:
            for keyframe in keyframes(rig):
                closer.step(keyframe)
