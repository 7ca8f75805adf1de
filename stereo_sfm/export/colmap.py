"""COLMAP text model (3.12 and later: rigs and frames; the classic three files are complete for older readers).

With a rolling shutter, observations are corrected to a global shutter: some pixels off from the images.
COLMAP's poses are cam_from_world, quaternions w first, and the centre of the top-left pixel is (0.5, 0.5).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from stereo_sfm.calib.formats.colmap import write_colmap
from stereo_sfm.calib.rig import Rig
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Camera
from stereo_sfm.mapping.map import MapSnapshot
from stereo_sfm.maps.saved_map import SavedMap
from stereo_sfm.types import F64

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


def export_colmap(saved: SavedMap, folder: Path) -> None:
    """cameras, rigs, frames, images and points3D as text, without points that are seen once: COLMAP refuses those."""
    rig, s = _without_virtual_camera(saved.rig), saved.snapshot
    write_colmap(rig, folder)
    cameras = [("left", rig.left, np.eye(4), s.uv_left)]
    if rig.right is not None:
        cameras.append(("right", rig.right, se3.inverse(rig.left_T_right), s.uv_right))
    _write_frames(s, len(cameras), folder / "frames.txt")
    names = [image_names(saved, side) for side, *_ in cameras]
    tracks = _write_images(s, cameras, names, folder / "images.txt")
    errors = _reprojection_errors(s, cameras)
    _write_points(s, tracks, errors, folder / "points3D.txt")


def _without_virtual_camera(rig: Rig) -> Rig:
    """The rig without the virtual right camera of a depth camera."""
    return Rig(rig.left, name=rig.name) if rig.depth else rig


def _pose(cam_T_map: F64) -> str:
    x, y, z, w = se3.quaternion_from_rotation(cam_T_map[:3, :3]).tolist()
    return " ".join(repr(float(v)) for v in (w, x, y, z, *cam_T_map[:3, 3]))


def _write_frames(s: MapSnapshot, cameras: int, path: Path) -> None:
    lines = [
        "# FRAME_ID, RIG_ID, RIG_FROM_WORLD[QW..TZ], NUM_DATA_IDS, DATA_IDS[] as (SENSOR_TYPE, SENSOR_ID, DATA_ID)"
    ]
    for k, pose in enumerate(se3.inverse(s.map_T_kf)):
        data = " ".join(f"CAMERA {e + 1} {k * cameras + e + 1}" for e in range(cameras))
        lines.append(f"{k + 1} 1 {_pose(pose)} {cameras} {data}")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _write_images(
    s: MapSnapshot, cameras: list[tuple[str, Camera, F64, F64]], names: list[list[str]], path: Path
) -> list[list[str]]:
    """Write all images; returns for each point its track as 'IMAGE_ID INDEX' entries."""
    lines = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME", "# POINTS2D[] as (X, Y, POINT3D_ID)"]
    bounds = np.searchsorted(s.obs_kf, np.arange(len(s.kf_ids) + 1)).tolist()
    tracks: list[list[str]] = [[] for _ in range(len(s.pt_ids))]
    views = sum(np.bincount(s.obs_pt[np.isfinite(uv[:, 0])], minlength=len(s.pt_ids)) for *_, uv in cameras)
    ids = np.where(views >= LEAST_VIEWS, np.arange(1, len(s.pt_ids) + 1), NO_POINT)
    for k, left_T_map in enumerate(se3.inverse(s.map_T_kf)):
        for e, (_, _, cam_T_left, uv) in enumerate(cameras):
            image_id = k * len(cameras) + e + 1
            rows = np.arange(bounds[k], bounds[k + 1])
            rows = rows[np.isfinite(uv[rows, 0])]
            lines.append(f"{image_id} {_pose(cam_T_left @ left_T_map)} {e + 1} {names[e][k]}")
            pixels, points = (uv[rows] + HALF_PIXEL).tolist(), ids[s.obs_pt[rows]].tolist()
            lines.append(" ".join(f"{u!r} {v!r} {p}" for (u, v), p in zip(pixels, points, strict=True)))
            for n, point in enumerate(s.obs_pt[rows].tolist()):
                tracks[point].append(f"{image_id} {n}")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return tracks


def _reprojection_errors(s: MapSnapshot, cameras: list[tuple[str, Camera, F64, F64]]) -> F64:
    """(P,) mean reprojection error of each point in px."""
    total, count = np.zeros(len(s.pt_ids)), np.zeros(len(s.pt_ids))
    kf_T_map = se3.inverse(s.map_T_kf)
    for _, camera, cam_T_left, uv in cameras:
        pose = cam_T_left @ kf_T_map[s.obs_kf]
        seen = np.einsum("nij,nj->ni", pose[:, :3, :3], s.points[s.obs_pt]) + pose[:, :3, 3]
        distance = np.linalg.norm(camera.project(seen) - uv, axis=1)
        ok = np.isfinite(distance)
        np.add.at(total, s.obs_pt[ok], distance[ok])
        np.add.at(count, s.obs_pt[ok], 1)
    return total / np.maximum(count, 1)


def _write_points(s: MapSnapshot, tracks: list[list[str]], errors: F64, path: Path) -> None:
    lines = ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)"]
    for p, (xyz, error, track) in enumerate(zip(s.points.tolist(), errors.tolist(), tracks, strict=True)):
        if len(track) < LEAST_VIEWS:
            continue
        x, y, z = xyz
        lines.append(f"{p + 1} {x!r} {y!r} {z!r} {GREY} {error!r} {' '.join(track)}")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
