"""The nearest known word is suggested for an unknown one, everywhere by one function."""

from __future__ import annotations

import pytest

from stereo_sfm.calib.formats import FORMATS, load_rig
from stereo_sfm.cli import main
from stereo_sfm.drivers import open_source
from stereo_sfm.errors import StereoSfmError, did_you_mean, one_of


def test_the_nearest_word_is_guessed() -> None:
    assert did_you_mean("chessboard", ("checkerboard", "charuco", "aprilgrid")) == ", did you mean checkerboard?"
    assert did_you_mean("kitti-raw", ("kitti", "kitti_raw")) == ", did you mean kitti_raw?"
    assert did_you_mean("dict_5x5_100", ("DICT_4X4_50", "DICT_5X5_100")) == ", did you mean DICT_5X5_100?"
    assert did_you_mean("xyz", ("checkerboard",)) == ""


def test_one_of_a_list() -> None:
    assert one_of("b", ("a", "b"), "letter") == "b"
    with pytest.raises(
        StereoSfmError, match=r"^unknown camera 'rigth', did you mean right\? \(choose one of left, right\)$"
    ):
        one_of("rigth", ("left", "right"), "camera")


@pytest.mark.parametrize(
    ("command", "expected"),
    [
        ("run sim:aile", "did you mean aisle?"),
        ("run sim:loop?camera=fishey", "did you mean fisheye?"),
        ("run t265:simulated?faults=unplugged --inline", "did you mean unplug?"),
        ("run sim:loop?encounters=aproach --inline", "did you mean approach?"),
        ("run --preset retail-tesis", "did you mean retail-thesis?"),
        ("run --set odometry.method=epnp", "did you mean pnp?"),
        ("run --set traker.max_features=3", "did you mean tracker?"),
        ("calibrate images --target chessboard -o x.yaml", "did you mean checkerboard?"),
        ("sources t256", "did you mean t265?"),
    ],
)
def test_commands_guess(command: str, expected: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(command.split()) == 2
    error = capsys.readouterr().err
    assert expected in error and len(error.splitlines()) == 1


@pytest.mark.parametrize(
    ("command", "expected"),
    [
        ("rectfy x", "did you mean rectify?"),
        ("run --log ful", "did you mean full?"),
        ("run --overwite", "did you mean --overwrite?"),
        ("export run --format colmp", "did you mean colmap?"),
    ],
)
def test_the_command_line_guesses(command: str, expected: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(command.split())
    assert stop.value.code == 2 and expected in capsys.readouterr().err.splitlines()[-1]


def test_formats_of_calibrations_are_guessed(tmp_path: object) -> None:
    assert "kalibr" in FORMATS
    with pytest.raises(StereoSfmError, match="did you mean kalibr"):
        load_rig(__file__, "kaliber")


def test_python_gets_the_same_guess() -> None:
    with pytest.raises(StereoSfmError, match=r"sim has no option 'cammera', did you mean camera\?"):
        open_source("sim:loop", cammera="pinhole")
