"""A surface of `dense` in the viewer: the mesh in two colours, lit by its normals."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from stereo_sfm.cli import main
from stereo_sfm.dense.files import Mesh, write_mesh_ply
from stereo_sfm.viz.surface import TABS, show_surface, vertex_normals
from tests.viz.test_sink import Recording

POINTS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 2]], np.float32)
TRIANGLES = np.array([[0, 1, 2]], np.int32)
GREY = np.full((4, 3), 90, np.uint8)


def test_both_colours_are_shown() -> None:
    recording = Recording()
    show_surface(recording, POINTS, GREY, TRIANGLES)  # pyright: ignore[reportArgumentType]
    height, grey = (recording.of(entity)[-1] for entity, _ in TABS)
    assert len(set(grey.vertex_colors.as_arrow_array().to_pylist())) == 1
    assert len(set(height.vertex_colors.as_arrow_array().to_pylist())) == 2, "the floor, and what stands above it"
    np.testing.assert_array_equal(vertex_normals(POINTS, TRIANGLES), [[0, 0, 1]] * 3 + [[0, 0, 0]])


def test_the_command_takes_the_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "mesh.rrd"
    assert main(["viz", str(tmp_path), "--save", str(out)]) != 0
    assert "no surface" in capsys.readouterr().err
    with Mesh(tmp_path) as mesh:
        mesh.add(POINTS.astype(float), GREY[:, 0], TRIANGLES.astype(np.int64))
        write_mesh_ply(tmp_path / "mesh.ply", mesh)
    assert main(["viz", str(tmp_path), "--save", str(out)]) == 0
    assert out.stat().st_size > 1000
