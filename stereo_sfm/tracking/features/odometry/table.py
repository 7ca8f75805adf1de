"""The one table of motion estimators: name -> (module, class). Modules are imported when chosen."""

from __future__ import annotations

import importlib

from stereo_sfm.config import OdometryConfig
from stereo_sfm.errors import one_of
from stereo_sfm.geometry.cameras import Camera
from stereo_sfm.tracking.features.odometry.base import Estimator

_PACKAGE = "stereo_sfm.tracking.features.odometry"

TABLE: dict[str, tuple[str, str]] = {
    "em-r": ("em_r", "EmR"),  # retail paper: essential matrix, then 1-point translation
    "vp-r": ("vp_r", "VpR"),  # retail paper: vanishing points, then 1-point translation
    "r-um": ("r_um", "RUm"),  # retail paper: 3-point RANSAC and Umeyama
    "um": ("um", "Um"),  # retail paper: Umeyama
    "eight-point": ("eight_point", "EightPoint"),  # sparse localization paper
    "pnp": ("pnp", "Pnp"),  # C++ course system
}


def make_estimator(config: OdometryConfig, camera: Camera) -> Estimator:
    """The estimator that `config.method` names, for images of `camera`.

    Raises:
        StereoSfmError: unknown name.
    """
    one_of(config.method, ("flow", *TABLE), "odometry")
    module, name = TABLE[config.method]
    factory = getattr(importlib.import_module(f"{_PACKAGE}.{module}"), name)
    return factory(config, camera) if config.method == "vp-r" else factory(config)
