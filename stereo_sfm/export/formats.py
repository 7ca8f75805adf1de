"""Export a map or trajectory by the name of the format."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from stereo_sfm.errors import StereoSfmError, did_you_mean
from stereo_sfm.input_file import refuse_pipe

if TYPE_CHECKING:
    from stereo_sfm.maps.saved_map import SavedMap
    from stereo_sfm.types import Trajectory

# format -> name of what is written by default
MAP_FORMATS = {"colmap": "model", "ply": "points.ply", "g2o": "pose_graph.g2o", "floor-plan": "floor_plan.png"}
TRAJECTORY_FORMATS = ("tum", "kitti", "euroc")


def export_map(saved: SavedMap, path: str | Path, format: str, resolution_m: float = 0.05) -> None:
    """Write a map in the format of another program; existing files are replaced.

    Args:
        saved: from `System.saved_map()` or `load_map(...)`.
        path: a file, or a folder for colmap.
        format: one of `MAP_FORMATS`.
        resolution_m: of the floor plan, metres per pixel.

    Raises:
        StereoSfmError: unknown format.
    """
    from stereo_sfm.export.colmap import export_colmap
    from stereo_sfm.export.floor_plan import export_floor_plan
    from stereo_sfm.export.g2o import export_g2o
    from stereo_sfm.export.ply import export_ply

    _check(format, tuple(MAP_FORMATS), "map")
    path = _ready(path)
    if format == "floor-plan":
        export_floor_plan(saved, path, resolution_m)
    elif format == "colmap":
        export_colmap(saved, path)
    else:
        (export_ply if format == "ply" else export_g2o)(saved, path)


def export_trajectory(
    trajectory: Trajectory, path: str | Path, format: str = "tum", what: str = "world_T_cam0"
) -> None:
    """Write a trajectory file for other programs; an existing file is replaced.

    Args:
        trajectory: from `System.trajectory()`, `read_trajectory(...)`, ...
        format: one of `TRAJECTORY_FORMATS`.
        what: meaning of the poses, for the header of the file.

    Raises:
        StereoSfmError: unknown format.
    """
    from stereo_sfm.export import trajectories

    _check(format, TRAJECTORY_FORMATS, "trajectory")
    path = _ready(path)
    if format == "kitti":
        trajectories.write_kitti(path, trajectory.poses)
    else:
        (trajectories.write_tum if format == "tum" else trajectories.write_euroc)(path, trajectory, what)


def _check(format: str, known: Sequence[str], kind: str) -> None:
    if format not in known:
        near = did_you_mean(format, known)
        raise StereoSfmError(f"unknown {kind} format '{format}'{near}: choose one of {', '.join(known)}")


def _ready(path: str | Path) -> Path:
    path = Path(path).expanduser()
    path.parent.mkdir(parents=True, exist_ok=True)
    refuse_pipe(path)
    return path
