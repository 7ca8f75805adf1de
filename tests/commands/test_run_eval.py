from __future__ import annotations

import itertools
import json
import os
import signal
import tomllib
from pathlib import Path

import cv2
import numpy as np
import pytest

import stereo_sfm
from stereo_sfm.cli import main
from stereo_sfm.commands.compare import load_runs
from stereo_sfm.drivers.ground_truth import read_kitti, read_tum
from stereo_sfm.eval.record import RunRecord
from stereo_sfm.export.trajectories import write_tum
from stereo_sfm.geometry import se3
from stereo_sfm.types import Frame
from tests.drivers.dataset_folders import make_images


@pytest.fixture(scope="module")
def euroc_run(data_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run over 30 frames of EuRoC MH01."""
    folder = tmp_path_factory.mktemp("euroc") / "runs" / "mh01"
    assert main(["run", "--inline", str(data_root / "euroc_mh01"), "-o", str(folder), "--max-frames", "30", "-q"]) == 0
    return folder


def test_output_folder(euroc_run: Path) -> None:
    stats = json.loads((euroc_run / "stats.json").read_text())
    assert stats["tracked"] == stats["frames"] == 30
    assert stats["lost_intervals"] == [] and stats["keyframes"] >= 1
    assert stats["evaluation"]["odometry"]["ape_m"]["rmse"] < 0.01
    assert stats["ms"]["track"]["p50"] > 0
    report = (euroc_run / "report.md").read_text()
    assert "ATE" in report and "**WARN**: IMU used for rotations only" in report  # 1.4 s show no more
    for name in ("trajectory.png", "errors.png", "tracking.png", "times.png"):
        assert (euroc_run / name).read_bytes().startswith(b"\x89PNG") and f"({name})" in report
    assert stereo_sfm.load_rig(euroc_run / "rig.yaml").baseline == pytest.approx(0.1101, abs=1e-4)
    assert (euroc_run.parent / "latest").resolve() == euroc_run.resolve()


def test_trajectory_files_agree(euroc_run: Path) -> None:
    tum = read_tum(euroc_run / "trajectory_odom.tum")
    assert len(tum) == 30
    assert tum.poses[0] == pytest.approx(np.eye(4))
    kitti = read_kitti(euroc_run / "trajectory_odom.kitti", tum.stamp_ns)
    assert kitti.poses == pytest.approx(tum.poses, abs=1e-7)
    mapped = read_tum(euroc_run / "trajectory_map.tum")
    assert mapped.stamp_ns.tolist() == tum.stamp_ns.tolist()
    assert 0 < np.abs(mapped.positions - tum.positions).max() < 0.02
    keyframes = read_tum(euroc_run / "keyframes.tum")
    assert set(keyframes.stamp_ns.tolist()) <= set(tum.stamp_ns.tolist())


def test_saved_configuration_runs_again(euroc_run: Path) -> None:
    assert stereo_sfm.load_config(euroc_run / "config.toml") == stereo_sfm.Config()


def test_processes_give_the_same_bits_as_inline(euroc_run: Path, data_root: Path, tmp_path: Path) -> None:
    assert main(["run", str(data_root / "euroc_mh01"), "-o", str(tmp_path / "b"), "--max-frames", "30", "-q"]) == 0
    first, second = (json.loads((f / "stats.json").read_text())["fingerprint"] for f in (euroc_run, tmp_path / "b"))
    assert first == second


def test_trajectory_of_the_body(euroc_run: Path, data_root: Path, tmp_path: Path) -> None:
    args = ["run", "--inline", str(data_root / "euroc_mh01"), "-o", str(tmp_path / "b"), "--max-frames", "30", "-q"]
    assert main([*args, "--frame", "body"]) == 0
    body = read_tum(tmp_path / "b" / "trajectory_odom.tum")
    camera = read_tum(euroc_run / "trajectory_odom.tum")
    body_T_cam = stereo_sfm.load_rig(euroc_run / "rig.yaml").body_T_left
    assert body.poses == pytest.approx(body_T_cam @ camera.poses @ se3.inverse(body_T_cam), abs=1e-7)
    assert "world_T_body" in (tmp_path / "b" / "trajectory_odom.tum").read_text()


def ate(*args: object, capsys: pytest.CaptureFixture[str]) -> float:
    """The output of `eval`."""
    assert main(["eval", *map(str, args), "--json"]) == 0
    return json.loads(capsys.readouterr().out)["ape_m"]["rmse"]


@pytest.mark.parametrize("options", [("--frame", "body"), ("--rectify", "pinhole"), ("--rectify", "wide")])
def test_eval_agrees_with_the_report_of_any_frame(
    data_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], options: tuple[str, ...]
) -> None:
    source, folder = data_root / "euroc_mh01", tmp_path / "a"
    assert main(["run", "--inline", str(source), "-o", str(folder), "--max-frames", "30", "-q", *options]) == 0
    reported = json.loads((folder / "stats.json").read_text())["evaluation"]["map"]["ape_m"]["rmse"]
    assert ate(folder, "--ref", source, capsys=capsys) == pytest.approx(reported, rel=1e-4)


def test_eval_of_body_poses(
    euroc_run: Path, data_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """They are compared with the camera's only through the calibration beside them."""
    source, folder = data_root / "euroc_mh01", tmp_path / "b"
    assert main(["run", "--inline", str(source), "-o", str(folder), "--max-frames", "30", "-q", "--frame", "body"]) == 0
    camera, body = euroc_run / "trajectory_map.tum", folder / "trajectory_map.tum"
    assert ate(camera, "--ref", body, capsys=capsys) < 1e-6
    assert ate(body, "--ref", camera, capsys=capsys) < 1e-6
    assert ate(body, "--ref", body, capsys=capsys) < 1e-6
    assert ate(body.with_suffix(".kitti"), "--ref", camera, capsys=capsys) < 1e-6  # has no heading
    of_camera, of_body = (run.estimate.poses for run in load_runs([euroc_run, folder]))
    assert of_body == pytest.approx(of_camera, abs=1e-6)
    (folder / "rig.yaml").unlink()
    assert main(["eval", str(body), "--ref", str(source)]) == 2
    assert "poses of the body, and there is no rig.yaml" in capsys.readouterr().err


def test_eval_with_the_datasets_own_file_of_the_body(
    euroc_run: Path, data_root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = data_root / "euroc_mh01"
    truth = source / "mav0" / "state_groundtruth_estimate0" / "data.csv"
    of_camera = ate(euroc_run, "--ref", source, capsys=capsys)
    assert ate(euroc_run, "--ref", truth, capsys=capsys) == pytest.approx(of_camera, rel=1e-6)


def test_eval_prints_the_runs_errors(
    euroc_run: Path, data_root: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    stats = json.loads((euroc_run / "stats.json").read_text())
    reference = str(data_root / "euroc_mh01")
    for which, name in (("map", "map"), ("odom", "odometry")):
        args = ["eval", str(euroc_run), "--ref", reference, "--json", "--which", which]
        assert main([*args, "--plot", str(tmp_path)]) == 0
        printed = json.loads(capsys.readouterr().out)
        assert printed["ape_m"]["rmse"] == pytest.approx(stats["evaluation"][name]["ape_m"]["rmse"], rel=1e-4)
    assert {p.name for p in tmp_path.iterdir()} == {
        f"{n}.{kind}" for n in ("trajectory", "errors") for kind in ("png", "svg")
    }
    assert main(["eval", str(euroc_run), "--ref", reference, "--align", "none"]) == 0
    assert "alignment none" in capsys.readouterr().out


def test_eval_of_a_file_without_stamps(data_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    poses = data_root / "kitti" / "poses" / "00.txt"
    for reference in (poses, data_root / "kitti"):
        assert main(["eval", str(poses), "--ref", str(reference), "--max-ape", "1e-6"]) == 0
        assert "120 frames over 92.0 m" in capsys.readouterr().out
    short = tmp_path / "short.txt"
    short.write_text("\n".join(poses.read_text().splitlines()[:50]))
    assert main(["eval", str(short), "--ref", str(poses)]) == 2
    assert "no stamps, and its 50 lines do not match 120 poses" in capsys.readouterr().err
    stamped = tmp_path / "stamped.tum"
    write_tum(stamped, read_kitti(poses, np.arange(120, dtype=np.int64) * 10**8))
    assert main(["eval", str(stamped), "--ref", str(short)]) == 2
    assert "short.txt has no stamps, and its 50 lines" in capsys.readouterr().err
    assert ate(stamped, "--ref", poses, capsys=capsys) < 1e-6


def test_eval_checks(euroc_run: Path, data_root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    args = ["eval", str(euroc_run / "trajectory_odom.tum"), "--ref", str(data_root / "euroc_mh01")]
    assert main([*args, "--max-ape", "0.02"]) == 0
    assert main([*args, "--max-ape", "1e-6"]) == 3
    assert "is above 1e-06 m" in capsys.readouterr().err


def test_noise_is_not_tracked_and_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = make_images(tmp_path / "noise")
    assert main(["run", "--inline", str(root), "-o", str(tmp_path / "out")]) == 4
    assert "never initialised" in capsys.readouterr().err
    assert "**FAIL**" in (tmp_path / "out" / "report.md").read_text()


def test_lost_frames_are_reported_and_filled(
    data_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Twenty-four frames of which three are black and one is no image."""
    folder = tmp_path / "dark"
    with stereo_sfm.open_source(data_root / "euroc_mh01") as source:
        stereo_sfm.save_rig(source.rig, folder / "rig.yaml")
        for side in ("left", "right"):
            (folder / side).mkdir()
        for image in itertools.islice(source, 24):
            black = image.frame_id in (10, 11, 12)
            for side, pixels in (("left", image.left), ("right", image.right)):
                assert pixels is not None
                cv2.imwrite(str(folder / side / f"{image.stamp_ns}.png"), pixels * np.uint8(not black))
    broken = sorted((folder / "right").iterdir())[17]
    broken.write_bytes(b"x")
    assert main(["run", "--inline", str(folder), "-o", str(tmp_path / "out")]) == 0
    message = capsys.readouterr().out
    assert "tracked 20/24 frames (0 dropped by capture, 1 lost before capture), 1 lost interval (max 0." in message
    assert " s, dark)" in message
    stats = json.loads((tmp_path / "out" / "stats.json").read_text())
    assert stats["states"]["LOST"] == 3 and stats["dropped"] == 1
    assert stats["lost_intervals"][0]["first_frame_id"] == 10 and stats["lost_intervals"][0]["frames"] == 3
    assert "more light" in (tmp_path / "out" / "report.md").read_text()
    assert len(read_tum(tmp_path / "out" / "trajectory_odom.tum")) == 20
    kitti = read_kitti(tmp_path / "out" / "trajectory_odom.kitti")
    assert len(kitti) == 24
    steps = np.linalg.norm(np.diff(kitti.positions, axis=0), axis=1)
    assert steps.max() < 0.05  # the filled ones lie between their neighbours


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_writes_what_was_tracked(
    number: int, data_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    seen: list[int] = []

    def put(self: RunRecord, message: object) -> None:
        original(self, message)
        if isinstance(message, Frame):
            seen.append(message.frame_id)
            if len(seen) == 5:
                os.kill(os.getpid(), number)

    original = RunRecord.put
    monkeypatch.setattr(RunRecord, "put", put)
    assert main(["run", "--inline", str(data_root / "euroc_mh01"), "-o", str(tmp_path / "out")]) == 130
    assert len(read_tum(tmp_path / "out" / "trajectory_odom.tum")) == len(seen) == 5
    assert "tracked 5/5 frames" in capsys.readouterr().out


def test_config_dump_is_read_back(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main(["config", "dump", "--set", "tracker.max_features=321", "--seed", "7"]) == 0
    text = capsys.readouterr().out
    assert tomllib.loads(text)["tracker"]["max_features"] == 321
    (tmp_path / "c.toml").write_text(text)
    config = stereo_sfm.load_config(tmp_path / "c.toml")
    assert config.tracker.max_features == 321 and config.seed == 7


def test_python_api_of_the_readme(data_root: Path) -> None:
    import stereo_sfm as s

    stamps: list[int] = []
    with s.open_source(data_root / "euroc_mh01") as source:
        for frame in s.run(source, s.Config()):
            stamps.append(frame.stamp_ns)
            assert frame.state is s.TrackState.OK
            if len(stamps) == 3:
                break
    assert stamps == sorted(stamps) and len(stamps) == 3


def test_a_part_of_a_source_lasts_as_long_as_its_images(
    data_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The ground truth in the file extends to the source's end."""
    path = str(tmp_path / "part.mcap")
    assert main(["convert", str(data_root / "kitti"), "-o", path, "--max-frames", "3", "-q"]) == 0
    capsys.readouterr()
    assert main(["info", path]) == 0
    assert f"{path}: 0.21 s" in capsys.readouterr().out
