"""Runs every compiled kernel once before a run begins: no live frame waits for code, and the first run of all compiles
the stages side by side."""

from __future__ import annotations

import dataclasses

import numpy as np

from calib.rig import Rig
from stereo_sfm.config import Config
from stereo_sfm.geometry import se3
from stereo_sfm.pipeline.stages import make_closer
from stereo_sfm.timing import NoSpans
from stereo_sfm.tracking.factory import make_tracker
from stereo_sfm.types import F32, U8, Keyframe, StereoImage

FRAMES, POINTS = 4, 300


def images(rig: Rig) -> list[StereoImage]:
    """Noise that moves a little: enough for points, matches and keyframes in any camera."""
    rng = np.random.default_rng(0)
    height, width = rig.left.height, rig.left.width
    coarse = rng.integers(20, 230, (height // 8 + 2, width // 8 + 8))
    wall = np.kron(coarse, np.ones((8, 8))).astype(np.uint8)
    out: list[StereoImage] = []
    for k in range(FRAMES):
        left = np.ascontiguousarray(wall[:height, 2 * k : 2 * k + width])
        right: U8 | None = None
        depth: F32 | None = None
        if rig.right is not None and not rig.depth:
            right = np.ascontiguousarray(wall[: rig.right.height, 2 * k + 4 : 2 * k + 4 + rig.right.width])
        elif rig.depth:
            depth = np.full((height, width), 2.0, np.float32)
        out.append(StereoImage(k, 1 + k * 33_000_000, left, right, depth))
    return out


def keyframes(rig: Rig) -> list[Keyframe]:
    """Keyframes of a made scene that see the same points: what the mapper and the loop closer work on."""
    rng = np.random.default_rng(0)
    uv = rng.uniform([40, 40], [rig.left.width - 40, rig.left.height - 40], (POINTS, 2))
    bearing = rig.left.unproject(uv)
    bearing = bearing[np.nan_to_num(bearing[:, 2]) > 0.3]
    points = bearing * rng.uniform(1, 6, (len(bearing), 1))
    descriptors = rng.integers(0, 256, (len(points), 32)).astype(np.uint8)
    out: list[Keyframe] = []
    for k in range(FRAMES):
        odom_T_cam = se3.exp(np.array([0.05 * k, 0.0, 0.02 * k, 0.0, 0.005 * k, 0.0]))
        points_cam = se3.transform(se3.inverse(odom_T_cam), points)
        right = np.full((len(points), 2), np.nan)
        if rig.right is not None:
            right = rig.right.project(se3.transform(se3.inverse(rig.left_T_right), points_cam))
        out.append(
            Keyframe(
                k,
                k,
                k * 100_000_000,
                odom_T_cam,
                np.arange(len(points)) + (k % 2) * 20,
                rig.left.project(points_cam),
                right,
                points_cam,
                descriptors,
                np.zeros(len(points), np.float32),
            )
        )
    return out


def warm_up_stage(stage: str, config: Config, rig: Rig) -> None:
    """Load (the first time ever: compile) what `stage` calls, on a scratch instance of it."""
    from stereo_sfm.mapping.mapper import Mapper

    if stage == "tracker":
        tracker = make_tracker(config, rig)
        for image in images(rig):
            tracker.step(image)
    elif stage == "mapper" and rig.stereo:
        mapper = Mapper(config.mapper, rig, NoSpans(), config.loop)
        for keyframe in keyframes(rig):
            mapper.step(keyframe)
    elif stage == "loop":
        eager = dataclasses.replace(config.loop, min_gap=1, min_score=0.0, pause=0)
        closer = make_closer(dataclasses.replace(config, loop=eager), rig)
        if closer is not None:
            for keyframe in keyframes(rig):
                closer.step(keyframe)
