"""One parser for the options of every driver: text of a query or typed keywords, and one line for invalid ones."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import pytest

from stereo_sfm.drivers.options import SourceOptions, described, option, read_options
from stereo_sfm.errors import StereoSfmError


def _pair(value: Any) -> tuple[int, int]:
    low, _, high = str(value).partition("-")
    if not low.isdigit() or not high.isdigit():
        raise ValueError("LOW-HIGH, such as 1-2")
    return int(low), int(high)


@dataclass(frozen=True)
class Some(SourceOptions):
    """Every type of option once."""

    rate: float = option(30.0, "images a second", low=1, high=120)
    count: int = option(3, "how many", low=0, high=10)
    exposure: int | None = option(None, "microseconds", low=20, high=1000)
    flip: bool = option(False, "upside down")
    word: Literal["left", "right"] = option("left", "which one")
    file: Path = option(Path("a"), "where")
    text: str = option("", "anything")
    range: tuple[int, int] = option((1, 2), "from to", read=_pair)


@pytest.mark.parametrize(
    "given",
    [
        {"rate": "60", "count": "4", "exposure": "500", "flip": "", "word": "RIGHT", "file": "b", "range": "3-4"},
        {"rate": 60, "count": 4, "exposure": 500, "flip": True, "word": "right", "file": Path("b"), "range": "3-4"},
    ],
)
def test_text_and_values_give_the_same_options(given: dict[str, Any]) -> None:
    assert read_options(Some, "cam", given) == Some(None, 60.0, 4, 500, True, "right", Path("b"), "", (3, 4))


def test_omitted_options_have_their_defaults() -> None:
    assert read_options(Some, "cam", {"exposure": "auto"}) == Some()


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("rate", "0", "option rate=0: it must be a number from 1 to 120"),
        ("rate", "nan", "a number from 1 to 120"),
        ("rate", True, "a number from 1 to 120"),
        ("count", "3.5", "a whole number from 0 to 10"),
        ("count", 3.0, "a whole number from 0 to 10"),
        ("exposure", "long", "auto or a whole number from 20 to 1000"),
        ("exposure", "5", "auto or a whole number from 20 to 1000"),
        ("flip", "maybe", "on or off"),
        ("word", "up", "one of left, right"),
        ("range", "x", "LOW-HIGH, such as 1-2"),
        ("rat", "1", r"cam has no option 'rat', did you mean rate\? \(it has: count, exposure"),
        ("zzz", "1", r"cam has no option 'zzz' \(it has:"),
    ],
)
def test_invalid_options_are_one_line(name: str, value: object, message: str) -> None:
    with pytest.raises(StereoSfmError, match=message) as caught:
        read_options(Some, "cam", {name: value})
    assert "\n" not in str(caught.value)


def test_the_declaration_is_the_documentation() -> None:
    helps = {h.name: h for h in described(Some)}
    assert list(helps)[:3] == ["rig", "rate", "count"]
    assert (helps["rate"].default, helps["rate"].wanted, helps["rate"].doc) == (
        "30", "a number from 1 to 120", "images a second",
    )  # fmt: skip
    assert (helps["flip"].default, helps["range"].default, helps["exposure"].default) == ("off", "1x2", "auto")


def test_an_error_of_a_driver_is_not_reported_as_a_user_error() -> None:
    def broken(value: Any) -> Any:
        raise TypeError("ours")

    @dataclass(frozen=True)
    class Broken(SourceOptions):
        size: int = option(0, "broken", read=broken)

    with pytest.raises(TypeError, match="ours"):
        read_options(Broken, "cam", {"size": "1"})
