"""`stereo-sfm vocabulary` on real images: training is reproducible byte for byte."""

from __future__ import annotations

from pathlib import Path

import pytest

from stereo_sfm.cli import main
from stereo_sfm.commands.vocabulary import spread
from stereo_sfm.loop.vocabulary_file import load_vocabulary


def test_train_twice_and_describe(tmp_path: Path, data_root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    paths = [tmp_path / "a.npz", tmp_path / "b.npz"]
    for path in paths:
        arguments = ["--images", "3", "--branching", "6", "--depth", "3", "-o", str(path)]
        assert main(["vocabulary", "train", str(data_root / "t265_office"), *arguments]) == 0
    assert paths[0].read_bytes() == paths[1].read_bytes()
    words = len(load_vocabulary(paths[0]))
    assert 50 < words <= 6**3
    out = capsys.readouterr().out
    assert f"{words} words from" in out and "of 3 images" in out
    assert main(["vocabulary", "info", str(paths[0])]) == 0
    assert f"{words} words in" in capsys.readouterr().out


def test_bad_input_has_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["vocabulary", "info", str(tmp_path / "none.npz")]) == 2
    assert "no vocabulary at" in capsys.readouterr().err
    assert main(["vocabulary", "train", str(tmp_path / "nowhere"), "-o", str(tmp_path / "v.npz")]) == 2
    assert "no such file or folder" in capsys.readouterr().err


@pytest.mark.parametrize(("option", "least"), [("--images", 1), ("--branching", 2), ("--depth", 1), ("--seed", 0)])
@pytest.mark.parametrize("below", [1, 2])
def test_numbers_out_of_range_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], option: str, least: int, below: int
) -> None:
    train = ["vocabulary", "train", "sim:aisle", "-o", str(tmp_path / "v.npz"), f"{option}={least - below}"]
    assert main(train) == 2
    assert capsys.readouterr().err == f"stereo-sfm vocabulary: {option} must be at least {least}, not {least - below}\n"
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("count", "wanted"), [(99, 50), (7, 3), (3, 7), (5, 5), (0, 4), (10, 1)])
def test_the_requested_number_of_images(count: int, wanted: int) -> None:
    chosen = spread(count, wanted)
    assert len(set(chosen)) == min(wanted, count)
    assert set(chosen) <= set(range(count))
