"""Rendered views of a calibration target moved in front of a camera, with ground truth."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.calib.targets import Target, charuco_board
from stereo_sfm.drivers.sim.effects import CLEAN, Sensor
from stereo_sfm.drivers.sim.render import NO_OBJECTS, Renderer
from stereo_sfm.drivers.sim.targets import FlatTarget, empty_room, move, place
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.types import F64, U8

TEXELS = 2048


@dataclass(frozen=True)
class Faults:
    """Effects of the lens and the sensor."""

    lens_blur_px: float = 0.6
    read_noise: float = 1.5  # grey levels
    vignetting: float = 0.3


def board_image(target: Target) -> tuple[U8, F64]:
    """(TEXELS, TEXELS) image of the target and (2,) its size in metres; the first corner square starts at (0, 0).

    Checkerboards get a white margin of one square, which `corner_origin` accounts for.
    """
    import cv2

    if target.kind == "charuco":
        side = 4 * TEXELS // max(target.columns, target.rows)
        image: Any = charuco_board(target).generateImage((side * target.columns, side * target.rows), marginSize=0)
        size = target.size * np.array([target.columns, target.rows])
    elif target.kind == "checkerboard":
        cells = np.indices((target.rows + 1, target.columns + 1)).sum(0) % 2
        squares = np.pad(np.where(cells, 255, 0).astype(np.uint8), 1, constant_values=255)
        image = np.kron(squares, np.ones((512, 512), np.uint8))
        size = target.size * np.array([target.columns + 3.0, target.rows + 3.0])
    else:
        raise StereoSfmError(f"cannot render a target of kind {target.kind}: choose charuco or checkerboard")
    return cv2.resize(image, (TEXELS, TEXELS), interpolation=cv2.INTER_AREA).astype(np.uint8), size


def corner_origin(target: Target) -> F64:
    """(4, 4) board_T_target: pose of the target's frame in the frame of the board's image."""
    shift = 2 * target.size if target.kind == "checkerboard" else 0.0
    return se3.from_rotation_translation(np.eye(3), np.array([shift, shift, 0.0]))


def random_views(rig: Rig, size: F64, count: int, seed: int, field_deg: float) -> F64:
    """(count, 4, 4) left_T_board: near and far, tilted, spread over a cone of `field_deg`."""
    rng = np.random.default_rng([seed, 71])
    middle = np.eye(4)
    middle[:2, 3] = -0.5 * size
    out = np.empty((count, 4, 4))
    extent = float(np.linalg.norm(size))
    for i in range(count):
        angle = np.deg2rad(0.5 * field_deg) * np.sqrt((i + 0.5) / count) * rng.uniform(0.75, 1.0)
        around = 2.399963 * i + rng.uniform(-0.2, 0.2)  # the golden angle spreads them evenly
        look = se3.so3_exp(angle * np.array([-np.sin(around), np.cos(around), 0.0]))
        tilt = se3.so3_exp(np.deg2rad(rng.uniform(-1, 1, 3) * [42.0, 42.0, 25.0]))
        distance = extent * rng.uniform(0.55, 1.1) * (1.0 if i % 3 else 1.5)
        pose = se3.from_rotation_translation(look @ tilt, look @ np.array([0.5 * rig.baseline, 0.0, distance]))
        out[i] = pose @ middle
    return out


def render_boards(
    rig: Rig, target: Target, count: int = 24, seed: int = 0, faults: Faults | None = None, field_deg: float = 50.0
) -> tuple[list[tuple[U8, U8]], F64]:
    """Stereo images of the target, and (count, 4, 4) left_T_target.

    Args:
        rig: two cameras. faults: of the sensor; None: `Faults()`.
        field_deg: full angle of the cone in which the target's middle moves.
    """
    if rig.right is None:
        raise StereoSfmError("rendering calibration boards needs two cameras")
    faults = faults or Faults()
    image, size = board_image(target)
    world_T_board = se3.from_rotation_translation(np.eye(3), np.array([6.0, 5.0, 1.8]))
    board = FlatTarget(image, float(size[0]), float(size[1]), world_T_board)
    world, moving = place(empty_room(), [board], NO_OBJECTS)
    renderer = Renderer(world, rig)
    effects = replace(
        CLEAN, lens_blur_px=faults.lens_blur_px, read_noise=faults.read_noise, vignetting=faults.vignetting
    )
    sensors = [Sensor(side, effects) for side in renderer.cameras]
    poses = random_views(rig, size, count, seed, field_deg)
    moving = move(moving, board, world_T_board)
    pairs: list[tuple[U8, U8]] = []
    for i, pose in enumerate(poses):
        views = renderer.render(world_T_board @ se3.inverse(pose), moving)
        keys = [(seed * 1000 + i) * 2 + k for k in range(2)]
        left, right = (s.expose(v, np.zeros(6), 0.8, k) for s, v, k in zip(sensors, views, keys, strict=True))
        pairs.append((left, right))
    return pairs, poses @ corner_origin(target)
