"""The calibration type, its file formats, and the calibration of cameras."""

from __future__ import annotations

from stereo_sfm.calib.formats import load_rig, save_rig
from stereo_sfm.calib.rig import Rig

__all__ = ["Rig", "load_rig", "save_rig"]
