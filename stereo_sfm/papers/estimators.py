"""The motion estimators that `--odometry` names: the files of `odometry/`, each with an `ESTIMATOR`."""

from __future__ import annotations

import importlib

from stereo_sfm.config import OdometryConfig, estimator_names
from stereo_sfm.errors import one_of
from stereo_sfm.geometry.cameras import Camera
from stereo_sfm.papers.motion_estimator import Estimator, EstimatorEntry


def estimator(name: str) -> EstimatorEntry:
    """The estimator of a name.

    Raises:
        StereoSfmError: unknown name.
    """
    one_of(name, ("flow", *estimator_names()), "odometry")
    return importlib.import_module(f"stereo_sfm.papers.odometry.{name.replace('-', '_')}").ESTIMATOR


def make_estimator(config: OdometryConfig, camera: Camera) -> Estimator:
    """The estimator that `config.method` names, for images of `camera`.

    Raises:
        StereoSfmError: unknown name.
    """
    return estimator(config.method).make(config, camera)
