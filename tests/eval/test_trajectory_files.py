from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from evo.tools import file_interface

from stereo_sfm.drivers.ground_truth import read_euroc, read_kitti, read_trajectory, read_tum, stamp_from_seconds
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.eval.evaluate import evaluate, table
from stereo_sfm.export.trajectories import fill_missing, seconds, write_euroc, write_kitti, write_tum
from stereo_sfm.geometry import se3
from stereo_sfm.types import Trajectory


@pytest.fixture
def trajectory() -> Trajectory:
    rng = np.random.default_rng(3)
    stamps = 1_553_180_224_360_915_899 + np.arange(20, dtype=np.int64) * 33_333_337
    return Trajectory(stamps, se3.exp(rng.normal(size=(20, 6))))


def test_tum_keeps_every_nanosecond_and_evo_reads_it(trajectory: Trajectory, tmp_path: Path) -> None:
    path = tmp_path / "t.tum"
    write_tum(path, trajectory)
    for read in (read_tum(path), read_trajectory(path)):
        assert read.stamp_ns.tolist() == trajectory.stamp_ns.tolist()
        assert read.poses == pytest.approx(trajectory.poses, abs=1e-8)
    assert np.array(file_interface.read_tum_trajectory_file(path).poses_se3) == pytest.approx(
        trajectory.poses, abs=1e-8
    )


