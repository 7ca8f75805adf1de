"""How the service opens its source: a lost camera is waited for, and only the same camera is taken again."""

from __future__ import annotations

import dataclasses

from stereo_sfm.drivers.choice import SourceChoice
from stereo_sfm.drivers.source import look_up

RECONNECT_S = 86_400.0  # the longest that drivers take


def patient(choice: SourceChoice) -> SourceChoice:
    """The same source; a camera that is lost is waited for inside the running pipeline, which keeps its map."""
    named = look_up(choice.spec, **choice.options)
    if not hasattr(named.options, "reconnect") or "reconnect=" in choice.spec:
        return choice
    return dataclasses.replace(choice, options={**choice.options, "reconnect": RECONNECT_S})


def same_camera(choice: SourceChoice, serial: str) -> SourceChoice:
    """The same source; one that was "any camera of its kind" is the camera with this serial number from now on."""
    named = look_up(choice.spec, **choice.options)
    if named.driver.cameras is None or named.place or not serial:
        return choice
    kind, _, query = choice.spec.partition("?")
    spec = f"{kind.rstrip(':')}:{serial}" + (f"?{query}" if query else "")
    return dataclasses.replace(choice, spec=spec)
