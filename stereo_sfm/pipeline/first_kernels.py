"""The kernels of the first poses, compiled by two processes at once where there is nothing compiled yet.

The tracker compiles what the first image needs, from the beginning; another process does from the end, and goes on with
what the next images need. Each finds what the other has compiled on disk.
"""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import Config
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.dominant_direction import MIN_POINTS, dominant_direction
from stereo_sfm.kernel_cache import compiled
from stereo_sfm.pipeline.warm_up import squares, warm_up_fast_motion
from stereo_sfm.tracking.descriptors import describe
from stereo_sfm.tracking.flow.follower import Follower
from stereo_sfm.tracking.flow.frame_pose import ExpectedMotion, FramePoseSolver
from stereo_sfm.tracking.flow.klt import Pyramid, build_pyramid
from stereo_sfm.tracking.flow.pose_solver import optimise_pose
from stereo_sfm.tracking.flow.rolling_shutter import RollingShutter
from stereo_sfm.tracking.flow.stereo import StereoMatcher
from stereo_sfm.tracking.flow.stereo_cameras import StereoCameras
from stereo_sfm.tracking.flow.tracks import Tracks
from stereo_sfm.tracking.flow.visible_area import VisibleArea

COLUMNS, REACH = 24, 0.8  # of the grid of points, and tangent of its half angle
BORDER_PX = 20.0
DISTANCE = 2.0  # metres
SECONDS = 0.03  # between images


def help_tracker(config: Config, rig: Rig) -> None:
    """Compile in this process what the tracker's will need after its first image; nothing in later runs."""
    if rig.stereo and config.odometry.method == "flow" and not compiled(optimise_pose):
        compile_share(config, rig)


def compile_share(config: Config, rig: Rig) -> None:
    """The share of the process that helps the default tracker's."""
    tracks, pyramid = _tracks(rig), build_pyramid(squares(*rig.left.size[::-1]), config.tracker.pyramid_levels)
    describe(pyramid[0], tracks.uv)
    matcher = StereoMatcher(config.tracker, rig)
    uv_right = matcher.follow(pyramid, pyramid, tracks.uv, tracks.points(), np.eye(4), tracks.right_offset)
    matcher.placed(tracks.uv, uv_right)
    follower = Follower(config.tracker, rig, VisibleArea(rig.left, config.tracker.max_angle_deg), RollingShutter(rig))
    rows, slots = follower.begin(pyramid, tracks.uv, np.eye(4))
    _compile_pose(config, rig)
    dominant_direction(np.eye(MIN_POINTS, 2))
    _compile_flow(follower, replace(tracks.keep(np.isin(np.arange(len(tracks)), rows)), slot=slots), pyramid)
    warm_up_fast_motion(config, rig, pyramid[0])


def _compile_pose(config: Config, rig: Rig) -> None:
    """What solves for the pose of an image."""
    solver = FramePoseSolver(config.tracker, StereoCameras.of(rig), RollingShutter(rig))
    tracks = _tracks(rig)
    tracks.moving[0] = True
    expected = ExpectedMotion(np.eye(4), np.zeros(6), SECONDS)
    found = solver.solve(tracks, expected, np.eye(4))
    if not found.reason:
        solver.learn(tracks, found, expected)
        solver.refine_depth(tracks, found)
    se3.log(np.eye(4))


def _compile_flow(follower: Follower, tracks: Tracks, pyramid: Pyramid) -> None:
    """What follows points from one image to the next."""
    follower.accept(pyramid, tracks)
    expected = ExpectedMotion(np.eye(4), np.zeros(6), SECONDS)
    for _ in range(2):  # by translation at first, from the prediction then
        tracks = follower.follow(tracks, expected.pose, pyramid, expected)


def _tracks(rig: Rig) -> Tracks:
    """Points of a wall, all over the view."""
    x, y = np.meshgrid(np.linspace(-REACH, REACH, COLUMNS), np.linspace(-REACH, REACH, COLUMNS))
    direction = np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3)
    uv = rig.left.project(DISTANCE * direction)
    uv_right = rig.project_right(DISTANCE * direction)
    seen = rig.left.inside(uv, BORDER_PX) & np.isfinite(uv_right[:, 0])
    n, none = len(uv), Tracks()
    zeros: dict[str, Any] = {
        f.name: np.zeros((n, *getattr(none, f.name).shape[1:]), getattr(none, f.name).dtype) for f in fields(none)
    }
    given: dict[str, Any] = {"uv": uv, "uv_right": uv_right, "direction": direction, "rho": np.full(n, 1 / DISTANCE)}
    given |= {"variance": np.full(n, 1e-4), "warp": np.tile(np.eye(2), (n, 1, 1))}
    return Tracks(**(zeros | given)).keep(seen)
