"""What a reconstruction is written as: mesh and cloud (PLY, GLB, LAS), costmap of map_server, picture from above."""

from __future__ import annotations

import json
import re
import struct
import tempfile
from collections import Counter
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import IO, Any

import numpy as np

from stereo_sfm.dense.build import ROBOT, Bands, Volume
from stereo_sfm.dense.pictures import height_colours, write_mesh_pictures
from stereo_sfm.dense.surface import Numbering, Surface
from stereo_sfm.dense.volume import SIDE
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.export.floor_plan import FREE, OCCUPIED, UNKNOWN, FloorPlan, in_robots_map, write_floor_plan
from stereo_sfm.input_file import read_bytes
from stereo_sfm.maps.floor import HIGH
from stereo_sfm.types import F32, F64, I32, I64, U8

CHUNK = 1 << 17  # vertices or faces in memory at a time
GLB_BYTES = (1 << 32) - 1
LAS_HEADER, LAS_STEP = 227, 0.001  # bytes; metres
LAS_POINT = np.dtype([
    ("xyz", "<i4", 3), ("intensity", "<u2"), ("returns", "u1"), ("class", "u1"), ("angle", "i1"), ("user", "u1"),
    ("source", "<u2"), ("colour", "<u2", 3),
])  # fmt: skip
PLY_VERTEX = np.dtype([("xyz", "<f4", 3), ("colour", "u1", 3)])
PLY_FACE = np.dtype([("n", "u1"), ("i", "<i4", 3)])
FILES = (
    "mesh.ply, mesh.glb, cloud.ply, cloud.las, costmap.png, costmap.yaml, nav2_costmap.pgm, nav2_costmap.yaml, "
    "height.png, mesh_height.png, mesh_grey.png"
)


class Mesh:
    """A mesh too large for memory: its vertices and faces as PLY has them, in two files without names."""

    def __init__(self, folder: Path) -> None:
        self._vertices, self._faces = (tempfile.TemporaryFile(dir=folder) for _ in range(2))  # noqa: SIM115
        self._heights = Counter[int]()  # vertices below `HIGH` by millimetre
        self.vertex_count = self.face_count = 0
        self.area = 0.0  # square metres
        self.low, self.high = np.full(3, np.inf, np.float32), np.full(3, -np.inf, np.float32)  # corners, metres

    def __enter__(self) -> Mesh:
        return self

    def __exit__(self, *_: object) -> None:
        self._vertices.close()
        self._faces.close()

    def add(self, points: F64, grey: U8, triangles: I64) -> None:
        """Points (V, 3) m with grey levels (V,), and triangles (T, 3) by numbers of the whole mesh."""
        vertex, face = np.empty(len(points), PLY_VERTEX), np.empty(len(triangles), PLY_FACE)
        vertex["xyz"], vertex["colour"] = points, grey[:, None]
        face["n"], face["i"] = 3, triangles
        self._vertices.write(vertex.tobytes())
        self._faces.write(face.tobytes())
        self.vertex_count += len(points)
        self.face_count += len(triangles)
        self.low = np.minimum(self.low, vertex["xyz"].min(axis=0, initial=np.inf))
        self.high = np.maximum(self.high, vertex["xyz"].max(axis=0, initial=-np.inf))
        below, count = np.unique(np.rint(1e3 * points[points[:, 2] < HIGH, 2]).astype(int), return_counts=True)
        self._heights.update(dict(zip(below.tolist(), count.tolist(), strict=True)))

    def vertices(self) -> Iterator[Any]:
        """All as `PLY_VERTEX`, some at a time."""
        return _chunks(self._vertices, PLY_VERTEX)

    def faces(self) -> Iterator[Any]:
        """All as `PLY_FACE`, some at a time."""
        return _chunks(self._faces, PLY_FACE)

    def heights(self) -> tuple[float, float]:
        """Quantiles of 2 and 98 % of the vertices' heights below `HIGH`, metres."""
        z = sorted(self._heights)
        share = np.cumsum([self._heights[k] for k in z]) / max(1, self._heights.total())
        low, high = (z[min(int(i), len(z) - 1)] for i in np.searchsorted(share, [0.02, 0.98])) if z else (0, 0)
        return low / 1e3, high / 1e3


def _chunks(file: IO[bytes], kind: Any) -> Iterator[Any]:
    file.seek(0)
    while data := file.read(CHUNK * kind.itemsize):
        yield np.frombuffer(data, kind)


