"""`map label`: points left of and below the origin of the floor plan, and texts that are no points."""

from __future__ import annotations

from pathlib import Path

import pytest

from stereo_sfm.cli import main
from stereo_sfm.maps.saved_map import save_map
from stereo_sfm.maps.store import read_about
from tests.maps.maps import small_map


@pytest.fixture
def store(tmp_path: Path) -> Path:
    save_map(small_map()[1], tmp_path / "store")
    return tmp_path / "store"


@pytest.mark.parametrize(
    ("start", "end", "points"),
    [
        ("-4.3,-1", "1.2,-1", ((-4.3, -1.0), (1.2, -1.0))),
        ("-.5,2", "-1e-3,-7", ((-0.5, 2.0), (-0.001, -7.0))),
        ("1.5,3", "13.5,3", ((1.5, 3.0), (13.5, 3.0))),
    ],
)
@pytest.mark.parametrize("door", [False, True])
def test_points_may_be_negative(store: Path, start: str, end: str, points: object, door: bool) -> None:
    assert main(["map", "label", str(store), "aisle 4", start, end, *["--door"] * door]) == 0
    about = read_about(store)
    (line,) = about.doors if door else about.aisles
    assert (line.name, (line.start, line.end)) == ("aisle 4", points)


@pytest.mark.parametrize("text", ["1.5", "nan,0", "0,inf", "-1e999,0", "1,2,3", "a,b", "1;2"])
def test_a_text_that_is_no_point(store: Path, text: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(["map", "label", str(store), "a", text, "1,1"])
    said = capsys.readouterr().err.splitlines()[-1]
    assert "argument X,Y: " in said and text in said and "_point" not in said
    assert read_about(store).aisles == ()


def test_an_option_is_still_an_option(store: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(["map", "label", str(store), "a", "-1,1", "2,2", "-x"])
    assert "unrecognized arguments: -x" in capsys.readouterr().err
