"""What numbers of a calibration say about themselves: a fisheye under another name, lengths in other units, scales.

A fisheye's four coefficients k1 k2 k3 k4 under the name of the radial-tangential model are taken for k1 k2 p1 p2. As
tangential distortion, k3 and k4 would be a lens that is tilted by several degrees: no factory mounts one like that.
"""

from __future__ import annotations

import logging
from collections.abc import Callable

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.geometry.cameras import Camera, KannalaBrandt

log = logging.getLogger("stereo_sfm")

# Against its sensor. Lens mounts keep within half a degree; the calibration of a cheap camera's may say one.
MOST_TILTED_DEG = 2.0
NEAREST_M = 1.0  # a stereo camera for a robot or a car shows half of its view to both cameras at this distance
LEAST_FAR_M = 1.0  # and can tell this distance from infinity, by a pixel
USUAL_M = 0.015, 0.6  # baselines: of cameras for the near (RealSense D405: 18 mm) and of pairs on cars (KITTI: 540 mm)
MOST_SCALE = 1.6  # of one image by the other: rendered pairs are matched from 0.6 to 1.25, not at 0.5 and 2


def tilt_deg(camera: Camera) -> float:
    """The tilt of the lens that tangential distortion stands for.

    A sensor tilted by a small angle t moves x by t x^2, tangential distortion by 3 p x^2.
    """
    p1, p2 = (*camera.distortion, 0.0, 0.0, 0.0, 0.0)[2:4]
    return float(np.rad2deg(3 * np.hypot(p1, p2)))


def fisheye_in_disguise(camera: Camera) -> bool:
    """Whether a radial-tangential lens is none, and its four coefficients are those of a fisheye."""
    wide = 2 * camera.fx < camera.width  # more than 90 degrees across
    return camera.model == "radtan" and len(camera.distortion) <= 4 and wide and tilt_deg(camera) > MOST_TILTED_DEG


def believable(cameras: list[Camera], where: str, warn: Callable[..., None] = log.warning) -> list[Camera]:
    """The cameras of one rig, as fisheyes if one of them cannot be what it is said to be; `warn` gets the message."""
    worst = max(cameras, key=lambda camera: tilt_deg(camera) if fisheye_in_disguise(camera) else 0.0)
    if not fisheye_in_disguise(worst):
        return cameras
    warn(
        "%s: as radial-tangential distortion these coefficients are a lens tilted by %.0f degrees: they are read as a "
        "fisheye's (Kannala-Brandt); if they are not, 'stereo-sfm convert-calib --lens plumb_bob' says so",
        where, tilt_deg(worst),
    )  # fmt: skip
    return [KannalaBrandt(*c.size, c.fx, c.fy, c.cx, c.cy, c.distortion[:4]) for c in cameras]


def doubts(rig: Rig) -> list[str]:
    """Sizes that are unusual for a stereo camera, one line each."""
    return [*length_doubts(rig), *scale_doubts(rig)]


def length_doubts(rig: Rig) -> list[str]:
    """Lengths that are unusual for a stereo camera of these lenses, one line each."""
    if rig.second_camera is None:
        return []
    reach = rig.left.fx * rig.baseline  # metres times pixels of disparity
    millimetres = f"a baseline of {1e3 * rig.baseline:.6g} mm is unusual for"
    remedy = (
        "is its unit the metre? 'stereo-sfm convert-calib --unit' converts a file, --rig FILE gives a recording another"
    )
    found: list[str] = []
    if reach > 0.5 * rig.left.width * NEAREST_M:
        nearest = 2 * reach / rig.left.width
        found.append(f"{millimetres} lenses whose views overlap by half only from {nearest:.1f} m on: {remedy}")
    if reach < LEAST_FAR_M:
        found.append(f"{millimetres} lenses that then see depth up to {reach:.2g} m: {remedy}")
    least, most = USUAL_M
    if not (found or least <= rig.baseline <= most):
        found.append(f"{millimetres} a stereo camera ({1e3 * least:g} to {1e3 * most:g} mm are usual): {remedy}")
    if rig.left_T_right[0, 3] < -0.5 * rig.baseline:
        found.append("the right camera is to the left of the left one: are the two exchanged, or the sign of Tx?")
    return found


def scale_doubts(rig: Rig) -> list[str]:
    """A line about images that are not rectified and show things at very different sizes."""
    scale = 1.0 if rig.second_camera is None else rig.second_camera.fx / rig.left.fx
    if max(scale, 1 / scale) <= MOST_SCALE:
        return []
    return [
        f"the right image shows things {scale:.2g} times as large as the left one, so that few are found in both: "
        "'--rectify pinhole' or '--rectify wide' makes them equally large"
    ]