def write_all(volume: Volume, folder: Path, bands: Bands = ROBOT) -> dict[str, float]:
    """Write `FILES`, and a costmap for each further band of heights; returns numbers about them.

    All but Nav2's are in the floor's frame of `costmap.yaml` (`map_T_floor`): metres, z up, z = 0 on the floor. Memory
    does not depend on the number of cubes, apart from the pictures' pixels.
    """
    with joined(volume, folder) as mesh:
        write_mesh_ply(folder / "mesh.ply", mesh)
        write_glb(folder / "mesh.glb", mesh)
        write_cloud_ply(folder / "cloud.ply", mesh)
        write_las(folder / "cloud.las", mesh)
        for number, (plan, (low, high)) in enumerate(zip(costmaps(volume, bands), bands, strict=True)):
            write_floor_plan(plan, folder / ("costmap" if number == 0 else f"costmap_{low:.2f}_{high:.2f}"))
            if number == 0:
                write_heights(folder / "height.png", mesh, plan)
                write_floor_plan(in_robots_map(plan, volume.base_T_left), folder / "nav2_costmap.pgm")
        points = (v["xyz"].astype(np.float64) for v in mesh.vertices())
        write_mesh_pictures(folder, points, _parts_of(volume), mesh.heights())
        return {
            "vertices": mesh.vertex_count, "triangles": mesh.face_count, "square metres": mesh.area,
            "cubes": len(volume.indices),
        }  # fmt: skip


def joined(volume: Volume, folder: Path) -> Mesh:
    """All cubes as one mesh. Args: folder, of its files without names."""
    mesh, numbering = Mesh(folder), Numbering()
    for points, surface, triangles in _parts_of(volume):
        new, numbers = numbering.add(surface)
        mesh.add(points[new], surface.grey[new], numbers[triangles])
        a, b, c = (points[triangles[:, i]] for i in range(3))
        mesh.area += 0.5 * float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())
    return mesh


def _parts_of(volume: Volume) -> Iterator[tuple[F64, Surface, I64]]:
    """Of each cube its points (V, 3) m, its surface, and triangles (T, 3) by its own vertices."""
    for surface in volume.surfaces():
        yield surface.vertices.astype(np.float64) * volume.voxel, surface, surface.triangles()


def _ply_header(mesh: Mesh, *faces: str) -> bytes:
    header = ["ply", "format binary_little_endian 1.0", "comment metres", f"element vertex {mesh.vertex_count}"]
    header += [f"property float {n}" for n in "xyz"] + [f"property uchar {n}" for n in ("red", "green", "blue")]
    return "\n".join([*header, *faces, "end_header", ""]).encode()


def write_mesh_ply(path: Path, mesh: Mesh) -> None:
    """Binary little-endian PLY with colours at the vertices."""
    faces = f"element face {mesh.face_count}", "property list uchar int vertex_indices"
    with path.open("wb") as file:
        file.write(_ply_header(mesh, *faces))
        file.writelines(chunk.tobytes() for chunk in chain(mesh.vertices(), mesh.faces()))


def write_cloud_ply(path: Path, mesh: Mesh) -> None:
    """The vertices alone."""
    with path.open("wb") as file:
        file.write(_ply_header(mesh))
        file.writelines(chunk.tobytes() for chunk in mesh.vertices())


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


