"""Rectification of a rig: the rectified rig and its images."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereo_sfm.calib.rig import Rig
from stereo_sfm.errors import StereoSfmError, one_of
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Camera
from stereo_sfm.geometry.rectify import epipolar_camera, pinhole_camera, remap_tables
from stereo_sfm.geometry.stereo import rectifying_rotations
from stereo_sfm.types import F64, U8, Bool

PROJECTIONS = ("none", "pinhole", "epipolar")
MAX_CALIBRATED_ANGLE = np.deg2rad(75.0)  # from the axis: calibration targets reach no further


@dataclass(frozen=True, eq=False)
class CameraRectification:
    """Maps the images of one camera to rectified ones."""

    source: Camera
    target: Camera
    target_R_source: F64  # (3, 3)
    table: NDArray[np.int16]  # (H, W, 2) of cv2.remap
    fraction: NDArray[np.uint16]  # (H, W)
    mask: Bool  # (H, W) pixels that have a source

    def apply(self, image: U8) -> U8:
        """(H, W) image of the source -> (H, W) image of the target, black where the source does not reach."""
        import cv2

        if image.shape[:2] != (self.source.height, self.source.width):
            raise StereoSfmError(
                f"image of {image.shape[1]}x{image.shape[0]} px, but the calibration is for"
                f" {self.source.width}x{self.source.height}"
            )
        out: Any = cv2.remap(image, self.table, self.fraction, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
        return out

    def to_source(self, uv: F64) -> F64:
        """(..., 2) rectified px -> (..., 2) px of the original image."""
        return self.source.project(self.target.unproject(uv) @ self.target_R_source)

    @cached_property
    def well_calibrated(self) -> Bool:
        """(H, W) pixels of the mask whose ray is close enough to the optical axis to be well calibrated."""
        axis = self.target_R_source[:, 2]
        return self.mask & (np.nan_to_num(self.target.bearing_grid() @ axis, nan=-1.0) >= np.cos(MAX_CALIBRATED_ANGLE))

    def from_source(self, uv: F64) -> F64:
        """(..., 2) px of the original image -> (..., 2) rectified px."""
        return self.target.project(self.source.unproject(uv) @ self.target_R_source.T)


@dataclass(frozen=True, eq=False)
class Rectification:
    """Both cameras rotated and projected so that a point lies on the same row of both images."""

    rig: Rig  # equal cameras, baseline along +x
    left: CameraRectification
    right: CameraRectification
    cam_T_rect: F64  # (4, 4) pose of the rectified left camera in the original one: a rotation

    def apply(self, left: U8, right: U8) -> tuple[U8, U8]:
        """Both rectified images."""
        return self.left.apply(left), self.right.apply(right)


def rectify(
    rig: Rig,
    projection: str = "epipolar",
    hfov_deg: float | None = None,
    size: tuple[int, int] | None = None,
) -> Rectification:
    """Rectify a stereo rig.

    Args:
        rig: two cameras.
        projection: "pinhole" or "epipolar" ("none" is not valid here).
        hfov_deg: horizontal field of view; None keeps what the projection can represent well.
        size: (width, height) px of the rectified images; None keeps about the resolution of the image centre.

    Raises:
        StereoSfmError: one camera, depth camera, unknown projection, or geometry that cannot be rectified.
    """
    if (second := rig.second_camera) is None:
        raise StereoSfmError("rectification needs two cameras: this source has one")
    one_of(projection, ("pinhole", "epipolar"), "projection")
    rect_R_left, rect_R_right = rectifying_rotations(rig.left_T_right)
    choose = pinhole_camera if projection == "pinhole" else epipolar_camera
    camera = choose(rig.left, second, rect_R_left, rect_R_right, hfov_deg, size)
    left = camera_rectification(rig.left, rig.left_mask, camera, rect_R_left)
    right = camera_rectification(second, rig.right_mask, camera, rect_R_right)
    cam_T_rect = se3.from_rotation_translation(rect_R_left.T, np.zeros(3))
    baseline = se3.from_rotation_translation(np.eye(3), np.array([rig.baseline, 0.0, 0.0]))
    new = replace(
        rig,
        left_mask=None if rig.left_mask is None else left.mask.copy(),
        right_mask=None if rig.right_mask is None else right.mask.copy(),
        left=camera,
        right=camera,
        left_T_right=baseline,
        body_T_left=rig.body_T_left @ cam_T_rect,
        imu=rig.imu.seen_from(se3.inverse(cam_T_rect)) if rig.imu else None,
        wheel=rig.wheel.seen_from(se3.inverse(cam_T_rect)) if rig.wheel else None,
        readout_s=rig.readout_s * _rows_read(rig.left, camera, rect_R_left),
    )
    return Rectification(new, left, right, cam_T_rect)


def camera_rectification(
    source: Camera, used: Bool | None, target: Camera, target_R_source: F64
) -> CameraRectification:
    """The tables of one camera; what `used` (H, W) does not cover has no source."""
    found = CameraRectification(source, target, target_R_source, *remap_tables(source, target, target_R_source))
    if used is None:
        return found
    return replace(found, mask=found.mask & (found.apply(used.astype(np.uint8)) > 0))


def _rows_read(original: Camera, camera: Camera, rect_R_left: F64) -> float:
    """The fraction of the original rows that the rectified image shows, along its middle column."""
    column = np.array([[camera.cx, 0.0], [camera.cx, camera.height - 1.0]])
    rows = original.project(camera.unproject(column) @ rect_R_left)[:, 1]
    part = (rows[1] - rows[0]) / (original.height - 1)
    return float(np.clip(part, 0.0, 1.0)) if np.isfinite(part) else 1.0
