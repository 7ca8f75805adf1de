"""What `benchmarks attack` and `kills` conclude from what they see: nothing is closed, or left out, silently."""

from __future__ import annotations

import re
from pathlib import Path

from benchmarks.attack import ATTACKS, NOT_RUN, PROGRAMS, TESTED, pytest_said
from benchmarks.kills import Kill, beyond, good, missing, summary

ROOT = Path(__file__).parents[2]
ITEMS = 27  # of the list of what was open
PLACES = [place for _, _, tests in TESTED for place in tests.split()]


def test_every_item_has_a_row() -> None:
    assert {item for rows in (ATTACKS, PROGRAMS, TESTED) for item, *_ in rows} == set(range(1, ITEMS + 1))


def test_the_tests_of_the_rows_exist() -> None:
    for place in PLACES:
        file, _, name = place.partition("::")
        path = ROOT / "tests" / file
        assert path.exists() and (not name or re.search(rf"^def {name}\(", path.read_text(), re.M)), place


def test_the_programs_of_a_row_exist() -> None:
    for _, _, words in PROGRAMS:
        first = words.split()[0]
        assert first == "-m" or (ROOT / first).is_file()


def test_a_skipped_test_closes_nothing() -> None:
    assert pytest_said(0, "..  [100%]\n2 passed in 0.1s\n") == ("2 passed in 0.1s", True)
    said = (
        "s.  [100%]\n=== short test summary info ===\n"
        "SKIPPED [1] tests/export/test_exports.py:65: could not import 'pycolmap': No module named 'pycolmap'\n"
        "1 passed, 1 skipped in 0.1s\n"
    )
    text, closed = pytest_said(0, said)
    assert not closed and text.startswith(f"{NOT_RUN}: skipped (could not import 'pycolmap': No module named")
    assert pytest_said(5, said.replace("1 passed, ", "")) == (text.replace("1 passed, ", ""), False)
    assert pytest_said(5, "no tests ran in 0.1s\n") == ("no tests ran in 0.1s", False)
    assert pytest_said(1, "F\nE   no\n1 failed in 0.1s\n") == ("F\nE   no\n1 failed in 0.1s\n", False)


def test_poses_may_be_missing_around_a_kill_only() -> None:
    """Session 2 gave no pose, and frames have the same numbers in sessions 1 and 3."""
    poses = {(1, frame): 10 + frame for frame in range(10)} | {(3, frame): 30 + frame for frame in range(5)}
    whole = [(15.0, set(range(10))), (32.0, set(range(5)))]
    assert missing(poses, whole) == []
    assert missing(poses, [(15.0, set(range(9))), (32.0, {0, 1, 2, 4})]) == [19, 33]
    assert missing(poses, whole[1:]) == list(range(10, 20))  # a recording is gone, and not that of another session
    assert missing(poses, [*whole[:1], (31.0, {0, 1}), (33.0, {2, 3, 4})]) == []  # another recorder
    kills = [Kill("mapper", 19.5, 1.0, True)]
    assert beyond([19, 20.2], kills) == 0 and beyond([19, 33], kills) == 1


def test_kills_that_cost_no_session_are_told() -> None:
    kills = [Kill("tracker", 0, 0.5, True), Kill("loop", 9, 0.1, False), Kill("mapper", 20, float("inf"), True)]
    assert good(kills) == 2
    text = summary("quiet", kills)
    assert "quiet: 2 of 3 within 3 s, median 0.50 s" in text and "1 cost no session (loop), of the other 2: 1" in text
    assert "cost no session" not in summary("quiet", kills[:1])