def write_glb(path: Path, mesh: Mesh) -> None:
    """Binary glTF 2.0 with colours at the vertices; y up, as it demands. None of more than the 4 GiB that it allows."""
    path.unlink(missing_ok=True)
    sizes = 12 * mesh.vertex_count, 4 * mesh.vertex_count, 12 * mesh.face_count
    at = np.cumsum([0, *sizes]).tolist()
    corners = np.stack([mesh.low, mesh.high]).astype(float) if mesh.vertex_count else np.zeros((2, 3))
    turned = _y_up(corners)
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "stereo-sfm"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "COLOR_0": 1}, "indices": 2, "mode": 4}]}],
        "buffers": [{"byteLength": at[-1]}],
        "bufferViews": [{"buffer": 0, "byteOffset": at[i], "byteLength": sizes[i]} for i in range(3)],
        "accessors": [
            {
                "bufferView": 0, "componentType": 5126, "count": mesh.vertex_count, "type": "VEC3",
                "min": turned.min(axis=0).tolist(), "max": turned.max(axis=0).tolist(),
            },
            {"bufferView": 1, "componentType": 5121, "normalized": True, "count": mesh.vertex_count, "type": "VEC4"},
            {"bufferView": 2, "componentType": 5125, "count": 3 * mesh.face_count, "type": "SCALAR"},
        ],
    }  # fmt: skip
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    if 28 + len(text) + at[-1] > GLB_BYTES:
        return
    with path.open("wb") as file:
        file.write(struct.pack("<4sII", b"glTF", 2, 28 + len(text) + at[-1]))
        file.write(struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", at[-1], b"BIN\0"))
        file.writelines(_y_up(v["xyz"]).astype("<f4").tobytes() for v in mesh.vertices())
        file.writelines(np.insert(v["colour"], 3, 255, axis=1).tobytes() for v in mesh.vertices())
        file.writelines(f["i"].astype("<u4").tobytes() for f in mesh.faces())


def _y_up(xyz: Any) -> Any:
    return np.stack([xyz[:, 0], xyz[:, 2], -xyz[:, 1]], axis=1)


def write_las(path: Path, mesh: Mesh) -> None:
    """LAS 1.2, point format 2 (ASPRS specification of 2008): millimetres as integers, 16 bits a colour."""
    count = mesh.vertex_count
    low, high = (c.astype(np.float64) if count else np.zeros(3) for c in (mesh.low, mesh.high))
    bounds = np.stack([high, low], axis=1).ravel().tolist()  # largest and least x, then y, then z
    header = struct.pack(
        "<4sHHIHH8sBB32s32sHHHIIBHI5I3d3d6d",
        b"LASF", 0, 0, 0, 0, 0, b"", 1, 2, b"stereo-sfm", b"stereo-sfm", 0, 0, LAS_HEADER, LAS_HEADER, 0, 2,
        LAS_POINT.itemsize, count, count, 0, 0, 0, 0, *[LAS_STEP] * 3, *low.tolist(), *bounds,
    )  # fmt: skip
    with path.open("wb") as file:
        file.write(header)
        for vertices in mesh.vertices():
            rows = np.zeros(len(vertices), LAS_POINT)
            rows["xyz"] = np.rint((vertices["xyz"] - low) / LAS_STEP)
            rows["returns"] = 1 | 1 << 3  # the first of one
            rows["colour"] = vertices["colour"].astype(np.uint16) * 257
            file.write(rows.tobytes())


def costmaps(volume: Volume, bands: Bands) -> list[FloorPlan]:
    """Where a robot meets something in each band of heights, one pixel a voxel."""
    columns = np.array(volume.indices)[:, :2]
    low, high = columns.min(axis=0), columns.max(axis=0) + 1
    images: Any = np.full((len(bands), *((high - low) * SIDE).tolist()), UNKNOWN, np.uint8)
    for index, occupied, free in volume.columns(bands):
        x, y = ((np.array(index[:2]) - low) * SIDE).tolist()
        part = images[:, x : x + SIDE, y : y + SIDE]
        part[free & (part == UNKNOWN)] = FREE
        part[occupied] = OCCUPIED
    origin = ((low * SIDE - 0.5) * volume.voxel).tolist()  # a voxel is a place, the middle of its pixel
    place = (origin[0], origin[1]), volume.map_T_floor
    return [FloorPlan(np.ascontiguousarray(image.T[::-1]), volume.voxel, *place) for image in images]


def write_heights(path: Path, mesh: Mesh, plan: FloorPlan) -> None:
    """The surface below `HIGH` (a ceiling would hide all) from above, coloured by height, transparent where unknown.

    Its pixels are those of the costmap `plan`, so that its YAML holds for both.
    """
    from stereo_sfm.pixels import write_image

    height, width = plan.image.shape
    top: F32 = np.full((height, width), -np.inf, np.float32)
    for points in (v["xyz"][v["xyz"][:, 2] < HIGH] for v in mesh.vertices()):
        at = np.floor((points[:, :2] - np.array(plan.origin)) / plan.resolution).astype(np.int64)
        column, row = at.clip(0, (width - 1, height - 1)).T  # some lie beyond by a cell
        np.maximum.at(top, (height - 1 - row, column), points[:, 2])
    known = np.isfinite(top)
    if known.any():
        heights = mesh.heights()
        picture = height_colours(np.where(known, top, heights[0]), heights)
        write_image(path, np.dstack([picture, np.where(known, 255, 0).astype(np.uint8)]))
