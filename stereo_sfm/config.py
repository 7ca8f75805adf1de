"""One tree of frozen dataclasses whose defaults work; load, merge, dump. Unknown keys are errors."""

from __future__ import annotations

import dataclasses
import tomllib
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from stereo_sfm.errors import StereoSfmError


@dataclass(frozen=True)
class TrackerConfig:
    """The default tracker (tracking/tracker.py)."""

    max_features: int = 400  # points tracked at once
    seed: int = 0


@dataclass(frozen=True)
class MapperConfig:
    """Local mapping (mapping/mapper.py)."""

    enabled: bool = True


@dataclass(frozen=True)
class LoopConfig:
    """Loop closing (loop/closer.py)."""

    enabled: bool = True


@dataclass(frozen=True)
class PipelineConfig:
    """How the stages are wired (pipeline/)."""

    update_lag_frames: int = 3  # a keyframe's MapUpdate is applied just before this many frames later
    loop_lag_keyframes: int = 2  # a keyframe's LoopResult reaches the mapper this many keyframes later


@dataclass(frozen=True)
class Config:
    """Everything that decides what a run computes. The resolved tree is saved with every run."""

    seed: int = 0
    tracker: TrackerConfig = field(default_factory=TrackerConfig)
    mapper: MapperConfig = field(default_factory=MapperConfig)
    loop: LoopConfig = field(default_factory=LoopConfig)
    pipeline: PipelineConfig = field(default_factory=PipelineConfig)


def _merge(base: dict[str, Any], extra: dict[str, Any]) -> dict[str, Any]:
    out = dict(base)
    for key, value in extra.items():
        old = out.get(key)
        out[key] = _merge(old, value) if isinstance(old, dict) and isinstance(value, dict) else value
    return out


def from_dict(data: dict[str, Any]) -> Config:
    """Nested plain values over the defaults.

    Raises:
        StereoSfmError: an unknown key or a value of the wrong type.
    """
    import dacite

    merged = _merge(dataclasses.asdict(Config()), data)
    try:
        return dacite.from_dict(Config, merged, dacite.Config(strict=True, type_hooks={float: _as_float}, cast=[tuple]))
    except dacite.DaciteError as error:
        raise StereoSfmError(f"configuration: {error} (see 'stereo-sfm config dump' for every key)") from None


def _as_float(value: Any) -> Any:
    return float(value) if isinstance(value, int) and not isinstance(value, bool) else value


def load(path: Path | None = None, overrides: Iterable[str] = ()) -> Config:
    """Defaults, then a TOML file, then `key.subkey=value` overrides whose values are read as TOML (else as text)."""
    data: dict[str, Any] = {}
    if path is not None:
        try:
            data = tomllib.loads(path.read_text())
        except FileNotFoundError:
            raise StereoSfmError(f"no configuration file at {path}") from None
        except tomllib.TOMLDecodeError as error:
            raise StereoSfmError(f"configuration {path}: {error}") from None
    for override in overrides:
        key, equals, value = override.partition("=")
        if not equals:
            raise StereoSfmError(f"--set takes key=value, got '{override}'")
        try:
            tree = tomllib.loads(f"{key} = {value}")
        except tomllib.TOMLDecodeError:
            try:
                tree = tomllib.loads(f"{key} = {value!r}")
            except tomllib.TOMLDecodeError:
                raise StereoSfmError(f"--set cannot read '{override}'") from None
        data = _merge(data, tree)
    return from_dict(data)


def dump(config: Config) -> str:
    """The whole tree as TOML that `load` reads back."""
    import tomli_w

    return tomli_w.dumps(dataclasses.asdict(config))