@pytest.mark.parametrize("begin_ns", [0, 1_553_180_224_360_915_899])
def test_euroc_round_trip_and_evo(begin_ns: int, trajectory: Trajectory, tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    trajectory = Trajectory(trajectory.stamp_ns - trajectory.stamp_ns[0] + begin_ns, trajectory.poses)
    write_euroc(path, trajectory)
    for read in (read_euroc(path), read_trajectory(path)):
        assert read.stamp_ns.tolist() == trajectory.stamp_ns.tolist()
        assert read.poses == pytest.approx(trajectory.poses, abs=1e-8)
    assert np.array(file_interface.read_euroc_csv_trajectory(path).poses_se3) == pytest.approx(
        trajectory.poses, abs=1e-8
    )


def test_kitti_is_relative_to_the_first_pose_and_evo_reads_it(trajectory: Trajectory, tmp_path: Path) -> None:
    path = tmp_path / "t.txt"
    write_kitti(path, trajectory.poses)
    expected = se3.inverse(trajectory.poses[0]) @ trajectory.poses
    assert read_kitti(path, trajectory.stamp_ns).poses == pytest.approx(expected, abs=1e-8)
    assert read_trajectory(path).poses == pytest.approx(expected, abs=1e-8)
    assert np.array(file_interface.read_kitti_poses_file(path).poses_se3) == pytest.approx(expected, abs=1e-8)


def test_seconds_are_exact_in_both_directions() -> None:
    for stamp in (0, 1, 1_553_180_224_360_915_899, 999_999_999, -1_500_000_000):
        assert stamp_from_seconds(seconds(stamp)) == stamp
    assert stamp_from_seconds("1.037359e-01") == 103_735_900
    with pytest.raises(ValueError, match="not a time"):
        stamp_from_seconds("yesterday")


def test_missing_frames_are_filled_on_the_geodesic() -> None:
    poses = se3.exp(np.outer([0, 1, 4, 5], [0.1, 0, 0.5, 0, 0.1, 0]))
    filled = fill_missing(np.array([10, 11, 14, 15]), poses)
    assert filled == pytest.approx(se3.exp(np.outer(np.arange(6), [0.1, 0, 0.5, 0, 0.1, 0])), abs=1e-12)
    assert len(fill_missing(np.array([0, 3, 9]), poses[:3], step=3)) == 4


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "contains no poses"),
        ("1 2 3\n", "line 1: 3 fields"),
        ("1 0 0 0 0 0 0 one\n", "one"),
        ("1 0 0 0 0 0 0 0\n", "no finite pose"),
        ("now 0 0 0 0 0 0 1\nthen 0 0 0 0 0 0 1\n", "not a time"),
    ],
)
def test_malformed_files_are_one_line(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "bad.tum"
    path.write_text(text)
    with pytest.raises(StereoSfmError, match=message) as error:
        read_trajectory(path)
    assert "\n" not in str(error.value)


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(StereoSfmError, match="no trajectory at"):
        read_trajectory(tmp_path / "none.tum")


@pytest.mark.parametrize("end", ["", " 0 0 0 1", " 0 0 0 0"], ids=["four fields", "unit quaternions", "zeros"])
def test_positions_without_orientations_are_compared_as_positions(
    end: str, trajectory: Trajectory, tmp_path: Path
) -> None:
    path = tmp_path / "truth.tum"
    lines = [
        f"{seconds(int(t))} {p[0]} {p[1]} {p[2]}{end}\n"
        for t, p in zip(trajectory.stamp_ns, trajectory.positions, strict=True)
    ]
    path.write_text("".join(lines))
    truth = read_trajectory(path)
    assert not truth.oriented and read_tum(path).positions == pytest.approx(trajectory.positions)
    moved = Trajectory(trajectory.stamp_ns, se3.exp(np.array([1.0, -2, 3, 0.4, 0.5, -1.2])) @ trajectory.poses)
    for estimate, reference in ((moved, truth), (truth, moved)):
        result = evaluate(estimate, reference)
        assert result.ape_m.max < 1e-6 and result.rpe_m.max < 1e-6
        assert np.isnan([result.ape_deg.rmse, result.rpe_deg.rmse]).all() and result.retail is None
        rows = dict(table(result))
        assert rows["rotation"].startswith("not compared") and not [v for v in rows.values() if "nan" in v]
    with pytest.raises(StereoSfmError, match="positions without orientations"):
        evaluate(moved, truth, "origin")


def test_a_turning_trajectory_is_not_written_as_positions(trajectory: Trajectory, tmp_path: Path) -> None:
    write_tum(tmp_path / "t.tum", trajectory)
    assert read_trajectory(tmp_path / "t.tum").oriented


def test_the_position_tracker_of_euroc(tmp_path: Path) -> None:
    (tmp_path / "data.csv").write_text("#timestamp,x,y,z\n1403636579763555584,1,2,3\n1403636579813555456,2,2,3\n")
    truth = read_trajectory(tmp_path / "data.csv")
    assert not truth.oriented and truth.positions.tolist() == [[1, 2, 3], [2, 2, 3]]
    assert truth.stamp_ns[0] == 1403636579763555584


@pytest.mark.parametrize(
    ("header", "stamp", "order"),
    [
        ("# frame_id, t_x, t_y, t_z, quaternion_x, quaternion_y, quaternion_z, quaternion_w, scale", "{ns}", "xyzw"),
        ("timestamp,x,y,z,qw,qx,qy,qz", "{s}.{left:09d}", "wxyz"),
        ("#sec,nsec,x,y,z,qx,qy,qz,qw", "{s},{left}", "xyzw"),
        ("#frame_time,tx,ty,tz,rotation_quaternion_x,rotation_quaternion_y,rotation_quaternion_z,rotation_quaternion_w",
         "{ns}", "xyzw"),
        ("time,x,y,z,rot_w,rot_x,rot_y,rot_z", "{s}.{left:09d}", "wxyz"),
        ("#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []",
         "{ns}", "wxyz"),
    ],
)  # fmt: skip
def test_columns_are_those_that_the_first_line_names(
    header: str, stamp: str, order: str, trajectory: Trajectory, tmp_path: Path
) -> None:
    """Positions and stamps alone do not tell: errors of rotation and of motions between frames do."""
    lines = [header]
    for stamp_ns, pose in zip(trajectory.stamp_ns.tolist(), trajectory.poses, strict=True):
        xyzw = dict(zip("xyzw", se3.quaternion_from_rotation(pose[:3, :3]).tolist(), strict=True))
        at = stamp.format(ns=stamp_ns, s=stamp_ns // 10**9, left=stamp_ns % 10**9)
        lines.append(",".join([at, *map(str, pose[:3, 3]), *(str(xyzw[axis]) for axis in order), "1"]))
    (tmp_path / "t.csv").write_text("\n".join(lines))
    read = read_trajectory(tmp_path / "t.csv")
    assert read.stamp_ns.tolist() == trajectory.stamp_ns.tolist()
    assert read.poses == pytest.approx(trajectory.poses, abs=1e-8)


def test_angles_are_refused(tmp_path: Path) -> None:
    (tmp_path / "both.csv").write_text(
        "timestamp,x,y,z,qx,qy,qz,qw,roll,pitch,yaw\n0.1,1,2,3,0,0,0.6,0.8,0.1,0.2,0.3\n"
    )
    assert read_trajectory(tmp_path / "both.csv").poses[0, 0, 0] == pytest.approx(0.28)
    (tmp_path / "t.csv").write_text("timestamp,x,y,z,roll,pitch,yaw,speed\n0.1,1,2,3,0.1,0.2,0.3,4\n")
    with pytest.raises(StereoSfmError, match="angles instead of quaternions"):
        read_trajectory(tmp_path / "t.csv")
