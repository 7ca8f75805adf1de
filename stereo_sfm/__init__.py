"""Visual structure-from-motion and SLAM for stereo cameras in retail stores.

    import stereo_sfm as s

    with s.open_source("recordings/demo.mcap") as source:
        for frame in s.run(source, s.Config()):
            print(frame.stamp_ns, frame.state.name, frame.odom_T_cam[:3, 3])

or, from a loop of one's own:

    with s.System("rig.yaml") as system:
        frame = system.step(left, right, stamp_ns)

`examples/` has a program for each thing that can be done. Names are imported when they are first used, so that
`import stereo_sfm` is instant.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from stereo_sfm import same_code

if TYPE_CHECKING:
    from stereo_sfm.calib.formats import load_rig, save_rig
    from stereo_sfm.calib.rig import Rig
    from stereo_sfm.config import Config
    from stereo_sfm.config import load as load_config
    from stereo_sfm.demo import demo_recording
    from stereo_sfm.drivers.ground_truth import read_trajectory
    from stereo_sfm.drivers.source import open_source
    from stereo_sfm.errors import StereoSfmError
    from stereo_sfm.eval.evaluate import evaluate
    from stereo_sfm.export.formats import export_map, export_trajectory
    from stereo_sfm.maps.relocalization import Location
    from stereo_sfm.maps.saved_map import SavedMap, load_map, save_map
    from stereo_sfm.pipeline.run import run
    from stereo_sfm.system import LiveMap, MapLocator, System, Tracker
    from stereo_sfm.types import (
        Frame,
        ImuSamples,
        Keyframe,
        LoopResult,
        MapUpdate,
        StereoImage,
        TrackState,
        Trajectory,
        WheelSamples,
    )

__all__ = [
    "Config",
    "Frame",
    "ImuSamples",
    "Keyframe",
    "LiveMap",
    "Location",
    "LoopResult",
    "MapLocator",
    "MapUpdate",
    "Rig",
    "SavedMap",
    "StereoImage",
    "StereoSfmError",
    "System",
    "TrackState",
    "Tracker",
    "Trajectory",
    "WheelSamples",
    "__version__",
    "demo_recording",
    "evaluate",
    "export_map",
    "export_trajectory",
    "load_config",
    "load_map",
    "load_rig",
    "open_source",
    "read_trajectory",
    "run",
    "save_map",
    "save_rig",
]

__version__ = "0.1.0"

same_code.choose()

# name -> (module, attribute)
_LAZY: dict[str, tuple[str, str]] = {
    "Config": ("stereo_sfm.config", "Config"),
    "Frame": ("stereo_sfm.types", "Frame"),
    "ImuSamples": ("stereo_sfm.types", "ImuSamples"),
    "Keyframe": ("stereo_sfm.types", "Keyframe"),
    "LiveMap": ("stereo_sfm.system", "LiveMap"),
    "Location": ("stereo_sfm.maps.relocalization", "Location"),
    "LoopResult": ("stereo_sfm.types", "LoopResult"),
    "MapLocator": ("stereo_sfm.system", "MapLocator"),
    "MapUpdate": ("stereo_sfm.types", "MapUpdate"),
    "Rig": ("stereo_sfm.calib.rig", "Rig"),
    "SavedMap": ("stereo_sfm.maps.saved_map", "SavedMap"),
    "StereoImage": ("stereo_sfm.types", "StereoImage"),
    "StereoSfmError": ("stereo_sfm.errors", "StereoSfmError"),
    "System": ("stereo_sfm.system", "System"),
    "TrackState": ("stereo_sfm.types", "TrackState"),
    "Tracker": ("stereo_sfm.system", "Tracker"),
    "Trajectory": ("stereo_sfm.types", "Trajectory"),
    "WheelSamples": ("stereo_sfm.types", "WheelSamples"),
    "demo_recording": ("stereo_sfm.demo", "demo_recording"),
    "evaluate": ("stereo_sfm.eval.evaluate", "evaluate"),
    "export_map": ("stereo_sfm.export.formats", "export_map"),
    "export_trajectory": ("stereo_sfm.export.formats", "export_trajectory"),
    "load_config": ("stereo_sfm.config", "load"),
    "load_map": ("stereo_sfm.maps.saved_map", "load_map"),
    "load_rig": ("stereo_sfm.calib.formats", "load_rig"),
    "open_source": ("stereo_sfm.drivers.source", "open_source"),
    "read_trajectory": ("stereo_sfm.drivers.ground_truth", "read_trajectory"),
    "run": ("stereo_sfm.pipeline.run", "run"),
    "save_map": ("stereo_sfm.maps.saved_map", "save_map"),
    "save_rig": ("stereo_sfm.calib.formats", "save_rig"),
}


def __getattr__(name: str) -> Any:
    if name not in _LAZY:
        raise AttributeError(f"module 'stereo_sfm' has no attribute '{name}'")
    module, attribute = _LAZY[name]
    value = getattr(importlib.import_module(module), attribute)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_LAZY})
