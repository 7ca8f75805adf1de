"""Runs every compiled kernel once before a live run begins, so that no frame waits for the loading of code."""

from __future__ import annotations

import numpy as np

from calib.rig import Rig
from stereo_sfm.config import Config
from stereo_sfm.pipeline.stages import make_closer
from stereo_sfm.timing import NoSpans
from stereo_sfm.tracking.factory import make_tracker
from stereo_sfm.types import F32, U8, Keyframe, StereoImage

FRAMES = 4


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


def warm_up_tracker(config: Config, rig: Rig) -> list[Keyframe]:
    """Track the noise; its keyframes warm the other stages up."""
    tracker = make_tracker(config, rig)
    answers = [tracker.step(image) for image in images(rig)]
    return [keyframe for _, keyframe in answers if keyframe is not None]


def warm_up_stage(stage: str, config: Config, rig: Rig) -> None:
    """Load what `stage` calls, on a scratch instance of it."""
    from stereo_sfm.mapping.mapper import Mapper

    keyframes = warm_up_tracker(config, rig)
    if stage == "mapper":
        mapper = Mapper(config.mapper, rig, NoSpans(), config.loop)
        for keyframe in keyframes:
            mapper.step(keyframe)
    elif stage == "loop" and (closer := make_closer(config, rig)) is not None:
        for keyframe in keyframes:
            closer.step(keyframe)
