"""The rig of a foreign recording: lens models from its calibration messages, extrinsics from transforms or from P."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

import numpy as np

from stereo_sfm.calib.formats.common import brown
from stereo_sfm.calib.rig import Rig
from stereo_sfm.drivers.mcap.messages import CameraInfo, Transform
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Camera, KannalaBrandt, Pinhole
from stereo_sfm.types import F64

_BROWN = ("", "none", "pinhole", "plumb_bob", "radtan", "rational_polynomial")
_FISHEYE = ("kannala_brandt", "equidistant", "fisheye")


def camera_of(info: CameraInfo, topic: str, rectified: bool) -> Camera:
    """Lens model of one camera.

    Args:
        info: its calibration message.
        topic: where it comes from, for the error.
        rectified: the images are rectified, so that the pinhole of P holds.

    Raises:
        StereoSfmError: uncalibrated, or an unsupported lens model.
    """
    size = (info.width, info.height)
    if rectified and info.p[0, 0] > 0:
        return Pinhole(*size, info.p[0, 0], info.p[1, 1], info.p[0, 2], info.p[1, 2])
    k = info.k
    if k[0, 0] <= 0:
        raise StereoSfmError(f"the camera of {topic} is not calibrated: give a calibration with --rig FILE")
    focal, centre = (k[0, 0], k[1, 1]), (k[0, 2], k[1, 2])
    model = info.model.lower()
    if model in _FISHEYE:
        return KannalaBrandt(*size, *focal, *centre, tuple([*info.d, 0.0, 0.0, 0.0, 0.0][:4]))
    if model not in _BROWN:
        raise StereoSfmError(f"{topic}: lens model '{info.model}' is not supported: give a calibration with --rig FILE")
    try:
        return brown(size, focal, centre, info.d)
    except ValueError as error:
        raise StereoSfmError(f"{topic}: {error}") from None


def stereo_rig(
    left: CameraInfo, right: CameraInfo, topics: tuple[str, str], rectified: bool, transforms: Iterable[Transform]
) -> Rig:
    """The rig of both cameras with the extrinsics.

    Raises:
        StereoSfmError: extrinsics neither in the transforms nor in P.
    """
    cameras = tuple(camera_of(info, topic, rectified) for info, topic in zip((left, right), topics, strict=True))
    left_T_right = chain(list(transforms), left.frame, right.frame) if not rectified else None
    if left_T_right is None:
        left_T_right = _from_projections(left, right, rectified)
    if left_T_right is None:
        raise StereoSfmError(
            f"no transform from '{left.frame}' to '{right.frame}' and no baseline in {topics[1]}: "
            "give a calibration with --rig FILE"
        )
    return Rig(cameras[0], cameras[1], left_T_right)


def chain(transforms: list[Transform], parent: str, child: str) -> F64 | None:
    """parent_T_child through a tree of transforms (shortest path), None when they are not connected or the same."""
    edges: dict[str, dict[str, F64]] = {}
    for t in transforms:
        edges.setdefault(t.parent, {}).setdefault(t.child, t.matrix)
        edges.setdefault(t.child, {}).setdefault(t.parent, se3.inverse(t.matrix))
    found: dict[str, F64] = {parent: np.eye(4)}
    queue = deque([parent])
    while queue:
        here = queue.popleft()
        for there, matrix in edges.get(here, {}).items():
            if there not in found:
                found[there] = found[here] @ matrix
                queue.append(there)
    return found.get(child) if parent != child else None


def _from_projections(left: CameraInfo, right: CameraInfo, rectified: bool) -> F64 | None:
    """From the right camera's P: p_rect_left = p_rect_right + (baseline, 0, 0), and R rotates into it."""
    if right.p[0, 3] == 0 or right.p[0, 0] <= 0:
        return None
    shift = np.eye(4)
    shift[0, 3] = -right.p[0, 3] / right.p[0, 0]
    if rectified:
        return shift
    zero = np.zeros(3)
    left_T_rect = se3.from_rotation_translation(left.r.T, zero)
    return se3.orthonormalize(left_T_rect @ shift @ se3.from_rotation_translation(right.r, zero))
