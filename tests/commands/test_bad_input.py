"""Bad input through the command line: exit code 2 and one line on standard error, or a warning and the rest."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import cv2
import pytest

from stereo_sfm.calib import save_rig
from stereo_sfm.cli import main
from stereo_sfm.config import Config
from stereo_sfm.eval.batch import merge_maps, names
from stereo_sfm.maps.saved_map import load_map, save_map
from tests.drivers.dataset_folders import make_euroc, make_images, make_kitti, make_tum_rgbd
from tests.maps.maps import small_map
from tests.synthetic import fisheye_rig

Outcome = tuple[int, str, str]
Run = Callable[..., Outcome]

TARGET = ("--target", "checkerboard", "--columns", "9", "--rows", "6", "--square", "0.02")


@pytest.fixture
def cli(capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Run:
    """Runs the command line in an empty folder: exit code, standard output, standard error."""
    monkeypatch.chdir(tmp_path)

    def run(*args: object) -> Outcome:
        words = [str(a) for a in args]
        if words[0] == "run" and "--processes" not in words:
            words.append("--inline")
        try:
            code = main([w for w in words if w != "--processes"])
        except SystemExit as stop:  # argparse
            code = int(stop.code or 0)
        out, err = capsys.readouterr()
        return code, out, err

    return run


def assert_one_line(outcome: Outcome, *words: str) -> None:
    code, _, err = outcome
    assert code == 2, err
    assert len(err.strip().splitlines()) == 1, err
    assert err.startswith("stereo-sfm ")
    for word in words:
        assert word in err


def test_missing_folder(cli: Run) -> None:
    assert_one_line(cli("run", "data/nowhere"), "no such file or folder: data/nowhere")
    assert_one_line(cli("run", "euroc:nowhere"), "no folder nowhere")
    assert not Path("runs").exists()


def test_unknown_source_name(cli: Run) -> None:
    assert_one_line(cli("run", "t256"), "unknown source 't256', did you mean t265?")


def test_a_mistyped_folder_is_no_camera(cli: Run, tmp_path: Path) -> None:
    (tmp_path / "pairs").mkdir()
    assert_one_line(cli("run", "pairs2"), "no such file or folder: pairs2, did you mean pairs?")
    assert_one_line(cli("run", "ros3x4"), "no such file or folder: ros3x4 (")


def test_runs_that_are_not_there(cli: Run, tmp_path: Path) -> None:
    (tmp_path / "run1").mkdir()
    assert_one_line(cli("eval", "runX"), "no trajectory at runX")
    assert_one_line(cli("diff", "runX", "run1"), "no such file or folder: runX")
    assert_one_line(cli("map", "update", "storX", "run9"), "no such file or folder: run9")
    assert [path.name for path in tmp_path.iterdir()] == ["run1"]


def test_a_simulated_camera_is_no_recording(cli: Run) -> None:
    assert_one_line(cli("info", "sim:loop"), "sim:loop is no recording: 'stereo-sfm sources sim' describes it")


def test_a_folder_named_like_a_kind_is_the_folder(cli: Run, tmp_path: Path) -> None:
    (tmp_path / "euroc").mkdir()
    assert_one_line(cli("info", "euroc"), "euroc is not a known kind of dataset")
    assert_one_line(cli("info", "kitti"), "folder")


def test_folder_of_something_else(cli: Run, tmp_path: Path) -> None:
    (tmp_path / "holiday").mkdir()
    assert_one_line(cli("run", "holiday"), "not a known kind of dataset", "KITTI", "EuRoC")


@pytest.mark.parametrize("make", [make_kitti, make_euroc, make_images])
def test_missing_calibration(cli: Run, tmp_path: Path, make: Callable[[Path], Path]) -> None:
    root = make(tmp_path / "data")
    for name in ("calib.txt", "sensor.yaml", "rig.yaml"):
        for path in root.rglob(name):
            path.unlink()
    assert_one_line(cli("run", f"{'kitti:' if make is make_kitti else ''}{root}"), "calib")


@pytest.mark.parametrize(
    ("make", "name", "text"),
    [
        (make_kitti, "calib.txt", "P0: 50 0 32\nP1: 50 0 32\n"),
        (make_kitti, "calib.txt", "P0: what is this\n"),
        (make_euroc, "sensor.yaml", "T_BS: [1, 2\n"),
        (make_euroc, "sensor.yaml", "resolution: [64, 48]\nintrinsics: [50, 50, 32, 24]\n"),
        (make_images, "rig.yaml", "stereo_sfm_rig: 1\nleft: {model: pinhole}\n"),
        (make_images, "rig.yaml", "stereo_sfm_rig: 99\n"),
        (make_images, "rig.yaml", "\x00\x01\x02"),
    ],
)
def test_malformed_calibration(cli: Run, tmp_path: Path, make: Callable[[Path], Path], name: str, text: str) -> None:
    root = make(tmp_path / "data")
    path = next(iter(sorted(root.rglob(name))))
    path.write_text(text)
    assert_one_line(cli("run", root), path.name)


def test_calibration_with_a_transform_that_is_not_rigid(cli: Run, tmp_path: Path) -> None:
    root = make_images(tmp_path / "data")
    rig = root / "rig.yaml"
    rig.write_text(rig.read_text().replace("[[1, 0, 0, 0.1]", "[[3, 0, 0, 0.1]"))
    assert_one_line(cli("run", root))


def test_a_missing_rig_file(cli: Run, tmp_path: Path) -> None:
    assert_one_line(cli("run", make_images(tmp_path / "data"), "--rig", "other.yaml"), "other.yaml")


def test_unequal_image_counts_are_a_warning(cli: Run, tmp_path: Path) -> None:
    root = make_kitti(tmp_path / "data", frames=5)
    (root / "sequences" / "00" / "image_1" / "000004.png").unlink()
    _, out, err = cli("run", root, "-o", "out", "--max-lost", 101)
    assert "warning: kitti:00: 5 left and 4 right images, the 4 pairs are used" in err
    assert "/4 frames" in out
    assert "Traceback" not in err


def test_unreadable_image_is_a_warning_and_a_dropped_frame(cli: Run, tmp_path: Path) -> None:
    root = make_kitti(tmp_path / "data", frames=5)
    (root / "sequences" / "00" / "image_0" / "000002.png").write_bytes(b"GIF89a")
    _, out, err = cli("run", root, "-o", "out", "--max-lost", 101)
    assert (
        "warning: kitti:00: cannot read" in err and "000002.png (a compressed image cannot be decoded), frame 2" in err
    )
    assert "/5 frames (0 dropped by capture, 1 lost before capture)" in out


def test_no_readable_image_at_all(cli: Run, tmp_path: Path) -> None:
    root = make_images(tmp_path / "data")
    for path in (root / "left").iterdir():
        path.write_bytes(b"x")
    code, _, err = cli("run", root)
    assert code == 2 and err.splitlines()[-1].startswith("stereo-sfm run: images:data: none of the 12 images")


def test_image_size_that_contradicts_the_calibration(cli: Run, tmp_path: Path) -> None:
    root = make_euroc(tmp_path / "data")
    for path in root.rglob("sensor.yaml"):
        path.write_text(path.read_text().replace("[64, 48]", "[752, 480]"))
    assert_one_line(cli("run", root), "is 64x48 but the calibration is for 752x480")


def test_one_image_of_another_size_ends_the_run_with_what_was_tracked(cli: Run, tmp_path: Path) -> None:
    root = make_kitti(tmp_path / "data", frames=5)
    cv2.imwrite(
        str(root / "sequences" / "00" / "image_0" / "000003.png"), cv2.imread(str(root / "nothing")) or _small()
    )
    code, out, err = cli("run", root, "-o", "out")
    assert code == 2 and "000003.png is 10x10 but the calibration is for 64x48" in err
    assert "/3 frames" in out and "the run ended early: " in Path("out/report.md").read_text("utf-8")


def _small() -> cv2.typing.MatLike:
    import numpy as np

    return np.zeros((10, 10), np.uint8)


def test_errors_of_the_source_cross_processes_as_one_line(cli: Run, tmp_path: Path) -> None:
    root = make_euroc(tmp_path / "data")
    for path in root.rglob("sensor.yaml"):
        path.write_text(path.read_text().replace("[64, 48]", "[752, 480]"))
    assert_one_line(cli("run", root, "--processes"), "is 64x48 but the calibration is for 752x480")


def test_depth_images_of_another_size(cli: Run, tmp_path: Path) -> None:
    folder = make_tum_rgbd(tmp_path)
    cv2.imwrite(str(folder / "depth" / "0.png"), _small().astype("uint16"))
    (folder / "depth.txt").write_text("100.0 depth/0.png\n100.1 depth/1.png\n100.2 depth/2.png\n")
    assert_one_line(cli("run", folder), "0.png is 10x10 but the calibration is for 640x480")


def test_output_folder_that_exists(cli: Run, tmp_path: Path) -> None:
    root = make_images(tmp_path / "data")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.tex").write_text("years of work")
    assert_one_line(cli("run", root, "-o", "out"), "out exists", "--overwrite")
    assert cli("run", root, "-o", "out", "--overwrite", "--max-lost", 101)[0] in (0, 4)
    assert (tmp_path / "out" / "thesis.tex").read_text() == "years of work"


def test_truncated_mcap_is_a_warning_and_the_rest(cli: Run, tmp_path: Path) -> None:
    root = make_images(tmp_path / "data", [f"{i:03d}.png" for i in range(200)])
    assert cli("convert", root, "-o", "whole.mcap", "--image-format", "raw", "-q")[0] == 0
    whole = Path("whole.mcap").read_bytes()
    Path("cut.mcap").write_bytes(whole[: len(whole) * 2 // 3])
    code, out, err = cli("run", "cut.mcap", "-o", "out", "--max-lost", 101)
    assert code in (0, 4) and "Traceback" not in err
    assert "truncated" in err
    found = re.search(r"/(\d+) frames", out)
    assert found is not None and 50 < int(found[1]) < 200


def test_empty_mcap(cli: Run, tmp_path: Path) -> None:
    Path("empty.mcap").write_bytes(b"")
    assert_one_line(cli("run", "empty.mcap"), "empty.mcap")


def test_file_that_is_no_mcap(cli: Run, tmp_path: Path) -> None:
    (tmp_path / "run.mcap").write_text("hello")
    assert_one_line(cli("run", "run.mcap"), "run.mcap")


@pytest.mark.parametrize(
    ("args", "word"),
    [
        (("--set", "tracker.max_featurs=3"), "max_featurs"),
        (("--set", "tracker.max_features=many"), "max_features"),
        (("--set", "tracker"), "key=value"),
        (("-c", "none.toml"), "none.toml"),
        (("--frame-skip", "0"), "at least 1"),
        (("--max-frames", "0"), "at least 1"),
        (("--start", "-1"), "above 0"),
        (("--start", "1000"), "no frames selected"),
    ],
)
def test_invalid_options(cli: Run, tmp_path: Path, args: tuple[str, ...], word: str) -> None:
    assert_one_line(cli("run", f"{make_images(tmp_path / 'data')}?fps=30", *args), word)


def test_configuration_that_is_not_toml(cli: Run, tmp_path: Path) -> None:
    (tmp_path / "bad.toml").write_text("[tracker\n")
    assert_one_line(cli("run", make_images(tmp_path / "data"), "-c", "bad.toml"), "bad.toml")


@pytest.mark.parametrize(
    ("args", "word"),
    [
        (("none.tum", "--ref", "ref.tum"), "no trajectory at none.tum"),
        (("est.tum", "--ref", "none.tum"), "none.tum"),
        (("late.tum", "--ref", "ref.tum"), "no stamps in common"),
        (("bad.tum", "--ref", "ref.tum"), "bad.tum line 1"),
        (("folder", "--ref", "ref.tum"), "not the folder of a run"),
        (("est.tum", "--ref", "data"), "has no ground truth"),
        (("est.tum", "--ref", "ref.tum", "--delta", "x"), "--delta"),
        (("est.tum", "--ref", "ref.tum", "--delta", "1000f"), "--delta 1000f is longer"),
        (("est.tum", "--ref", "ref.tum", "--t-max-diff", "-1"), "--t-max-diff must be"),
        (("est.tum", "--ref", "ref.tum", "--max-ape", "nan"), "--max-ape must be"),
    ],
)
def test_eval_of_bad_files(cli: Run, tmp_path: Path, args: tuple[str, ...], word: str) -> None:
    (tmp_path / "folder").mkdir()
    make_images(tmp_path / "data")
    for name, start in (("est", 0), ("ref", 0), ("late", 1000)):
        lines = [f"{start + i / 10} {i} {i * i} 0 0 0 0 1" for i in range(9)]
        (tmp_path / f"{name}.tum").write_text("\n".join(lines))
    (tmp_path / "bad.tum").write_text("1 2 3")
    assert_one_line(cli("eval", *args), word)


@pytest.mark.parametrize(
    "args",
    [
        ("run", "data", "-c", "folder"),
        ("config", "dump", "-c", "folder"),
        ("config", "dump", "-c", "noise.toml"),
        ("ablation", "sim:aisle", "-o", "file", "--features", "orb", "--systems", "none"),
        ("eval", "folder", "--ref", "folder/trajectory_map.tum", "--plot", "file"),
        ("export", "folder", "--format", "tum", "-o", "file/x"),
        ("rectify", "data", "-o", "file"),
        ("batch", "data", "-o", "file"),
        ("viz", "data.mcap", "--save", "file/x.rrd"),
        ("viz", "data.mcap", "--save", "folder"),
        ("run", "data", "--map-out", "file/x"),
    ],
)
def test_files_that_cannot_be_read_or_written(cli: Run, tmp_path: Path, args: tuple[str, ...]) -> None:
    make_images(tmp_path / "data")
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_text("years of work")
    (tmp_path / "noise.toml").write_bytes(bytes(range(256)))
    lines = [f"{i / 10} {i} {i * i} 0 0 0 0 1" for i in range(9)]
    (tmp_path / "folder" / "trajectory_map.tum").write_text("\n".join(lines))
    if args[0] == "viz":
        assert cli("convert", "data", "-o", "data.mcap", "-q")[0] == 0
    assert_one_line(cli(*args), next(name for name in ("noise.toml", "file", "folder") if name in " ".join(args[2:])))
    assert (tmp_path / "file").read_text() == "years of work"


def test_errors_that_are_not_of_a_file_keep_their_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(_: object) -> int:
        raise ConnectionResetError(104, "Connection reset by peer")

    monkeypatch.setattr("stereo_sfm.commands.config.run", broken)
    with pytest.raises(ConnectionResetError):
        main(["config", "dump"])


@pytest.mark.parametrize("speed", ["0", "-1", "nan"])
def test_an_invalid_speed(cli: Run, tmp_path: Path, speed: str) -> None:
    assert_one_line(cli("run", make_images(tmp_path / "data"), "--speed", speed, "--processes"), "speed", "above 0")


@pytest.mark.parametrize("wiring", [(), ("--processes",)])
def test_a_mistake_leaves_no_output_folder(cli: Run, tmp_path: Path, wiring: tuple[str, ...]) -> None:
    root = make_images(tmp_path / "data", ["0.png", "1.png", "2.png"])
    (tmp_path / "nothing").mkdir()
    assert_one_line(cli("run", "nothing", "-o", "r/x", *wiring), "not a known kind of dataset")
    assert_one_line(cli("run", root, "-o", "r/x", "--features", "surf", "--odometry", "um", *wiring), "surf")
    assert not (tmp_path / "r").exists()
    (tmp_path / "used").mkdir()
    (tmp_path / "used" / "thesis.tex").write_text("years of work")
    assert_one_line(cli("run", "nothing", "-o", "used", *wiring), "not a known kind of dataset")
    assert_one_line(cli("run", root, "-o", "used", *wiring), "used exists", "--overwrite")


def test_an_empty_output_folder_will_do(cli: Run, tmp_path: Path) -> None:
    root = make_images(tmp_path / "data", ["0.png", "1.png", "2.png"])
    (tmp_path / "empty").mkdir()
    assert_one_line(cli("run", root, "-o", "empty", "--features", "surf", "--odometry", "um"), "surf")
    assert not any((tmp_path / "empty").iterdir())
    assert cli("run", root, "-o", "empty", "--max-lost", 101)[0] in (0, 4)
    assert (tmp_path / "empty" / "report.md").is_file()


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (("--image-format", "jpeg", "--log", "none"), "--image-format has no effect"),
        (("--image-format", "jpeg"), "--image-format has no effect"),
        (("--set", "odometry.scale=ground-truth"), "odometry.scale has no effect"),
    ],
)
def test_options_without_effect_are_a_warning(cli: Run, tmp_path: Path, args: tuple[str, ...], message: str) -> None:
    root = make_images(tmp_path / "data", ["0.png", "1.png"])
    _, _, err = cli("run", root, "-o", "out", "--max-lost", 101, *args)
    assert len([line for line in err.splitlines() if line.startswith("warning: ") and message in line]) == 1
    assert "has no effect" not in cli("run", root, "-o", "other", "--log", "full", "--image-format", "png")[2]


def test_rectify_of_no_frames(cli: Run, tmp_path: Path) -> None:
    assert_one_line(cli("rectify", make_images(tmp_path / "data"), "-o", "out", "--frames", 0), "--frames")
    assert not Path("out").exists()


def test_info_warns_once_of_a_truncated_file(cli: Run, tmp_path: Path) -> None:
    assert cli("convert", make_images(tmp_path / "data"), "-o", "whole.mcap", "-q")[0] == 0
    Path("cut.mcap").write_bytes(Path("whole.mcap").read_bytes()[:-1000])
    code, out, err = cli("info", "cut.mcap")
    assert code == 0 and not err and out.count("problem: ") == out.count("problem: truncated") == 1
    assert cli("info", "cut.mcap")[1].count("problem: truncated") == 1  # and each time it is asked


def test_an_empty_recording_leaves_no_file(cli: Run) -> None:
    source = "sim:aisle?camera=pinhole&size=64x48&frames=2"
    assert_one_line(cli("record", source, "-o", "a.mcap", "--start", "1000"), "no frames selected")
    assert not Path("a.mcap").exists()


def test_a_map_has_no_odometry(cli: Run, tmp_path: Path) -> None:
    (tmp_path / "map").mkdir()
    (tmp_path / "map" / "map.json").write_text("{}")
    assert_one_line(cli("export", "map", "--format", "tum", "--which", "odom"), "not the odometry")


def test_overwriting_a_run_removes_all_its_files(cli: Run, tmp_path: Path) -> None:
    folder = tmp_path / "a"
    (folder / "matches").mkdir(parents=True)
    old = [folder / "export_map.tum", folder / "matches" / "000003.png", folder / "trajectory_map.kitti"]
    for path in [*old, folder / "mine.txt"]:
        path.write_text("")
    source = "sim:aisle?camera=pinhole&size=64x48&frames=2"
    cli("run", source, "-o", "a", "--overwrite", "-q", "--set", "mapper.enabled=false")
    assert (folder / "report.md").exists() and (folder / "mine.txt").exists()
    assert not any(path.exists() for path in old)
    assert not (tmp_path / "latest").exists()  # only the runs in `runs` have a latest one


@pytest.mark.parametrize("command", [("merge", "a", "b"), ("prune", "a")])
def test_a_map_is_not_written_over_something_else(cli: Run, tmp_path: Path, command: tuple[str, ...]) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "rig.yaml").write_text("years of work")
    assert_one_line(cli("map", *command, "-o", "run", "--overwrite"), "run exists and is not a map")
    assert_one_line(cli("map", *command, "-o", "run/rig.yaml"), "exists and is not a map")
    assert (tmp_path / "run" / "rig.yaml").read_text() == "years of work"


@pytest.mark.parametrize("option", ["--max-frames", "--search", "--windows"])
@pytest.mark.parametrize("value", [0, -3])
def test_check_calib_without_images(cli: Run, option: str, value: int) -> None:
    assert_one_line(cli("check-calib", "sim:aisle?frames=3", option, value), f"{option} must be at least 1")


@pytest.mark.parametrize("option", ["--max-frames", "--views"])
def test_calibrate_without_images(cli: Run, option: str) -> None:
    assert_one_line(
        cli("calibrate", "sim:aisle?frames=3", option, -1, "--imu", "-o", "rig.yaml"),
        f"{option} must be at least 1, not -1",
    )


@pytest.mark.parametrize("frames", [1, 2])
def test_check_calib_of_hardly_anything(cli: Run, frames: int) -> None:
    assert cli("check-calib", "sim:aisle?frames=3&size=300x280", "--max-frames", frames)[0] in (0, 3)


@pytest.mark.parametrize(
    ("address", "error"),
    [
        ("nonsense", ValueError("Malformed address: nonsense")),
        ("10.0.0.1:6379", ConnectionError("Failed to connect to Ray cluster\nCheck that")),
    ],
)
def test_batch_without_its_cluster(
    cli: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, address: str, error: Exception
) -> None:
    ray = pytest.importorskip("ray")

    def init(**_: object) -> None:
        raise error

    monkeypatch.setattr(ray, "init", init)
    data = make_images(tmp_path / "data")
    assert_one_line(cli("batch", data, "-o", "out", "--address", address), f"no Ray cluster at {address}")


def test_names_of_a_batch_are_unique() -> None:
    assert names(["d1/a.mcap", "d2/a.mcap", "a_1.mcap"]) == ["a_2", "a_3", "a_1"]


def test_export_takes_a_rig_only_for_images(cli: Run, tmp_path: Path) -> None:
    (tmp_path / "map").mkdir()
    assert_one_line(cli("export", "map", "--format", "colmap", "--rig", "rig.yaml"), "--rig goes with --images")


@pytest.mark.parametrize(
    "args",
    [
        ("vocabulary", "train", "data", "-o", "file"),
        ("check-calib", "data", "--correct", "file"),
        ("viz", "data.mcap", "--save", "file"),
        ("calibrate", "data", *TARGET, "-o", "file"),
        ("calibrate", "data", *TARGET, "-o", "rig.yaml", "--report", "file"),
    ],
)
def test_files_are_replaced_only_when_asked(cli: Run, tmp_path: Path, args: tuple[str, ...]) -> None:
    make_images(tmp_path / "data")
    (tmp_path / "file").write_text("years of work")
    (tmp_path / "data.mcap").write_text("")
    assert_one_line(cli(*args), "file exists", "--overwrite")
    assert (tmp_path / "file").read_text() == "years of work"


@pytest.mark.parametrize(
    ("args", "word"),
    [
        (("-o", "cal3.html"), "would replace the rig"),
        (("-o", "rig.yaml", "--report", "file/x.html"), "cannot write file/x.html"),
        (("-o", "file/rig.yaml"), "cannot write file/rig.yaml"),
        (("-o", "rig.yaml", "--report", "data", "--overwrite"), "it is a folder"),
    ],
)
def test_calibrate_checks_its_output_files_first(cli: Run, tmp_path: Path, args: tuple[str, ...], word: str) -> None:
    make_images(tmp_path / "data")
    (tmp_path / "file").write_text("years of work")
    assert_one_line(cli("calibrate", "data", *TARGET, *args), word)


def test_calibrate_into_an_unknown_format(cli: Run, tmp_path: Path) -> None:
    code, _, err = cli("calibrate", make_images(tmp_path / "data"), *TARGET, "-o", "rig.yaml", "--format", "nope")
    assert code == 2 and "invalid choice: 'nope'" in err


def test_rectify_with_a_wrong_calibration_replaces_nothing(cli: Run, tmp_path: Path) -> None:
    make_images(tmp_path / "data")
    save_rig(fisheye_rig(), tmp_path / "wrong.yaml")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "rig.yaml").write_text("years of work")
    assert_one_line(cli("rectify", "data", "-o", "out", "--overwrite", "--rig", "wrong.yaml"))
    assert (tmp_path / "out" / "rig.yaml").read_text() == "years of work"


def test_input_files_are_not_overwritten(cli: Run, tmp_path: Path) -> None:
    assert cli("record", "sim:aisle?size=212x200&rate=10", "--max-frames", "3", "-o", "a.mcap", "-q")[0] == 0
    before = (tmp_path / "a.mcap").read_bytes()
    Path("b.mcap").symlink_to("a.mcap")
    for command in ("record", "convert"):
        for output in ("a.mcap", "b.mcap"):
            assert_one_line(cli(command, "a.mcap", "-o", output, "--overwrite"), "is the source", "another -o")
    assert cli("run", "a.mcap", "-o", "r", "-q", "--log", "full", "--max-lost", "100")[0] in (0, 4)
    logged = (tmp_path / "r" / "run.mcap").read_bytes()
    assert_one_line(cli("run", "mcap:r/run.mcap", "-o", "r", "--overwrite"), "is the source, or contains it")
    assert_one_line(cli("replay", "r", "-o", "r", "--overwrite"), "contains the run to be replayed")
    assert (tmp_path / "a.mcap").read_bytes() == before
    assert (tmp_path / "r" / "run.mcap").read_bytes() == logged


def test_a_file_at_the_map_path_is_an_error_before_the_run(cli: Run) -> None:
    Path("m").write_text("x")
    assert_one_line(cli("run", "sim:aisle", "--map-out", "m", "--overwrite"), "m is a file: --map-out takes a folder")


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("P1: 50 0 32 0 0 50 24 0 0 0 1 0", "baseline of 0 m"),
        ("P1: 50 0 32 -25e12 0 50 24 0 0 0 1 0", "give the extrinsics in metres"),
        ("P1: -50 0 32 -25 0 50 24 0 0 0 1 0", "fx -50"),
        ("P1: 50 0 1e9 -25 0 50 24 0 0 0 1 0", "cx 1e+09"),
        ("P1: 50 0 nan -25 0 50 24 0 0 0 1 0", "calib"),
    ],
)
def test_an_impossible_calibration(cli: Run, tmp_path: Path, line: str, message: str) -> None:
    root = make_kitti(tmp_path / "k")
    (root / "sequences" / "00" / "calib.txt").write_text(f"P0: 50 0 32 0 0 50 24 0 0 0 1 0\n{line}\n")
    assert_one_line(cli("run", root), message)


def test_a_recording_called_map_is_not_where_the_maps_are_merged() -> None:
    assert names(["b/map.mcap", "b/two.mcap"]) == ["map_1", "two"]
    assert names(["a/map.mcap", "b/map.mcap", "map_1.mcap"]) == ["map_2", "map_3", "map_1"]
    assert names(["a/x.mcap", "b/x.mcap", "y"]) == ["x_1", "x_2", "y"]


def test_two_copies_of_a_recording_are_not_merged(tmp_path: Path) -> None:
    maps = [tmp_path / name / "map" for name in ("one", "copy")]
    for folder in maps:
        save_map(small_map()[1], folder)
    said = merge_maps(maps, Config(), tmp_path / "map")
    assert "one map of one:" in said and "not connected: copy (the same recording as one before)" in said
    assert len(load_map(tmp_path / "map")) == len(small_map()[1])
