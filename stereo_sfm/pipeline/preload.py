"""Imported by the process from which the stages are forked: the code of all of them, which they share in memory."""

from __future__ import annotations

import gc
import importlib
from typing import Any, cast

from numba.core.registry import cpu_target

MODULES = (
    "cv2",
    "scipy.linalg",
    "scipy.sparse.csgraph",
    "stereo_sfm.log.run_log",
    "stereo_sfm.loop.closer",
    "stereo_sfm.mapping.mapper",
    "stereo_sfm.maps.growing",
    "stereo_sfm.maps.saved_map",
    "stereo_sfm.maps.unfinished",
    "stereo_sfm.pipeline.capture",
    "stereo_sfm.pipeline.logger",
    "stereo_sfm.pipeline.map_saver",
    "stereo_sfm.pipeline.warm_up",
    "stereo_sfm.pipeline.workers",
    "stereo_sfm.tracking.flow.tracker",
    "threadpoolctl",
)

for name in MODULES:
    importlib.import_module(name)
for context in (cpu_target.typing_context, cpu_target.target_context):
    cast(Any, context).refresh()  # what numba would load in each stage with its first kernel, in 0.2 s
gc.collect()
gc.freeze()  # the collector of a stage does not write to, and so copy, what is here
