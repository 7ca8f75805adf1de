"""Readers of trajectory files: TUM, KITTI and EuRoC/ASL text. For reference poses and estimates."""

from __future__ import annotations

import re
from decimal import Decimal
from pathlib import Path

import numpy as np

from stereo_sfm.calib.formats.common import read_yaml, reading, rigid
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.input_file import first_line, read_text
from stereo_sfm.types import F64, I64, Trajectory

# Columns of the quaternion's x y z w, after the stamp and the position.
_XYZW = (0, 1, 2, 3)
_WXYZ = (1, 2, 3, 0)
POSITION = 4  # fields of a row with a stamp and a position only
FARTHEST = 1e9  # metres from the origin: no coordinates on this planet are as large, and their squares are numbers


def stamp_from_seconds(text: str) -> int:
    """Decimal seconds as text -> integer nanoseconds, exact (a float64 resolves only about 200 ns of Unix time).

    Raises:
        ValueError: not a number.
    """
    try:
        stamp_ns = int(Decimal(text).scaleb(9).to_integral_value())
    except (ArithmeticError, ValueError):
        raise ValueError(f"'{text}' is not a time in seconds") from None
    return _in_range(stamp_ns, text, "seconds")


def _in_range(stamp_ns: int, text: str, unit: str) -> int:
    """Raises ValueError for a stamp that has no place in 64 bits."""
    if abs(stamp_ns) >= 2**62:
        raise ValueError(f"'{text[:30]}' is too large for a time in {unit}")
    return stamp_ns


def _rows(path: Path, least: int, alone: bool = False) -> list[list[str]]:
    """Rows of a text table, separated by commas or blanks, without comments and headers.

    `alone`: rows may have a stamp and a position without a quaternion, if all rows do.
    """
    try:
        lines = read_text(path).splitlines()
    except FileNotFoundError:
        raise StereoSfmError(f"no trajectory at {path}") from None
    except (UnicodeDecodeError, IsADirectoryError):
        raise StereoSfmError(f"{path} is not a trajectory in text form") from None
    rows: list[list[str]] = []
    for number, line in enumerate(lines, 1):
        fields = line.replace(",", " ").split()
        if not fields or line.lstrip().startswith("#") or (number == 1 and fields[0][0].isalpha()):
            continue
        if alone and not rows and len(fields) == POSITION:
            least = POSITION
        if len(fields) < least:
            raise StereoSfmError(f"{path} line {number}: {len(fields)} fields, at least {least} expected")
        rows.append(fields[:POSITION] if least == POSITION else fields)
    if not rows:
        raise StereoSfmError(f"{path} contains no poses")
    return rows


def _trajectory(path: Path, stamps: list[int], values: list[list[str]], order: tuple[int, ...]) -> Trajectory:
    try:
        table = np.array(values, float)
    except ValueError as error:
        raise StereoSfmError(f"{path}: {error}") from None
    _check_range(path, table)
    oriented = table.shape[1] == 7 and not _never_turns(table[:, 3:][:, list(order)])
    keep = np.isfinite(table).all(axis=1)
    if oriented:
        keep &= np.linalg.norm(table[:, 3:], axis=1) > 0.5
    if not keep.any():
        raise StereoSfmError(f"{path} contains no finite pose")
    stamp_ns: I64 = np.array(stamps, np.int64)[keep]
    table = table[keep]
    ascending, first = np.unique(stamp_ns, return_index=True)
    rotation = np.broadcast_to(np.eye(3), (len(first), 3, 3))
    if oriented:
        rotation = se3.rotation_from_quaternion(table[first, 3:][:, list(order)])
    return Trajectory(ascending, se3.from_rotation_translation(rotation, table[first, :3]), oriented)


def _check_range(path: Path, values: F64) -> None:
    """Raises StereoSfmError for numbers that are in no pose; those that are none are left to others."""
    if (np.abs(values[np.isfinite(values)]) > FARTHEST).any():
        raise StereoSfmError(f"{path}: a pose has a number beyond {FARTHEST:g}")


def _never_turns(xyzw: F64) -> bool:
    """Whether quaternions (N, 4) are placeholders of a file with positions only: all 0, or all identity."""
    return len(xyzw) > 1 and bool((xyzw[:, :3] == 0).all() and (xyzw[:, 3] == xyzw[0, 3]).all())


def _order(path: Path, otherwise: tuple[int, ...]) -> tuple[int, ...]:
    """Where x y z w of the quaternion stand, by the names of the columns in the first line if it has them.

    Raises:
        StereoSfmError: the columns are angles.
    """
    names = _names(path)
    quaternion = r"(?:\bq(?:u[a-z]*)?(?:_[a-z]*)?|\b(?:rotation|orientation|rot)(?:_[a-z]*)*)[_. ]?([xyzw])$"
    found = [re.search(quaternion, name) for name in names]
    axes = "".join(match[1] for match in found if match)
    if not axes and {"roll", "pitch", "yaw"} <= {*names}:
        raise StereoSfmError(f"{path} has angles instead of quaternions: write it in the TUM format")
    return tuple(map(axes.index, "xyzw")) if sorted(axes) == [*"wxyz"] else otherwise


