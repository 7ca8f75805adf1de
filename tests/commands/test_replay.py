"""`replay --check`; `--step` and `--seek`: one frame at a time."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from stereo_sfm.cli import main
from stereo_sfm.log import recorded

SPEC = "sim:aisle?camera=pinhole&size=320x200&rate=10&frames=8"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("step") / "run"
    options = ["--inline", "-q", "--max-lost", "100", "--set", "tracker.max_features=100"]
    assert main(["run", SPEC, "-o", str(folder), *options]) == 0
    return folder


def step(run: Path, out: Path, typed: list[str], monkeypatch: pytest.MonkeyPatch, *options: str) -> int:
    """Replay with a user who types these lines and then closes the input."""

    def answer(prompt: str) -> str:
        if not typed:
            raise EOFError
        return typed.pop(0)

    monkeypatch.setattr("builtins.input", answer)
    return main(["replay", str(run), "-o", str(out), "--step", "-q", *options])


def shown(text: str) -> list[int]:
    return [int(line.split()[1]) for line in text.splitlines() if line.startswith("frame ")]


def test_every_frame_is_shown_and_the_result_is_the_same(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert step(run, tmp_path / "a", [""] * 8, monkeypatch, "--check") == 0
    out = capsys.readouterr().out
    assert shown(out) == list(range(8))
    assert "OK, " in out and "identical" in out


def test_seek_goes_to_a_time_first(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert step(run, tmp_path / "b", [""] * 8, monkeypatch, "--seek", "0.45") == 0
    assert shown(capsys.readouterr().out) == [5, 6, 7]


@pytest.mark.parametrize("typed", [["", "q"], [""]])
def test_the_user_may_stop(
    typed: list[str], run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    step(run, tmp_path / "c", list(typed), monkeypatch)
    assert shown(capsys.readouterr().out) == [0, 1]
    assert len((tmp_path / "c" / "trajectory_odom.tum").read_text().splitlines()) < 8


def test_seek_alone_is_an_error(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["replay", str(run), "--seek", "2"]) == 2
    assert "--seek goes with --step" in capsys.readouterr().err


def test_a_time_before_the_first_frame_is_refused(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["replay", str(run), "--until", "-1"]) == 2
    assert "--until takes seconds after the first frame, got -1" in capsys.readouterr().err


def test_check_needs_no_output_folder(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["replay", str(run), "--check", "--inline", "-q"]) == 0
    assert capsys.readouterr().out == "identical\n"
    assert (tmp_path / "runs" / "latest" / "run.mcap").exists()
    assert main(["replay", str(run), "--check", "--log", "none", "-q"]) == 2
    assert "--check compares the logs" in capsys.readouterr().err


def test_the_log_of_a_killed_run_is_compared_as_far_as_it_goes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = tmp_path / "whole"
    spec = "sim:loop?size=212x200&rate=10&frames=60"
    assert main(["run", spec, "-o", str(whole), "--inline", "-q"]) == 0
    data = (whole / "run.mcap").read_bytes()
    for name, kept in (("one", 0.5), ("other", 0.8)):
        killed = tmp_path / name
        killed.mkdir()
        (killed / "run.mcap").write_bytes(data[: int(kept * len(data))])
        capsys.readouterr()
        assert main(["replay", str(killed), "-o", str(tmp_path / f"{name}2"), "--check", "--inline", "-q"]) == 0
        message = capsys.readouterr().out.splitlines()[-1]
        assert message.startswith("identical before frame ") and "killed" in message
        assert int(message.split()[3].rstrip(",")) > 60 * kept - 25
    assert main(["replay", str(killed), "-o", str(tmp_path / "different"), "--check", "--inline", "-q",
                 "--set", "tracker.max_features=150"]) == 3  # fmt: skip


@pytest.mark.parametrize(
    "options", [("--realtime",), ("--mode", "realtime"), ("--speed", "2"), ("--check", "--until", "1")]
)
def test_options_without_effect_in_a_replay(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], options: tuple[str, ...]
) -> None:
    assert main(["replay", str(run), "-o", str(tmp_path / "c"), *options]) == 2
    assert options[-2 if options[-1].isdigit() else -1] in capsys.readouterr().err
    assert not (tmp_path / "c").exists()


def test_more_is_logged_than_in_the_run(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ["-o", str(tmp_path / "c"), "--check", "--inline", "--log", "full", "-q"]
    assert main(["replay", str(run), *options]) == 0 and capsys.readouterr().out == "identical\n"


def test_a_camera_is_not_replayed(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It would take new images for the recorded ones, without end."""
    read = recorded.read_run
    monkeypatch.setattr(recorded, "read_run", lambda reader: replace(read(reader), source="oak:", image_format="none"))
    assert main(["replay", str(run), "-o", str(tmp_path / "c")]) == 2
    assert "its source oak: is a camera" in capsys.readouterr().err


def test_a_replay_numbers_the_frames_as_the_run_did(tmp_path: Path) -> None:
    options = ["--frame-skip", "3", "--inline", "-q", "--max-lost", "100"]
    assert main(["run", SPEC, "-o", str(tmp_path / "run"), *options]) == 0
    assert main(["replay", str(tmp_path / "run"), "-o", str(tmp_path / "again"), "--check", "--inline", "-q"]) == 0
    for name in ("trajectory_odom.kitti", "trajectory_odom.tum"):
        assert (tmp_path / "again" / name).read_text() == (tmp_path / "run" / name).read_text()
