"""Point clouds as binary little-endian PLY, with scalar fields for CloudCompare and MeshLab."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from stereo_sfm.maps.saved_map import SavedMap
from stereo_sfm.types import F64, U8


def write_ply(path: Path, points: F64, colours: U8 | None = None, scalars: dict[str, F64] | None = None) -> None:
    """(N, 3) metres, (N, 3) red green blue, and named values (N,) that become `scalar_NAME`."""
    names = ["x", "y", "z"]
    columns = [points[:, 0], points[:, 1], points[:, 2]]
    kinds = ["<f4"] * 3
    if colours is not None:
        names += ["red", "green", "blue"]
        columns += [colours[:, 0], colours[:, 1], colours[:, 2]]
        kinds += ["u1"] * 3
    for name, values in (scalars or {}).items():
        names.append(f"scalar_{name}")
        columns.append(values)
        kinds.append("<f4")
    table = np.empty(len(points), dtype=list(zip(names, kinds, strict=True)))
    for name, column in zip(names, columns, strict=True):
        table[name] = column
    header = ["ply", "format binary_little_endian 1.0", "comment metres", f"element vertex {len(points)}"]
    header += [f"property {'uchar' if k == 'u1' else 'float'} {n}" for n, k in zip(names, kinds, strict=True)]
    path.write_bytes("\n".join([*header, "end_header", ""]).encode() + table.tobytes())


def export_ply(saved: SavedMap, path: Path) -> None:
    """The points of a map, coloured from red (seen by two keyframes) to blue (seen by many)."""
    s = saved.snapshot
    views = np.bincount(s.obs_pt, minlength=len(s.pt_ids)).astype(float)
    share = np.clip((views - 2) / 8, 0, 1)
    colours = np.stack([255 * (1 - share), 80 + 0 * share, 255 * share], axis=1).astype(np.uint8)
    session = np.zeros(len(s.pt_ids))
    np.maximum.at(session, s.obs_pt, saved.sessions[s.obs_kf].astype(float))
    write_ply(path, s.points, colours, {"views": views, "session": session})
