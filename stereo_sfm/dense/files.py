"""What a reconstruction is written as: mesh and cloud (PLY, GLB), costmap of map_server, picture from above."""

from __future__ import annotations

import json
import re
import struct
from pathlib import Path
from typing import Any

import numpy as np

from stereo_sfm.dense.build import ROBOT, Bands, CubeResult
from stereo_sfm.dense.pictures import write_mesh_pictures
from stereo_sfm.dense.surface import joined
from stereo_sfm.dense.volume import SIDE
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.export.floor_plan import FREE, OCCUPIED, UNKNOWN, FloorPlan, write_floor_plan
from stereo_sfm.export.ply import write_ply
from stereo_sfm.input_file import read_bytes
from stereo_sfm.maps.floor import HIGH
from stereo_sfm.types import F32, F64, I32, I64, U8

LAS_HEADER, LAS_STEP = 227, 0.001  # bytes; metres
LAS_POINT = np.dtype([
    ("xyz", "<i4", 3), ("intensity", "<u2"), ("returns", "u1"), ("class", "u1"), ("angle", "i1"), ("user", "u1"),
    ("source", "<u2"), ("colour", "<u2", 3),
])  # fmt: skip
PLY_VERTEX = np.dtype([("xyz", "<f4", 3), ("colour", "u1", 3)])
PLY_FACE = np.dtype([("n", "u1"), ("i", "<i4", 3)])
FILES = (
    "mesh.ply, mesh.glb, cloud.ply, cloud.las, costmap.png, costmap.yaml, height.png, mesh_height.png, mesh_grey.png"
)


def write_all(
    results: list[CubeResult], folder: Path, voxel: float, map_T_floor: F64, bands: Bands = ROBOT
) -> dict[str, float]:
    """Write `FILES`, and a costmap for each further band of heights; returns numbers about them.

    All are in the floor's frame of `costmap.yaml` (`map_T_floor`): metres, z up, z = 0 on the floor.
    """
    vertices, grey, triangles = joined([r.surface for r in results])
    points = vertices.astype(np.float64) * voxel
    colours = np.repeat(grey[:, None], 3, axis=1)
    write_mesh_ply(folder / "mesh.ply", points, colours, triangles)
    write_glb(folder / "mesh.glb", points, colours, triangles)
    write_ply(folder / "cloud.ply", points, colours)
    write_las(folder / "cloud.las", points, colours)
    for number, (low, high) in enumerate(bands):
        name = "costmap" if number == 0 else f"costmap_{low:.2f}_{high:.2f}"
        plan = costmap(results, voxel, map_T_floor, number)
        write_floor_plan(plan, folder / name)
        if number == 0:
            write_heights(folder / "height.png", points, plan)
    write_mesh_pictures(folder, points, grey, triangles)
    area = 0.0
    if len(triangles):
        a, b, c = (points[triangles[:, i]] for i in range(3))
        area = 0.5 * float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())
    return {"vertices": len(points), "triangles": len(triangles), "square metres": area, "cubes": len(results)}


def write_mesh_ply(path: Path, points: F64, colours: U8, triangles: I64) -> None:
    """Binary little-endian PLY with colours at the vertices."""
    vertex = np.empty(len(points), PLY_VERTEX)
    vertex["xyz"], vertex["colour"] = points, colours
    face = np.empty(len(triangles), PLY_FACE)
    face["n"], face["i"] = 3, triangles
    header = ["ply", "format binary_little_endian 1.0", "comment metres", f"element vertex {len(points)}"]
    header += [f"property float {n}" for n in "xyz"] + [f"property uchar {n}" for n in ("red", "green", "blue")]
    header += [f"element face {len(triangles)}", "property list uchar int vertex_indices", "end_header", ""]
    path.write_bytes("\n".join(header).encode() + vertex.tobytes() + face.tobytes())


def read_mesh(path: Path) -> tuple[F32, U8, I32]:
    """Points (V, 3) m, colours (V, 3) and triangles (T, 3) of a file of `write_mesh_ply`.

    Raises:
        StereoSfmError: another file, or a damaged one.
    """
    head, _, body = read_bytes(path).partition(b"end_header\n")
    counts = [int(n) for n in re.findall(rb"element (?:vertex|face) (\d{1,10})\n", head)]
    sizes = [n * kind.itemsize for n, kind in zip(counts, (PLY_VERTEX, PLY_FACE), strict=False)]
    if len(counts) != 2 or len(body) != sum(sizes):
        raise StereoSfmError(f"{path} is no mesh of 'stereo-sfm dense', or is incomplete")
    vertex = np.frombuffer(body, PLY_VERTEX, counts[0])
    triangles = np.frombuffer(body, PLY_FACE, counts[1], sizes[0])["i"]
    if len(triangles) and not 0 <= triangles.min() <= triangles.max() < counts[0]:
        raise StereoSfmError(f"{path}: triangles of points that it lacks")
    return vertex["xyz"], vertex["colour"], triangles


