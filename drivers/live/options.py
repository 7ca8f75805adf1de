"""Options of a live source: from keywords or from the query of its name, where everything is text."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

from stereo_sfm.errors import StereoSfmError

T = TypeVar("T")
_FLAGS = dict.fromkeys(("", "1", "true", "yes", "on"), True) | dict.fromkeys(("0", "false", "no", "off"), False)


class Options:
    """Takes options one by one; what is left at the end is a mistake of the user.

    Args:
        source: name for messages ("t265").
        options: as `open_source` got them.
    """

    def __init__(self, source: str, options: Mapping[str, Any]) -> None:
        self._source, self._left = source, dict(options)
        self._known: list[str] = []

    def _take(self, name: str, default: Any) -> Any:
        self._known.append(name)
        return self._left.pop(name, default)

    def _bad(self, name: str, value: Any, wanted: str) -> StereoSfmError:
        return StereoSfmError(f"{self._source}: option {name}={value}: it must be {wanted}")

    def anything(self, name: str, default: T) -> Any | T:
        """The value as it comes."""
        return self._take(name, default)

    def text(self, name: str, default: str = "") -> str:
        return str(self._take(name, default))

    def flag(self, name: str, default: bool) -> bool:
        value = str(self._take(name, default)).lower()
        if value not in _FLAGS:
            raise self._bad(name, value, "0 or 1")
        return _FLAGS[value]

    def number(self, name: str, default: float, low: float, high: float) -> float:
        value = self._take(name, default)
        try:
            number = float(value)
        except (TypeError, ValueError):
            number = float("nan")
        if not low <= number <= high:
            raise self._bad(name, value, f"a number from {low:g} to {high:g}")
        return number

    def choice(self, name: str, default: str, among: Mapping[str, T]) -> T:
        value = str(self._take(name, default)).lower()
        if value not in among:
            raise self._bad(name, value, f"one of {', '.join(among)}")
        return among[value]

    def microseconds(self, name: str, low: int, high: int) -> int | None:
        """A time in microseconds, or None for 'auto'."""
        value = str(self._take(name, "auto")).lower()
        if value == "auto":
            return None
        if not value.isdigit() or not low <= int(value) <= high:
            raise self._bad(name, value, f"'auto' or {low} to {high} microseconds")
        return int(value)

    def finish(self) -> None:
        """Complain about what nobody took."""
        if self._left:
            raise StereoSfmError(
                f"{self._source} has no option '{min(self._left)}' (it has: {', '.join(sorted(self._known))})"
            )
