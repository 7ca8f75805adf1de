"""Straight edges of the scene as great circles on the sphere of bearings, for any camera.

A line in space and the camera centre span a plane; the plane's normal is all that one view shows of the line's
direction (perpendicular to it). A pinhole image is searched directly. A fisheye image bends lines, so it is first
resampled to the faces of a cube (pinhole views of one angular resolution), where they are straight.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from stereo_sfm.geometry.cameras import Camera, Pinhole
from stereo_sfm.types import F32, F64, U8, Message

_CUBE_EDGE = 1.02  # tangent of half a face's angle: faces overlap slightly, so that no line is lost at an edge
_BORDER_PX = 4  # segments closer to the image border are artefacts of it
_MAX_PINHOLE_TAN = 1.7  # an undistorted single face up to about 60 degrees from the axis


@dataclass(frozen=True, eq=False)
class LineSegments(Message):
    """Segments of one image on the sphere, one row each."""

    normals: F64  # (L, 3) unit, of the plane through the camera centre
    starts: F64  # (L, 3) unit bearings
    ends: F64  # (L, 3) unit bearings
    angles: F64  # (L,) radians, angular length

    def __len__(self) -> int:
        return len(self.normals)


@dataclass(frozen=True, eq=False)
class _Face:
    """A pinhole view of the image: rays = (x, y, 1) @ camera_R_face.T."""

    camera_R_face: F64  # (3, 3)
    focal: float
    centre: tuple[float, float]
    maps: tuple[F32, F32] | None  # for cv2.remap; None where the image itself is the face
    margin: F32 | None  # (H, W) px to the nearest pixel outside the camera's view; None where every pixel is valid


class LineDetector:
    """LSD (von Gioi et al., PAMI 32, 2010) on the image or on its cube faces."""

    def __init__(self, camera: Camera, min_length_px: float = 15.0, max_lines: int = 600) -> None:
        """Args:
        camera: of the images.
        min_length_px: shorter segments are dropped. max_lines: the longest are kept.
        """
        self._faces = _faces(camera)
        self._min_length = min_length_px
        self._max_lines = max_lines
        self._detector = cv2.createLineSegmentDetector(cv2.LSD_REFINE_STD, 0.8)

    def detect(self, image: U8) -> LineSegments:
        """Segments of an (H, W) image, the longest first."""
        starts, ends = zip(*(self._on_face(image, face) for face in self._faces), strict=True)
        start, end = np.concatenate(starts), np.concatenate(ends)
        normal = np.cross(start, end)
        sine = np.linalg.norm(normal, axis=1)
        order = np.argsort(-sine, kind="stable")[: self._max_lines]
        order = order[sine[order] > 1e-6]
        normal = normal[order] / sine[order, None]
        angle = np.arctan2(sine[order], (start[order] * end[order]).sum(1))
        return LineSegments(normal, start[order], end[order], angle)

    def _on_face(self, image: U8, face: _Face) -> tuple[F64, F64]:
        """(L, 3) bearings of both ends of the segments on one face."""
        seen = image if face.maps is None else cv2.remap(image, *face.maps, cv2.INTER_LINEAR)
        found: Any = self._detector.detect(seen)[0]
        if found is None:
            return np.zeros((0, 3)), np.zeros((0, 3))
        segments = np.asarray(found, np.float64).reshape(-1, 2, 2)
        length = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1)
        segments = segments[(length >= self._min_length) & _inside(segments, seen.shape, face.margin)]
        rays = np.ones((*segments.shape[:2], 3))
        rays[..., :2] = (segments - np.array(face.centre)) / face.focal
        rays = rays @ face.camera_R_face.T
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        return rays[:, 0], rays[:, 1]


def _inside(segments: F64, shape: tuple[int, ...], margin: F32 | None) -> np.ndarray:
    """(L,) segments whose ends and middle are not at the border of the camera's view."""
    probes = np.concatenate([segments, segments.mean(axis=1, keepdims=True)], axis=1)
    u = np.rint(probes[..., 0]).astype(int).clip(0, shape[1] - 1)
    v = np.rint(probes[..., 1]).astype(int).clip(0, shape[0] - 1)
    edge = np.minimum(np.minimum(u, shape[1] - 1 - u), np.minimum(v, shape[0] - 1 - v)).astype(float)
    if margin is not None:
        edge = np.minimum(edge, margin[v, u])
    return (edge > _BORDER_PX).sum(axis=1) >= 2


def _faces(camera: Camera) -> list[_Face]:
    if isinstance(camera, Pinhole):
        same = camera.fx == camera.fy
        if same:
            return [_Face(np.eye(3), camera.fx, (camera.cx, camera.cy), None, None)]
    focal = 0.5 * (camera.fx + camera.fy)
    corners = camera.unproject(_border_pixels(camera))
    corners = corners[np.isfinite(corners[:, 2])]
    tan = corners[:, :2] / corners[:, 2:].clip(1e-3)
    single = len(corners) > 0 and corners[:, 2].min() > 0.3 and np.abs(tan).max() < _MAX_PINHOLE_TAN
    if single:
        return [_face(camera, np.eye(3), focal, float(np.abs(tan[:, 0]).max()), float(np.abs(tan[:, 1]).max()))]
    turns = [np.eye(3)]
    for axis, angle in ((1, 90.0), (1, -90.0), (0, 90.0), (0, -90.0)):
        turns.append(_turn(axis, angle))
    faces = [_face(camera, turn, focal, _CUBE_EDGE, _CUBE_EDGE) for turn in turns]
    return [face for face in faces if face.margin is not None and (face.margin > _BORDER_PX).mean() > 0.02]


def _turn(axis: int, degrees: float) -> F64:
    vector = np.zeros(3)
    vector[axis] = np.radians(degrees)
    return cv2.Rodrigues(vector)[0].astype(np.float64)


def _border_pixels(camera: Camera) -> F64:
    u, v = np.linspace(0, camera.width - 1, 40), np.linspace(0, camera.height - 1, 40)
    rows = [np.stack([u, np.full_like(u, e)], 1) for e in (0.0, camera.height - 1.0)]
    columns = [np.stack([np.full_like(v, e), v], 1) for e in (0.0, camera.width - 1.0)]
    return np.concatenate(rows + columns)


def _face(camera: Camera, camera_R_face: F64, focal: float, tan_x: float, tan_y: float) -> _Face:
    width, height = 2 * int(np.ceil(tan_x * focal)) + 1, 2 * int(np.ceil(tan_y * focal)) + 1
    centre = (0.5 * (width - 1), 0.5 * (height - 1))
    u, v = np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float))
    rays = np.stack([(u - centre[0]) / focal, (v - centre[1]) / focal, np.ones_like(u)], -1) @ camera_R_face.T
    uv = camera.project(rays)
    seen = camera.inside(uv, 1.0)
    margin = cv2.distanceTransform(seen.astype(np.uint8), cv2.DIST_L2, 3).astype(np.float32)
    uv = np.where(seen[..., None], uv, -1e3).astype(np.float32)
    maps = np.ascontiguousarray(uv[..., 0]), np.ascontiguousarray(uv[..., 1])
    return _Face(camera_R_face, focal, centre, maps, margin)
