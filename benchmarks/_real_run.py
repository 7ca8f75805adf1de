"""One run of `benchmarks real`, in a process of its own: `stereo-sfm run` with one automatic thing off.

    python _real_run.py SWITCH USAGE.json run SOURCE OPTION ...

What the configuration can turn off is turned off there. For the others a function of the package is replaced by one
that does nothing; where this version of the package has no such function, the exit code is NO_SWITCH.
"""

from __future__ import annotations

import importlib
import json
import resource
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

NO_SWITCH = 75

# Per switch: options of `run`, and functions to replace, each MODULE:CLASS.NAME or MODULE:NAME, all of them needed.
OPTIONS: dict[str, tuple[str, ...]] = {
    "default": (),
    "self-calibration": ("--self-calibrate", "off"),
    "inertial": ("--set", "tracker.inertial=false"),
    "side views": ("--set", "loop.side_corners=0"),
    "loops": ("--set", "loop.enabled=false"),
    "steps": (),
    "people": (),
    "recovery": (),
}
FLOW = "stereo_sfm.tracking.flow"


def _not_found(*_: Any) -> Any:
    return importlib.import_module(f"{FLOW}.tracker").NOT_FOUND


def _none(*_: Any) -> None:
    return None


def _nothing_moves(original: Callable[..., Any]) -> Callable[..., Any]:
    """`after_frame` that marks no point as moving."""

    def after_frame(tracks: Any, inlier: Any, moving: Any, misses_allowed: int, alert: bool, static: int) -> Any:
        return original(tracks, inlier, moving & False, misses_allowed, False, static)

    return after_frame


# What takes the place of a function; of a `Wrapped` one a function of the original.
class Wrapped:
    """A replacement that calls the original."""

    def __init__(self, make: Callable[[Callable[..., Any]], Callable[..., Any]]) -> None:
        self.make = make


# Right images as of a camera that turned in the middle, by name (`_real_inject.STEPS`, which has their amounts).
STEPS = ("step 0.1 x", "step 0.1 y", "step 0.2 z", "step 0.3 y", "step 0.5 y")

REPLACED: dict[str, dict[str, Any]] = {
    "steps": {
        f"{FLOW}.sudden_turn:SuddenTurns.from_config": staticmethod(_none),
    },
    "people": {
        f"{FLOW}.frame_pose:FramePoseSolver._contradicted": _none,
        f"{FLOW}.frame_pose:FramePoseSolver._judge": lambda self, tracks, expected, last, best, before: best,
        f"{FLOW}.frame_pose:FramePoseSolver.alert": property(lambda self: False),
        f"{FLOW}.tracker:after_frame": Wrapped(_nothing_moves),
    },
    "recovery": {f"{FLOW}.tracker:Tracker._search": _not_found, f"{FLOW}.tracker:Tracker._find_more": _none},
}


def replace(switch: str) -> list[str]:
    """Replace the functions of a switch; the names of those that do not exist."""
    missing: list[str] = []
    for name, new in REPLACED.get(switch, {}).items():
        module, path = name.split(":")
        owner: Any = None
        try:
            owner = importlib.import_module(module)
            *classes, last = path.split(".")
            for part in classes:
                owner = getattr(owner, part)
            original = getattr(owner, last)
        except (ImportError, AttributeError):
            missing.append(name)
            continue
        setattr(owner, last, new.make(original) if isinstance(new, Wrapped) else new)
    return missing


def inject(step: str) -> list[Any]:
    """Have the source of the run turn its right camera; the list gets that source."""
    importlib.import_module("stereo_sfm.same_code")  # before OpenCV: the bits are those of other runs
    from _real_inject import Turned

    choice, turned = importlib.import_module("stereo_sfm.drivers.choice"), list[Any]()
    original = choice.open_source

    def open_source(*args: Any, **options: Any) -> Any:
        turned.append(Turned(original(*args, **options), step))
        return turned[-1]

    choice.open_source = open_source
    return turned


def main(args: list[str]) -> int:
    """Run, and write the processor time."""
    switch, usage, *command = args
    missing = replace(switch)
    if missing:
        print(f"no switch for {switch} here: there is no {missing[0]}", file=sys.stderr)
        return NO_SWITCH
    turned = inject(switch) if switch in STEPS else []
    from stereo_sfm.cli import main as stereo_sfm

    code = stereo_sfm([*command, *OPTIONS.get(switch, ())])
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    told = {"processor_s": sum(u.ru_utime + u.ru_stime for u in used)}
    if turned:
        told["injected_s"] = (turned[0].middle_ns - turned[0].first_ns) * 1e-9
    Path(usage).write_text(json.dumps(told), encoding="utf-8")
    return int(code or 0)


if __name__ == "__main__":
    sys.path.append(sys.path.pop(0))  # the benchmarks, some of which have names of other modules
    sys.exit(main(sys.argv[1:]))
