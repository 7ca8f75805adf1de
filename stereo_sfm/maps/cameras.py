"""The cameras that took the sessions of a map: `cameras.yaml`, and what two cameras differ by."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from stereo_sfm.calib.choice import with_terms
from stereo_sfm.calib.formats.common import numbers, read_yaml, reading, yaml_text
from stereo_sfm.calib.formats.native import rig_from_plain, rig_to_plain, rig_to_text
from stereo_sfm.calib.rig import Rig
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Camera
from stereo_sfm.types import F64, RIG_TERMS

KEY = "stereo_sfm_map_cameras"
# Differences that are not worth a word, as radians or shares of the focal length or half the baseline: below what any
# calibration knows; and what self-calibration may change, a standard deviation of its prior (`rig_window.PRIOR`).
SAME, CORRECTED = 1e-4, 1e-2


@dataclass(frozen=True, eq=False)
class MapCamera:
    """The camera of a session: its calibration as the session began, and what the session corrected of it."""

    calibrated: Rig  # with its serial number
    terms: F64 = field(default_factory=lambda: np.zeros(RIG_TERMS))  # (8,) see `CalibrationUpdate`

    @functools.cached_property
    def rig(self) -> Rig:
        """The corrected rig, of which the pixels of the session's keyframes are true."""
        return with_terms(self.calibrated, self.terms)

    @functools.cached_property
    def text(self) -> str:
        """The calibration as text: equal for equal calibrations."""
        return rig_to_text(self.calibrated)


def unified(rigs: Sequence[Rig]) -> list[Rig]:
    """The rigs in their order, with one object for those whose cameras are the same to the bit: the first of them."""
    known: dict[Any, Rig] = {}
    return [known.setdefault(_bits(rig), rig) for rig in rigs]


def _bits(rig: Rig) -> Any:
    lenses = [None if c is None else (c.model_id, c.size, c.params.tobytes()) for c in (rig.left, rig.right)]
    return *lenses, rig.depth, rig.left_T_right.tobytes()


def difference(a: Rig, b: Rig, corrected: bool = False) -> str:
    """What b has that a has not, in words; "" if nothing.

    Args: corrected, what self-calibration may change does not count.
    """
    limit = CORRECTED if corrected else SAME
    out = [f"serial number {b.serial} instead of {a.serial}"] if a.serial and b.serial and a.serial != b.serial else []
    out += [f"{_kind(b)} instead of {_kind(a)}"] if _kind(a) != _kind(b) else []
    for side, x, y in (("left", a.left, b.left), ("right", a.right, b.right)):
        if x is not None and y is not None:
            out += _lens_difference(side, x, y, limit if side == "right" else SAME)
    if a.stereo and b.stereo:
        out += _pose_difference(a, b, limit)
    return ", ".join(out)


def _kind(rig: Rig) -> str:
    return "a depth camera" if rig.depth else "two cameras" if rig.stereo else "one camera"


def _lens_difference(side: str, a: Camera, b: Camera, limit: float) -> list[str]:
    if a.model != b.model:
        return [f"{side} lens {b.model} instead of {a.model}"]
    if a.size != b.size:
        return [f"{side} image {b.width}x{b.height} instead of {a.width}x{a.height}"]
    out: list[str] = []
    if max(abs(a.fx - b.fx), abs(a.fy - b.fy)) > limit * a.fx:
        out.append(f"{side} focal length {b.fx:.2f} instead of {a.fx:.2f} px")
    if max(abs(a.cx - b.cx), abs(a.cy - b.cy)) > limit * a.fx:
        out.append(f"{side} principal point {b.cx:.2f} {b.cy:.2f} instead of {a.cx:.2f} {a.cy:.2f}")
    if not np.allclose(a.params[4:], b.params[4:], rtol=1e-6, atol=1e-9):
        out.append(f"another distortion of the {side} lens")
    return out


def _pose_difference(a: Rig, b: Rig, limit: float) -> list[str]:
    turned = float(se3.extent(se3.inverse(a.left_T_right) @ b.left_T_right)[1])
    moved = float(np.linalg.norm(a.left_T_right[:3, 3] - b.left_T_right[:3, 3]))
    out: list[str] = []
    if moved > 2 * limit * max(a.baseline, 1e-6):
        if abs(a.baseline - b.baseline) > 2 * SAME * a.baseline:
            out.append(f"baseline {1e3 * b.baseline:.1f} instead of {1e3 * a.baseline:.1f} mm")
        else:
            out.append(f"the right camera {1e3 * moved:.1f} mm elsewhere")
    if turned > limit:
        out.append(f"the right camera turned by {np.rad2deg(turned):.3f} deg")
    return out


def cameras_text(cameras: Mapping[int, MapCamera], sessions: Sequence[int]) -> str:
    """`cameras.yaml`: each calibration once, with its sessions among those given, and their corrections."""
    of: dict[str, list[int]] = {}
    for session in sessions:
        of.setdefault(cameras[session].text, []).append(session)
    entries = [
        {
            "calibration": rig_to_plain(cameras[taken[0]].calibrated),
            "corrections": {k: " ".join(map(repr, cameras[k].terms.tolist())) for k in taken},
        }
        for taken in of.values()
    ]
    return yaml_text({KEY: 1, "cameras": entries})


def read_cameras(path: Path) -> dict[int, MapCamera]:
    """The camera of each session, by its number.

    Raises:
        StereoSfmError: not such a file.
    """
    found: dict[int, MapCamera] = {}
    with reading(path, "cameras"):
        data = read_yaml(path)
        if data.get(KEY) != 1:
            raise ValueError(f"{KEY} is {data.get(KEY)}, this version of the program reads 1")
        for entry in data["cameras"]:
            rig = rig_from_plain(entry["calibration"])
            for session, correction in entry["corrections"].items():
                found[int(session)] = MapCamera(rig, np.array(numbers(str(correction).split(), RIG_TERMS)))
    return found
