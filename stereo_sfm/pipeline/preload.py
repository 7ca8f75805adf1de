"""Imported by the process from which the stages are forked: the code of all of them, which they share in memory."""

from __future__ import annotations

import gc
import importlib

MODULES = (
    "cv2",
    "scipy.linalg",
    "scipy.sparse.csgraph",
    "stereo_sfm.log.run_log",
    "stereo_sfm.loop.closer",
    "stereo_sfm.mapping.mapper",
    "stereo_sfm.pipeline.capture",
    "stereo_sfm.pipeline.logger",
    "stereo_sfm.pipeline.warm_up",
    "stereo_sfm.tracking.flow.tracker",
)

for name in MODULES:
    importlib.import_module(name)
gc.collect()
gc.freeze()  # the collector of a stage does not write to, and so copy, what is here