def write_glb(path: Path, points: F64, colours: U8, triangles: I64) -> None:
    """Binary glTF 2.0 with colours at the vertices; y up, as it demands."""
    xyz = np.stack([points[:, 0], points[:, 2], -points[:, 1]], axis=1).astype("<f4")
    rgba = np.concatenate([colours, np.full((len(colours), 1), 255, np.uint8)], axis=1)
    parts = [xyz.tobytes(), rgba.tobytes(), triangles.astype("<u4").tobytes()]
    at = np.cumsum([0, *map(len, parts)]).tolist()
    low, high = (xyz.min(0), xyz.max(0)) if len(xyz) else (np.zeros(3), np.zeros(3))
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "stereo-sfm"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "COLOR_0": 1}, "indices": 2, "mode": 4}]}],
        "buffers": [{"byteLength": at[-1]}],
        "bufferViews": [{"buffer": 0, "byteOffset": at[i], "byteLength": len(parts[i])} for i in range(3)],
        "accessors": [
            {
                "bufferView": 0, "componentType": 5126, "count": len(xyz), "type": "VEC3",
                "min": low.tolist(), "max": high.tolist(),
            },
            {"bufferView": 1, "componentType": 5121, "normalized": True, "count": len(xyz), "type": "VEC4"},
            {"bufferView": 2, "componentType": 5125, "count": 3 * len(triangles), "type": "SCALAR"},
        ],
    }  # fmt: skip
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    data = b"".join(parts)
    head = struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(data))
    path.write_bytes(
        head + struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
    )


def write_las(path: Path, points: F64, colours: U8) -> None:
    """LAS 1.2, point format 2 (ASPRS specification of 2008): millimetres as integers, 16 bits a colour."""
    rows = np.zeros(len(points), LAS_POINT)
    low, high = (points.min(0), points.max(0)) if len(points) else (np.zeros(3), np.zeros(3))
    rows["xyz"] = np.rint((points - low) / LAS_STEP)
    rows["returns"] = 1 | 1 << 3  # the first of one
    rows["colour"] = colours.astype(np.uint16) * 257
    bounds = np.stack([high, low], axis=1).ravel().tolist()  # largest and least x, then y, then z
    header = struct.pack(
        "<4sHHIHH8sBB32s32sHHHIIBHI5I3d3d6d",
        b"LASF", 0, 0, 0, 0, 0, b"", 1, 2, b"stereo-sfm", b"stereo-sfm", 0, 0, LAS_HEADER, LAS_HEADER, 0, 2,
        rows.itemsize, len(rows), len(rows), 0, 0, 0, 0, *[LAS_STEP] * 3, *low.tolist(), *bounds,
    )  # fmt: skip
    path.write_bytes(header + rows.tobytes())


def costmap(results: list[CubeResult], voxel: float, map_T_floor: F64, band: int = 0) -> FloorPlan:
    """Where a robot meets something in a band of heights, one pixel a voxel."""
    columns = np.array([r.index[:2] for r in results])
    low, high = columns.min(axis=0), columns.max(axis=0) + 1
    shape = ((high - low) * SIDE).tolist()
    occupied, free = np.zeros(shape, bool), np.zeros(shape, bool)
    for r in results:
        x, y = ((np.array(r.index[:2]) - low) * SIDE).tolist()
        occupied[x : x + SIDE, y : y + SIDE] |= r.occupied[band]
        free[x : x + SIDE, y : y + SIDE] |= r.free[band]
    image = np.full(shape, UNKNOWN, np.uint8)
    image[free] = FREE
    image[occupied] = OCCUPIED
    origin = (low * SIDE * voxel).tolist()
    return FloorPlan(np.ascontiguousarray(image.T[::-1]), voxel, (origin[0], origin[1]), map_T_floor)


def write_heights(path: Path, points: F64, plan: FloorPlan) -> None:
    """The surface below `HIGH` (a ceiling would hide all) from above, coloured by height, transparent where unknown.

    Its pixels are those of the costmap `plan`, so that its YAML holds for both.
    """
    import cv2

    points = points[points[:, 2] < HIGH]
    if not len(points):
        return
    height, width = plan.image.shape
    at = np.floor((points[:, :2] - plan.origin) / plan.resolution).astype(np.int64)
    column, row = at[:, 0].clip(0, width - 1), height - 1 - at[:, 1].clip(0, height - 1)  # some lie beyond by a cell
    top: F32 = np.full((height, width), -np.inf, np.float32)
    np.maximum.at(top, (row, column), points[:, 2].astype(np.float32))
    least, most = np.quantile(points[:, 2], [0.02, 0.98])
    share = np.clip((np.where(np.isfinite(top), top, least) - least) / max(most - least, 1e-3), 0, 1)
    picture = cv2.applyColorMap((255 * share).astype(np.uint8), cv2.COLORMAP_TURBO)
    cv2.imwrite(str(path), np.dstack([picture, np.where(np.isfinite(top), 255, 0).astype(np.uint8)]))
