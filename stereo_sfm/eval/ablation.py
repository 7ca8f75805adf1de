"""One cell of the papers' ablation: a source, a front end, an estimator and later modules, run and evaluated.

A cell is a pure function of its description, so its result is kept as a JSON file and not computed twice.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import re
import time
import traceback
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from stereo_sfm.config import Config, load
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.eval.evaluate import evaluate
from stereo_sfm.eval.record import RunRecord
from stereo_sfm.eval.statistics import stage_times
from stereo_sfm.input_file import read_json
from stereo_sfm.presets import preset
from stereo_sfm.types import Trajectory

FEATURES = ("sift", "akaze", "orb")
ESTIMATORS = ("em-r", "vp-r", "r-um", "um")
# what runs behind the tracker -> overrides
STAGES: dict[str, dict[str, Any]] = {
    "tracking": {"mapper": {"enabled": False}, "loop": {"enabled": False}},
    "mapping": {"loop": {"enabled": False}},
    "averaging": {"loop": {"correction": "averaging"}},
    "pose_graph": {"loop": {"correction": "pose_graph"}},
}
SYSTEMS = ("default", "retail-thesis", "sparse-localization", "cpp-course")
_MIN_TRACKED = 0.5  # below this share of frames with a pose, a cell has no result
_SCHEMA = 1
_CHECKSUM = "sha256"  # of the rest of a result


@dataclass(frozen=True)
class Cell:
    """One run."""

    source: str
    system: str  # a preset's name; "grid" for a combination of features and estimator
    features: str  # "" for the default of the system
    method: str  # "" for the default of the system
    stage: str  # of STAGES, or "" for the default of the system
    frames: int  # largest number, 0: all
    seed: int = 0
    settings: tuple[str, ...] = ()  # SECTION.KEY=VALUE, applied last

    @property
    def name(self) -> str:
        """Readable name, without the source."""
        if self.system != "grid":
            return self.system + (f" {self.stage}" if self.stage else "")
        return f"{self.features} {self.method} {self.stage}"

    @property
    def file_name(self) -> str:
        """Unique, readable and reproducible; different for different configurations."""
        *others, settings = dataclasses.astuple(self)
        own = (*others, settings) if settings else tuple(others)
        described = (_SCHEMA, own, dataclasses.asdict(self.config()))
        digest = hashlib.sha256(repr(described).encode()).hexdigest()[:8]
        words = re.sub(r"[^a-z0-9]+", "-", f"{Path(self.source).name} {self.name}".lower()).strip("-")
        return f"{words}-{digest}.json"

    def config(self) -> Config:
        """The configuration of this run."""
        overrides = [f"seed={self.seed}", f"loop.seed={self.seed}"]
        if self.system == "grid":
            overrides += [f"features.kind={self.features}", f"odometry.method={self.method}"]
        stage = [
            f"{section}.{key}={json.dumps(value)}"
            for section, values in STAGES.get(self.stage, {}).items()
            for key, value in values.items()
        ]
        base = preset("default" if self.system == "grid" else self.system)
        return load(base=base, overrides=[*self.settings, *overrides, *stage])


def grid(
    sources: Sequence[str],
    features: Sequence[str] = FEATURES,
    methods: Sequence[str] = ESTIMATORS,
    stages: Sequence[str] = tuple(STAGES),
    systems: Sequence[str] = SYSTEMS,
    frames: int = 0,
    seed: int = 0,
    settings: Sequence[str] = (),
) -> list[Cell]:
    """Every cell once; the fast ones of each source first."""
    given = tuple(dict.fromkeys(settings))
    cells: list[Cell] = []
    for source in sources:
        for system in systems:
            own = stages if system == "default" else ("",)
            cells += [Cell(source, system, "", "", stage, frames, seed, given) for stage in own]
        cells += [
            Cell(source, "grid", kind, method, stage, frames, seed, given)
            for stage in stages
            for method in methods
            for kind in features
        ]
    return list(dict.fromkeys(cells))


def run_cell(cell: Cell) -> dict[str, Any]:
    """Run and evaluate; a failure becomes a result with a reason.

    Returns:
        Plain values for JSON: `status` is "ok" or "none" with `reason`; `opened` once the source has been opened.
    """
    from stereo_sfm.drivers.select import SelectedFrames
    from stereo_sfm.drivers.source import open_source
    from stereo_sfm.pipeline.run import run

    result: dict[str, Any] = {"schema": _SCHEMA, "cell": dataclasses.asdict(cell), "status": "none", "reason": ""}
    record = RunRecord()
    begin = time.perf_counter()
    try:
        config = cell.config()
        record = RunRecord.of(config)
        source = open_source(cell.source)
        with SelectedFrames(source, max_frames=cell.frames or None) as chosen:
            result["opened"] = True
            for _ in run(chosen, config, [record]):
                pass
            truth = chosen.ground_truth
            result["source_name"] = chosen.name
        result |= _describe(record, time.perf_counter() - begin)
        result |= _judge(record, config, truth)
    except StereoSfmError as error:
        result["reason"] = str(error)
    except Exception:  # a failed cell is a result and does not end the grid
        result["reason"] = "internal error: " + traceback.format_exc().strip().splitlines()[-1]
        result["traceback"] = traceback.format_exc()
    return result


def _describe(record: RunRecord, wall_s: float) -> dict[str, Any]:
    tracked = record.tracked()
    lost = Counter(record.frames.reasons_of(~tracked))
    return {
        "frames": len(tracked),
        "tracked": int(tracked.sum()),
        "lost": dict(sorted(lost.items())),
        "keyframes": len(record.keyframes),
        "map_points": len(record.map_points),
        "loops": len(record.loops),
        "rejected_loops": dict(sorted(record.rejected.items())),
        "track_ms": stage_times(record).get("track", {}).get("p50"),
        "frame_ms": 1e3 * wall_s / max(len(tracked), 1),
    }


def _judge(record: RunRecord, config: Config, truth: Trajectory | None) -> dict[str, Any]:
    """Errors of the final trajectory: that of the map if there is one, else that of the odometry."""
    estimate = record.mapped() if config.mapper.enabled else record.odometry()
    tracked = record.tracked()
    if tracked.mean() < _MIN_TRACKED if len(tracked) else True:
        reasons = Counter(record.frames.reasons_of(~tracked))
        most, count = reasons.most_common(1)[0] if reasons else ("no frames", 0)
        return {"reason": f"{most} in {count} of {len(tracked)} frames"}
    if estimate is None:
        return {"reason": "no map update came from the mapper"}
    if truth is None:
        return {"reason": "the source has no ground truth"}
    evaluation = evaluate(estimate, truth)
    shown = evaluate(estimate, truth, "sim3" if config.odometry.monocular else "origin")
    return {
        "status": "ok",
        "monocular": config.odometry.monocular,
        "metrics": evaluation.to_dict(),
        "mean_error_m": float(evaluation.errors_m().mean()),
        "path": np.round(shown.estimate.positions, 4).tolist(),
        "true_path": np.round(shown.reference.positions, 4).tolist(),
    }


def load_result(path: Path) -> dict[str, Any] | None:
    """A finished cell's file, or None where there is none or it was cut off or damaged."""
    try:
        data = read_json(path)
    except (FileNotFoundError, NotADirectoryError, ValueError):
        return None
    whole = isinstance(data, dict) and data.pop(_CHECKSUM, "") == _checksum(data)
    return data if whole and data.get("schema") == _SCHEMA else None


def finished(result: dict[str, Any] | None) -> bool:
    """Whether a cell need not be run again: it has a result or a reason for having none.

    Cells that crashed, or whose source could not be opened, are run again.
    """
    return result is not None and "traceback" not in result and ("frames" in result or "opened" in result)


def save_result(path: Path, result: dict[str, Any]) -> None:
    """Write whole or not at all, so that an interrupted grid can go on."""
    part = path.with_suffix(".part")
    part.write_text(json.dumps({**result, _CHECKSUM: _checksum(result)}), encoding="utf-8")
    part.replace(path)


def _checksum(result: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(result).encode()).hexdigest()
