"""A surface of `stereo-sfm dense` in rerun."""

from __future__ import annotations

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from stereo_sfm.types import F32, I32, U8
from stereo_sfm.viz.blueprint import BACKGROUND, GRID
from stereo_sfm.viz.shapes import spread_colors

TABS = (("mesh/height", "by height, low blue, high red"), ("mesh/grey", "by the images' grey levels"))


def surface_blueprint(name: str) -> rrb.Blueprint:
    """The mesh in both colours, in tabs."""
    grid = rrb.LineGrid3D(color=GRID, stroke_width=0.6)
    background = rrb.Background(color=BACKGROUND)
    views = [
        rrb.Spatial3DView(origin=origin, name=f"{name} {text}", background=background, line_grid=grid)
        for origin, text in TABS
    ]
    return rrb.Blueprint(rrb.Tabs(*views), collapse_panels=True)


def show_surface(recording: rr.RecordingStream, points: F32, colours: U8, triangles: I32) -> None:
    """Send a mesh. Args: points (V, 3) m, z up; colours (V, 3); triangles (T, 3) counter-clockwise from before."""
    normals = vertex_normals(points, triangles)
    for (entity, _), shown in zip(TABS, (spread_colors(points[:, 2].astype(float)), colours), strict=True):
        recording.log(entity, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        mesh = rr.Mesh3D(
            vertex_positions=points, triangle_indices=triangles, vertex_colors=shown, vertex_normals=normals
        )
        recording.log(entity, mesh, static=True)


def vertex_normals(points: F32, triangles: I32) -> F32:
    """(V, 3) means of the normals around each vertex, weighed by area."""
    a, b, c = (points[triangles[:, k]] for k in range(3))
    faces, corners = np.repeat(np.cross(b - a, c - a), 3, axis=0), triangles.ravel()
    total = np.stack([np.bincount(corners, faces[:, k], len(points)) for k in range(3)], axis=1)
    return (total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12)).astype(np.float32)
