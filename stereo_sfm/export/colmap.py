"""COLMAP text model (3.12 and later: rigs and frames; the classic three files are complete for older readers).

With a rolling shutter, observations are corrected to a global shutter: some pixels off from the images.
COLMAP's poses are cam_from_world, quaternions w first, and the centre of the top-left pixel is (0.5, 0.5).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import numpy as np

from stereo_sfm.calib.formats.colmap import write_colmap_rigs
from stereo_sfm.calib.rig import Rig
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Camera
from stereo_sfm.mapping.snapshot import MapSnapshot
from stereo_sfm.maps.saved_map import SavedMap
from stereo_sfm.types import F64, I64

HALF_PIXEL = 0.5
GREY = "128 128 128"
LEAST_VIEWS = 2  # of a point
NO_POINT = -1  # of a pixel


def image_name(frame_id: int, side: str, session: int | None = None) -> str:
    """Path of a frame's image below COLMAP's image folder; `session` in maps of several sessions only."""
    return f"{side}/{frame_id:06d}.png" if session is None else f"{side}/walk{session}/{frame_id:06d}.png"


def image_names(saved: SavedMap, side: str) -> list[str]:
    """The image name of every keyframe; frame ids repeat between sessions, names are unique."""
    session_ids: list[int | None] = [None] * len(saved) if len(saved.session_ids) == 1 else saved.sessions.tolist()
    return [
        image_name(k, side, session) for k, session in zip(saved.snapshot.frame_ids.tolist(), session_ids, strict=True)
    ]


@dataclass(frozen=True, eq=False)
class _Image:
    """One image of the model."""

    image_id: int
    camera_id: int
    name: str
    camera: Camera
    cam_T_map: F64  # (4, 4)
    rows: I64  # of the observations in it
    uv: F64  # (N, 2) px of those


def export_colmap(saved: SavedMap, folder: Path) -> None:
    """cameras, rigs, frames, images and points3D as text, without points that are seen once: COLMAP refuses those."""
    taken, s = saved.keyframe_rigs(), saved.snapshot
    number = {rig: i for i, rig in enumerate(dict.fromkeys(taken))}
    rigs = [_without_virtual_camera(rig) for rig in number]
    write_colmap_rigs(rigs, folder)
    images = _images(saved, rigs, [number[rig] for rig in taken])
    _write_frames(s, [number[rig] + 1 for rig in taken], images, folder / "frames.txt")
    tracks = _write_images(s, images, folder / "images.txt")
    _write_points(s, tracks, _reprojection_errors(s, images), folder / "points3D.txt")


def _without_virtual_camera(rig: Rig) -> Rig:
    """The rig without the virtual right camera of a depth camera."""
    return Rig(rig.left, name=rig.name) if rig.depth else rig


def _images(saved: SavedMap, rigs: Sequence[Rig], which: Sequence[int]) -> list[list[_Image]]:
    """The images of each keyframe; `which`: the rig of each."""
    s, names = saved.snapshot, [image_names(saved, side) for side in ("left", "right")]
    bounds = np.searchsorted(s.obs_kf, np.arange(len(s.kf_ids) + 1)).tolist()
    first_camera = np.cumsum([0, *(1 + (rig.right is not None) for rig in rigs)]).tolist()
    out: list[list[_Image]] = []
    image_id = 0
    for k, left_T_map in enumerate(se3.inverse(s.map_T_kf)):
        rig, seen = rigs[which[k]], np.arange(bounds[k], bounds[k + 1])
        cameras = [(rig.left, np.eye(4), s.uv_left)]
        if rig.right is not None:
            cameras.append((rig.right, se3.inverse(rig.left_T_right), s.uv_right))
        out.append([])
        for e, (camera, cam_T_left, uv) in enumerate(cameras):
            image_id += 1
            rows, camera_id = seen[np.isfinite(uv[seen, 0])], first_camera[which[k]] + e + 1
            out[k].append(_Image(image_id, camera_id, names[e][k], camera, cam_T_left @ left_T_map, rows, uv[rows]))
    return out


def _pose(cam_T_map: F64) -> str:
    x, y, z, w = se3.quaternion_from_rotation(cam_T_map[:3, :3]).tolist()
    return " ".join(repr(float(v)) for v in (w, x, y, z, *cam_T_map[:3, 3]))


def _write_frames(s: MapSnapshot, rig_ids: Sequence[int], images: Sequence[Sequence[_Image]], path: Path) -> None:
    lines = [
        "# FRAME_ID, RIG_ID, RIG_FROM_WORLD[QW..TZ], NUM_DATA_IDS, DATA_IDS[] as (SENSOR_TYPE, SENSOR_ID, DATA_ID)"
    ]
    for k, (pose, rig_id, own) in enumerate(zip(se3.inverse(s.map_T_kf), rig_ids, images, strict=True)):
        data = " ".join(f"CAMERA {image.camera_id} {image.image_id}" for image in own)
        lines.append(f"{k + 1} {rig_id} {_pose(pose)} {len(own)} {data}")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _write_images(s: MapSnapshot, images: Sequence[Sequence[_Image]], path: Path) -> list[list[str]]:
    """Write all images; returns for each point its track as 'IMAGE_ID INDEX' entries."""
    lines = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME", "# POINTS2D[] as (X, Y, POINT3D_ID)"]
    tracks: list[list[str]] = [[] for _ in range(len(s.pt_ids))]
    views = np.zeros(len(s.pt_ids), np.int64)
    for image in chain.from_iterable(images):
        views += np.bincount(s.obs_pt[image.rows], minlength=len(s.pt_ids))
    ids = np.where(views >= LEAST_VIEWS, np.arange(1, len(s.pt_ids) + 1), NO_POINT)
    for image in chain.from_iterable(images):
        lines.append(f"{image.image_id} {_pose(image.cam_T_map)} {image.camera_id} {image.name}")
        points = s.obs_pt[image.rows]
        pixels = (image.uv + HALF_PIXEL).tolist()
        lines.append(" ".join(f"{u!r} {v!r} {p}" for (u, v), p in zip(pixels, ids[points].tolist(), strict=True)))
        for n, point in enumerate(points.tolist()):
            tracks[point].append(f"{image.image_id} {n}")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return tracks


def _reprojection_errors(s: MapSnapshot, images: Sequence[Sequence[_Image]]) -> F64:
    """(P,) mean reprojection error of each point in px."""
    total, count = np.zeros(len(s.pt_ids)), np.zeros(len(s.pt_ids))
    for image in chain.from_iterable(images):
        points = s.obs_pt[image.rows]
        seen = image.camera.project(se3.transform(image.cam_T_map, s.points[points]))
        distance = np.linalg.norm(seen - image.uv, axis=1)
        ok = np.isfinite(distance)
        np.add.at(total, points[ok], distance[ok])
        np.add.at(count, points[ok], 1)
    return total / np.maximum(count, 1)


def _write_points(s: MapSnapshot, tracks: list[list[str]], errors: F64, path: Path) -> None:
    lines = ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)"]
    for p, (xyz, error, track) in enumerate(zip(s.points.tolist(), errors.tolist(), tracks, strict=True)):
        if len(track) < LEAST_VIEWS:
            continue
        x, y, z = xyz
        lines.append(f"{p + 1} {x!r} {y!r} {z!r} {GREY} {error!r} {' '.join(track)}")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
