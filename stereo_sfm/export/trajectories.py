"""Writers of trajectories in the text formats of TUM, KITTI and EuRoC."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from stereo_sfm.geometry import se3
from stereo_sfm.input_file import first_line
from stereo_sfm.types import F64, I64, Trajectory


def seconds(stamp_ns: int) -> str:
    """Nanoseconds -> decimal seconds, exact."""
    sign = "-" if stamp_ns < 0 else ""
    whole, part = divmod(abs(int(stamp_ns)), 10**9)
    return f"{sign}{whole}.{part:09d}"


def write_tum(path: Path, trajectory: Trajectory, what: str = "world_T_cam0") -> None:
    """`t tx ty tz qx qy qz qw`, seconds and metres; `what` names the pose in the header."""
    lines = [f"# {what}: stamp_s tx ty tz qx qy qz qw"]
    quaternions = se3.quaternion_from_rotation(trajectory.poses[:, :3, :3])
    for stamp, t, q in zip(trajectory.stamp_ns, trajectory.positions, quaternions, strict=True):
        lines.append(seconds(int(stamp)) + "".join(f" {v:.9f}" for v in (*t, *q)))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def named_pose(path: Path, otherwise: str = "world_T_cam0") -> str:
    """The name of the poses in the header of a trajectory file, "world_T_cam0" or "world_T_body".

    `otherwise` for files of other programs without such a header.
    """
    found = re.match(r"#.*\b(world_T_(?:cam0|body))\b", first_line(path))
    return found[1] if found else otherwise


def write_kitti(path: Path, poses: F64) -> None:
    """Twelve numbers per line for each pose of (N, 4, 4), relative to the first."""
    relative = se3.inverse(poses[0]) @ poses if len(poses) else poses
    rows = relative[:, :3, :].reshape(-1, 12)
    path.write_text("".join(" ".join(f"{v:.9e}" for v in row) + "\n" for row in rows), encoding="utf-8")


def write_euroc(path: Path, trajectory: Trajectory, what: str = "world_T_cam0") -> None:
    """`t_ns,x,y,z,qw,qx,qy,qz`."""
    lines = [f"#timestamp [ns],p_x [m],p_y [m],p_z [m],q_w [],q_x [],q_y [],q_z [] ({what})"]
    quaternions = se3.quaternion_from_rotation(trajectory.poses[:, :3, :3])[:, [3, 0, 1, 2]]
    for stamp, t, q in zip(trajectory.stamp_ns, trajectory.positions, quaternions, strict=True):
        lines.append(f"{int(stamp)}" + "".join(f",{v:.9f}" for v in (*t, *q)))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def fill_missing(frame_ids: I64, poses: F64, step: int = 1) -> F64:
    """One pose for every frame id from the first to the last, for formats without stamps.

    Args:
        frame_ids: (N,) ascending.
        poses: (N, 4, 4).
        step: difference of consecutive ids (3 if every third frame of a source was used).

    Returns:
        (M, 4, 4): missing poses are interpolated on the geodesic between their neighbours.
    """
    if not len(frame_ids):
        return poses
    wanted = np.arange(frame_ids[0], frame_ids[-1] + 1, step)
    after = np.searchsorted(frame_ids, wanted)
    before = np.where(frame_ids[after] == wanted, after, after - 1)
    gap = np.maximum(frame_ids[after] - frame_ids[before], 1)
    return se3.interpolate(poses[before], poses[after], (wanted - frame_ids[before]) / gap)
