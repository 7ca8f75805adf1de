"""Open3D's voxel block grid beside the volume here: the same depth images, voxels and limit of standard deviations.

    PYTHON benchmarks/_dense_open3d.py IN.npz OUT.npz VOXEL TRUNCATION      by an interpreter that has Open3D

It takes the steps of Open3D's example of a reconstruction from images and poses, without colour. IN: `depth` (N, H, W)
metres along the axis, 0 where unknown; `view_T_floor` (N, 4, 4); `intrinsics` (3, 3). OUT: `vertices` (V, 3) metres of
what two images saw, `seconds` of processor time, `gigabytes` of memory at most.
"""

from __future__ import annotations

import resource
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

BLOCK_VOXELS = 16  # a side; Open3D's example has the same


def beside(python: Path, seen: Any, voxel: float, folder: Path) -> Any:
    """What OUT holds. Args: python, the interpreter. seen: `Seen` of pinhole depth images. folder: of both files."""
    from stereo_sfm.dense.volume import TRUNCATION
    from stereo_sfm.geometry import se3

    depth, poses = [], []
    for one in seen:
        along = one.depth.ranges * one.depth.camera.bearing_grid()[..., 2]
        depth.append(np.where(one.used(voxel), np.nan_to_num(along), 0).astype(np.float32))
        turned = se3.from_rotation_translation(one.depth.cam_R_view, np.zeros(3))
        poses.append(se3.inverse(one.floor_T_cam @ turned))
    given, made = folder / "open3d_in.npz", folder / "open3d_out.npz"
    np.savez(given, depth=depth, view_T_floor=poses, intrinsics=seen[0].depth.camera.matrix)
    subprocess.run([str(python), __file__, str(given), str(made), f"{voxel!r}", str(TRUNCATION)], check=True)
    with np.load(made) as data:
        return dict(data)


def main(given: str, made: str, voxel: float, truncation: float) -> None:
    """By the other interpreter."""
    import open3d as o3d  # pyright: ignore[reportMissingImports]

    core, cpu = o3d.core, o3d.core.Device("CPU:0")
    data = np.load(given)
    depths, intrinsics, farthest = list(data["depth"]), core.Tensor(data["intrinsics"]), float(data["depth"].max())
    began = time.process_time()
    grid = o3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight"), (core.float32, core.float32), ((1), (1)), voxel, BLOCK_VOXELS, 4000, cpu
    )  # grows by itself beyond 4000 blocks
    for depth, pose in zip(depths, data["view_T_floor"], strict=True):
        image, place = o3d.t.geometry.Image(core.Tensor(depth)), core.Tensor(pose)
        blocks = grid.compute_unique_block_coordinates(image, intrinsics, place, 1.0, farthest, truncation)
        grid.integrate(blocks, image, intrinsics, place, 1.0, farthest, truncation)
    vertices = grid.extract_triangle_mesh(2.0, -1).vertex.positions.numpy()
    seconds, most = time.process_time() - began, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    np.savez(made, vertices=vertices, seconds=seconds, gigabytes=most)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], float(sys.argv[3]), float(sys.argv[4]))