def _names(path: Path) -> list[str]:
    """The cells of the first line in lower case, without units."""
    line = first_line(path).strip().lstrip("#").lower()
    line = re.sub(r"\[[^]]*\]|\([^)]*\)", "", line)
    return [cell.strip() for cell in (line.split(",") if "," in line else line.split())]


def read_tum(path: Path) -> Trajectory:
    """`t tx ty tz qx qy qz qw`, seconds and metres; without a quaternion only positions."""
    rows = _rows(path, 8, alone=True)
    try:
        stamps = [stamp_from_seconds(r[0]) for r in rows]
    except ValueError as error:
        raise StereoSfmError(f"{path}: {error}") from None
    return _trajectory(path, stamps, [r[1:8] for r in rows], _order(path, _XYZW))


def _read_two_stamps(path: Path) -> Trajectory:
    """`s ns tx ty tz qx qy qz qw`: whole seconds and the nanoseconds after them."""
    rows = _rows(path, 9)
    try:
        stamps = [_in_range(int(r[0]) * 10**9 + int(r[1]), r[0], "seconds") for r in rows]
    except ValueError as error:
        raise StereoSfmError(f"{path}: {error}") from None
    return _trajectory(path, stamps, [r[2:9] for r in rows], _order(path, _XYZW))


def read_euroc(path: Path) -> Trajectory:
    """`t_ns, x, y, z, qw, qx, qy, qz, ...`: `state_groundtruth_estimate0`, `mocap0`, `vicon0` (the sensor's poses).

    Without a quaternion, as in `leica0`, only positions. The first line may name its columns in another order.
    """
    rows = _rows(path, 8, alone=True)
    try:
        stamps = [_in_range(int(r[0]), r[0], "nanoseconds") for r in rows]
    except ValueError as error:
        raise StereoSfmError(f"{path}: {error}") from None
    return _trajectory(path, stamps, [r[1:8] for r in rows], _order(path, _WXYZ))


def of_body(path: Path, poses: Trajectory) -> Trajectory:
    """world_T_body of a sensor's poses in an ASL folder, by `T_BS` in the sensor.yaml beside them, if there is one.

    Raises:
        StereoSfmError: sensor.yaml is malformed.
    """
    file = path.with_name("sensor.yaml")
    if not poses.oriented or not file.is_file():
        return poses
    with reading(file, "EuRoC"):
        about = read_yaml(file)
        return moved(poses, se3.inverse(rigid(about["T_BS"]["data"]))) if "T_BS" in about else poses


def read_kitti(path: Path, stamp_ns: I64 | None = None) -> Trajectory:
    """Twelve numbers per line, the (3, 4) rows of world_T_cam0.

    Args:
        path: the file.
        stamp_ns: (N,) stamps of the lines, as the format has none. Longer or shorter ones are cut to the common part;
            without them line i is stamped i seconds.
    """
    rows = _rows(path, 12)
    try:
        matrices: F64 = np.array([r[:12] for r in rows], float).reshape(-1, 3, 4)
    except ValueError as error:
        raise StereoSfmError(f"{path}: {error}") from None
    if not np.isfinite(matrices).all():
        raise StereoSfmError(f"{path}: pose {int(np.flatnonzero(~np.isfinite(matrices).all((1, 2)))[0])} is not finite")
    _check_range(path, matrices)
    stamps = np.arange(len(rows), dtype=np.int64) * 10**9 if stamp_ns is None else np.asarray(stamp_ns, np.int64)
    count = min(len(stamps), len(rows))
    poses = se3.from_rotation_translation(matrices[:count, :, :3], matrices[:count, :, 3])
    return Trajectory(stamps[:count], se3.orthonormalize(poses))


def has_stamps(path: Path | str) -> bool:
    """Whether a trajectory file has stamps: KITTI's does not."""
    return len(_rows(Path(path).expanduser(), 8, alone=True)[0]) != 12


def read_trajectory(path: Path | str) -> Trajectory:
    """Read a trajectory in any of the three formats.

    Raises:
        StereoSfmError: no such file, or not a trajectory.
    """
    path = Path(path).expanduser()
    if not has_stamps(path):
        return read_kitti(path)
    if [name.rstrip("s") for name in _names(path)[:2]] == ["sec", "nsec"]:
        return _read_two_stamps(path)
    first = _rows(path, 8, alone=True)[0]
    in_ns = len(first[0]) >= 15 or "[ns]" in first_line(path)  # whose clock began at its start
    return read_euroc(path) if first[0].isdigit() and in_ns else read_tum(path)


def moved(trajectory: Trajectory, a_T_b: F64) -> Trajectory:
    """world_T_a -> world_T_b by the constant (4, 4) `a_T_b` between two frames of one rigid body."""
    return Trajectory(trajectory.stamp_ns.copy(), trajectory.poses @ a_T_b, trajectory.oriented)
