"""COLMAP's dense workspace: undistorted images, a sparse model of them, depth and normal maps as its fusion reads them.

Files as in COLMAP's `mvs/mat.h`: a line "WIDTH&HEIGHT&CHANNELS&", then float32 with columns fastest and channels last.
Depth is along the optical axis, 0 where unknown; normals are in the camera's frame.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.dense.depth import DepthImage
from stereo_sfm.dense.inputs import DenseInput, keyframes
from stereo_sfm.dense.keyframe_depth import VIEW_PX, KeyframeImages, keyframe_depth, seen_in, with_partners
from stereo_sfm.dense.live import ahead
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.export.colmap import export_colmap, image_names
from stereo_sfm.geometry.cameras import Camera, Pinhole
from stereo_sfm.geometry.rectify import remap_tables
from stereo_sfm.maps.cameras import MapCamera
from stereo_sfm.maps.merge import subset
from stereo_sfm.maps.saved_map import SavedMap
from stereo_sfm.types import F32, F64, U8

KIND = "geometric"  # COLMAP's word for depth that several images agree on
NEIGHBOURS = 20  # images that fusion compares with each: COLMAP's default


def export_colmap_dense(given: DenseInput, folder: Path, report: Callable[[int, int], None] = lambda *_: None) -> int:
    """Write the workspace of the keyframes that have depth; returns their number.

    Raises:
        StereoSfmError: none has depth.
    """
    saved = given.saved
    names = image_names(saved, "left")
    chosen: list[int] = []
    for count, found in enumerate(with_partners(keyframes(given), saved.sessions), 1):
        if found is not None and (depth := keyframe_depth(*found)) is not None:
            now = found[0]
            _write_view(folder, names[now.number], now, depth)
            chosen.append(now.number)
        report(count, len(saved))
    if not chosen:
        raise StereoSfmError("no keyframe has depth: one camera needs keyframes 10 to 40 cm apart")
    _write_model(saved, sorted(chosen), folder)
    return len(chosen)


def view_camera(rig: Rig) -> Pinhole:
    """Of the undistorted images of a rig's left camera, with its axes."""
    return ahead(rig, min(1.0, VIEW_PX / max(rig.left.size)))


def _write_view(folder: Path, name: str, now: KeyframeImages, depth: DepthImage) -> None:
    camera = view_camera(now.rig)
    _write_image(folder / "images" / name, _undistorted(now.rig.left, camera, now.left))
    empty = np.zeros((camera.height, camera.width), np.float32)
    here = DepthImage(camera, np.eye(3), empty, empty, np.zeros(empty.shape, np.uint8))
    rays = camera.bearing_grid()
    points = rays * seen_in(here, depth)[0][..., None]
    normals = surface_normals(points)
    known = np.isfinite(normals[..., 0])
    z = np.where(known, points[..., 2], 0).astype(np.float32)
    write_map(folder / "stereo" / "depth_maps" / f"{name}.{KIND}.bin", z[..., None])
    write_map(folder / "stereo" / "normal_maps" / f"{name}.{KIND}.bin", np.where(known[..., None], normals, 0))


def surface_normals(points: F64) -> F32:
    """(H, W, 3) metres in a camera -> unit normals that face it, NaN at borders and beside unknown points."""
    normals = np.full(points.shape, np.nan, np.float32)
    along, down = points[1:-1, 2:] - points[1:-1, :-2], points[2:, 1:-1] - points[:-2, 1:-1]
    across = np.cross(along, down)
    with np.errstate(invalid="ignore", divide="ignore"):
        across /= np.linalg.norm(across, axis=-1, keepdims=True)
    toward = (across * points[1:-1, 1:-1]).sum(-1, keepdims=True)
    across[np.isnan(toward[..., 0])] = np.nan  # the middle itself is unknown
    normals[1:-1, 1:-1] = np.where(toward > 0, -across, across)
    return normals


def write_map(path: Path, values: F32) -> None:
    """(H, W, C) as COLMAP's `Mat<float>`."""
    path.parent.mkdir(parents=True, exist_ok=True)
    height, width, channels = values.shape
    data = np.ascontiguousarray(values.transpose(2, 0, 1), "<f4").tobytes()
    path.write_bytes(f"{width}&{height}&{channels}&".encode() + data)


def _undistorted(source: Camera, target: Pinhole, image: U8) -> U8:
    import cv2

    table, fraction, _ = remap_tables(source, target, np.eye(3))
    return np.asarray(cv2.remap(image, table, fraction, cv2.INTER_LINEAR), np.uint8)


def _write_image(path: Path, pixels: U8) -> None:
    from stereo_sfm.pixels import write_image

    path.parent.mkdir(parents=True, exist_ok=True)
    write_image(path, pixels)


def _write_model(saved: SavedMap, chosen: list[int], folder: Path) -> None:
    """The sparse model of the undistorted images: fusion finds overlapping images by the points that they share."""
    part = undistorted_map(saved, chosen)
    (folder / "sparse").mkdir(parents=True, exist_ok=True)
    export_colmap(part, folder / "sparse")
    names = image_names(part, "left")
    (folder / "stereo" / "fusion.cfg").write_text("".join(f"{name}\n" for name in names), encoding="utf-8")
    lines = "".join(f"{name}\n__auto__, {NEIGHBOURS}\n" for name in names)
    (folder / "stereo" / "patch-match.cfg").write_text(lines, encoding="utf-8")


def undistorted_map(saved: SavedMap, chosen: list[int]) -> SavedMap:
    """Some keyframes of a map as their undistorted images show them; without what those do not show."""
    s = saved.snapshot
    cameras = {session: view_camera(camera.rig) for session, camera in saved.cameras.items()}
    keep = np.zeros(len(saved), bool)
    keep[chosen] = True
    uv = np.full(s.uv_left.shape, np.nan)
    for session, camera in cameras.items():
        rows = saved.sessions[s.obs_kf] == session
        uv[rows] = camera.project(saved.cameras[session].rig.left.unproject(s.uv_left[rows]))
        uv[rows] = np.where(camera.inside(uv[rows], 0.0)[:, None], uv[rows], np.nan)
    moved = replace(s, uv_left=uv, uv_right=np.full(uv.shape, np.nan))
    obs = np.isfinite(uv[:, 0]) & keep[s.obs_kf]
    points = np.zeros(len(s.pt_ids), bool)
    points[s.obs_pt[obs]] = True
    rigs = {k: MapCamera(Rig(c, name=saved.cameras[k].rig.name)) for k, c in cameras.items()}
    return SavedMap(subset(moved, keep, points, obs), rigs, saved.vocabulary_id, saved.sessions[keep])
