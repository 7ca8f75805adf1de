"""The settings that may change while running, as the page shows them: in groups, with name, unit, bounds and help."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

from stereo_sfm.service.config import RobotConfig

UNITS = {"min": "min", "s": "s", "gb": "GB", "mb": "MB", "percent": "%", "hz": "Hz"}  # suffixes of names


def settings_form(values: Mapping[str, Any]) -> list[dict[str, Any]]:
    """One row for each setting.

    Args: values, by their names in robot.toml.
    """
    return [_row(name, value) for name, value in values.items()]


def _row(name: str, value: Any) -> dict[str, Any]:
    *sections, key = name.split(".")
    owner: Any = RobotConfig()
    for section in sections:
        owner = getattr(owner, section)
    known = next(f.metadata for f in dataclasses.fields(owner) if f.name == key)
    words, _, suffix = key.rpartition("_")
    unit = UNITS.get(suffix, "") if words else ""
    least, most = known.get("range", (None, None))
    return {
        "name": name,
        "group": " ".join(sections),
        "label": (words if unit else key).replace("_", " "),
        "unit": unit,
        "help": known["text"],
        "least": least,
        "most": most,
        "words": list(known.get("words", ())),
        "value": value,
    }
